//! Every field of a JSON document that is of the wrong type, unknown or missing. A parser stops at the first,
//! so each is recorded, replaced by a value that the parser accepts, and the document parsed again.

use serde::Deserialize;
use serde_json::Value;
use serde_path_to_error::{Segment, Track};

use super::json_errors::{first_variant, missing_field, refusal_of, unknown_field};
use super::objects_only;
use crate::domain::{Error, ErrorKind, MOST_VIOLATIONS, Refusal, Violation};

/// Largest document that is searched for more than its first error: each error costs some more passes.
const MAX_BYTES: usize = 64 * 1024;

/// The refusal of a document that cannot be parsed as `T`, with all fields at fault, given its first error.
pub(super) fn all_violations<'de, T: Deserialize<'de>>(json: &[u8], first: Error) -> Error {
    let Error::Refused(Refusal { kind: ErrorKind::InvalidArgument, message, mut violations, .. }) = first
    else {
        return first;
    };
    if json.len() <= MAX_BYTES
        && let Ok(mut document) = serde_json::from_slice::<Value>(json)
    {
        collect::<T>(&mut document, &mut violations);
    }
    let message = match violations.len() {
        0 | 1 => message,
        count => format!("{count} fields cannot be used"),
    };
    let kind = ErrorKind::InvalidArgument;
    Error::Refused(Refusal {
        kind,
        message,
        violations,
        conflicting_id: None,
        other_node: None,
        may_repeat: false,
    })
}

fn collect<'de, T: Deserialize<'de>>(document: &mut Value, violations: &mut Vec<Violation>) {
    for _ in 0..MOST_VIOLATIONS {
        let Some(fault) = Fault::find::<T>(document) else { return };
        if let Error::Refused(refusal) = refusal_of(&fault.shown, &fault.error) {
            let is_new = |at: &Violation| violations.iter().all(|known| known.field != at.field);
            let new: Vec<Violation> = refusal.violations.into_iter().filter(is_new).collect();
            violations.extend(new);
        }
        if violations.len() >= MOST_VIOLATIONS || !fault.mend::<T>(document) {
            return;
        }
    }
}

/// A step from a value to one within it.
#[derive(Debug, Clone, PartialEq)]
enum Step {
    Field(String),
    Item(usize),
}

/// The first error of a document.
struct Fault {
    path: Vec<Step>,
    /// The path as refusals show it.
    shown: String,
    error: serde_json::Error,
}

impl Fault {
    fn find<'de, T: Deserialize<'de>>(document: &Value) -> Option<Self> {
        let mut track = Track::new();
        let tracked = serde_path_to_error::Deserializer::new(document.clone(), &mut track);
        let error = objects_only::deserialize::<T, _>(tracked, usize::MAX).err()?;
        let path = track.path();
        let steps = path.iter().filter_map(|segment| match segment {
            Segment::Seq { index } => Some(Step::Item(*index)),
            Segment::Map { key } => Some(Step::Field(key.clone())),
            Segment::Enum { .. } | Segment::Unknown => None,
        });
        let shown = path.to_string();
        Some(Self { path: steps.collect(), shown: if shown == "." { String::new() } else { shown }, error })
    }

    /// Changes the document so that this error is gone; false where no change does that.
    fn mend<'de, T: Deserialize<'de>>(self, document: &mut Value) -> bool {
        let message = self.error.to_string();
        let mut target = self.path;
        if let Some(name) = unknown_field(&message) {
            // The path leads to the object or to the field itself.
            target.pop_if(|step| *step == Step::Field(name.to_owned()));
            let object = value_at(document, &target).and_then(Value::as_object_mut);
            return object.is_some_and(|object| object.remove(name).is_some());
        }
        if let Some(name) = missing_field(&message) {
            target.push(Step::Field(name.to_owned()));
        }
        !target.is_empty() && replace::<T>(document, &target)
    }

    /// True if it is at or below a value, or says that the value is missing.
    fn is_within(&self, target: &[Step]) -> bool {
        let is_missing = || match target {
            [parents @ .., Step::Field(name)] => {
                self.path == parents && missing_field(&self.error.to_string()) == Some(name)
            }
            _ => false,
        };
        self.path.starts_with(target) || is_missing()
    }
}

/// Replaces a value by the first that the parser accepts in its place; false if there is none.
fn replace<'de, T: Deserialize<'de>>(document: &mut Value, target: &[Step]) -> bool {
    let object = Value::Object(serde_json::Map::new());
    let mut candidates =
        vec![object, Value::Array(Vec::new()), false.into(), "".into(), 0.into(), Value::Null];
    let mut is_variant_known = false;
    while let Some(candidate) = candidates.pop() {
        if !put(document, target, candidate) {
            return false;
        }
        let Some(fault) = Fault::find::<T>(document) else { return true };
        if !fault.is_within(target) {
            return true;
        }
        let message = fault.error.to_string();
        if let Some(variant) = first_variant(&message).filter(|_| !is_variant_known) {
            candidates.push(variant.into());
            is_variant_known = true;
        }
    }
    false
}

fn value_at<'v>(document: &'v mut Value, path: &[Step]) -> Option<&'v mut Value> {
    path.iter().try_fold(document, |value, step| match step {
        Step::Field(name) => value.get_mut(name),
        Step::Item(index) => value.get_mut(index),
    })
}

fn put(document: &mut Value, target: &[Step], value: Value) -> bool {
    let Some((last, parents)) = target.split_last() else { return false };
    match (value_at(document, parents), last) {
        (Some(Value::Object(object)), Step::Field(name)) => {
            object.insert(name.clone(), value);
            true
        }
        (Some(Value::Array(items)), Step::Item(index)) => match items.get_mut(*index) {
            Some(item) => {
                *item = value;
                true
            }
            None => false,
        },
        _ => false,
    }
}
