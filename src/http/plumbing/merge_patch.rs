//! Merge patches of resources (RFC 7396).

use serde::Serialize;
use serde_json::Value;

use crate::domain::{Error, ErrorKind, Result};

/// A JSON object.
pub(in crate::http) type JsonObject = serde_json::Map<String, Value>;

/// Times that a patch without a version is made of what was read.
const ATTEMPTS: u32 = 8;

/// Returns a patched resource as the JSON of its draft: its id and the fields that may be patched.
///
/// # Errors
/// `InvalidArgument` naming a field that cannot be changed.
pub(in crate::http) fn merged(
    shown: &impl Serialize,
    patch: &JsonObject,
    fields: &[&str],
) -> Result<Vec<u8>> {
    if let Some(name) = patch.keys().find(|name| !fields.contains(&name.as_str())) {
        let known = fields.join(", ");
        return Err(Error::invalid(name, format!("is not a field that can be changed; those are {known}")));
    }
    let shown = serde_json::to_value(shown).map_err(Error::fault)?;
    let Value::Object(mut document) = shown else { return Err(Error::fault("a resource is an object")) };
    document.retain(|name, _| name == "id" || fields.contains(&name.as_str()));
    merge(&mut document, patch);
    serde_json::to_vec(&document).map_err(Error::fault)
}

/// RFC 7396, section 2.
fn merge(target: &mut JsonObject, patch: &JsonObject) {
    for (name, value) in patch {
        match value {
            Value::Null => drop(target.remove(name)),
            Value::Object(patch) => {
                let nested = target.entry(name.clone()).or_insert_with(|| Value::Object(JsonObject::new()));
                if !nested.is_object() {
                    *nested = Value::Object(JsonObject::new());
                }
                if let Value::Object(nested) = nested {
                    merge(nested, patch);
                }
            }
            other => drop(target.insert(name.clone(), other.clone())),
        }
    }
}

/// Makes a read-modify-write. If a concurrent update has changed the resource, it is made again, unless
/// the client named a version.
///
/// # Errors
/// That of the change.
pub(in crate::http) async fn retried<T, F>(is_based_on_version: bool, change: impl Fn() -> F) -> Result<T>
where
    F: Future<Output = Result<T>>,
{
    let mut attempts = 0;
    loop {
        attempts += 1;
        match change().await {
            Err(error)
                if error.kind() == ErrorKind::RevisionMismatch
                    && !is_based_on_version
                    && attempts < ATTEMPTS => {}
            changed => return changed,
        }
    }
}
