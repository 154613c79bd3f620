//! One row of a file as it was read, before it is checked, and the error of an invalid row.

use serde::{Deserialize, Serialize};

use super::wire::{self, Text};
use crate::domain::{Error, Result};

/// Why a row of a file is invalid.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RowError {
    /// Line of the file from 1 (a CSV file's header is line 1), or element of a JSON array from 1.
    pub line: u64,
    /// Column, or path of the field in the row's JSON; empty if the row as a whole is invalid.
    pub field: String,
    /// States the fault and the valid values.
    pub reason: String,
}

impl RowError {
    pub(super) fn whole(line: u64, reason: &str) -> Self {
        Self { line, field: String::new(), reason: reason.to_owned() }
    }

    /// The row error of a refusal.
    ///
    /// # Errors
    /// Passes a fault on: it concerns the whole file.
    pub fn of(line: u64, error: Error) -> Result<Self> {
        match error {
            Error::Refused(refusal) => Ok(match refusal.violations.into_iter().next() {
                Some(violation) => Self { line, field: violation.field, reason: violation.message },
                None => Self { line, field: String::new(), reason: refusal.message },
            }),
            Error::Fault(_) => Err(error),
        }
    }
}

/// A row of any file; the reader decides which fields are required.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileRow<'a> {
    #[serde(borrow)]
    pub time: Option<Text<'a>>,
    #[serde(borrow)]
    pub target_id: Option<Text<'a>>,
    pub bounding_box: Option<wire::BoundingBox>,
    pub fix: Option<wire::Fix>,
    #[serde(borrow)]
    pub class: Option<Text<'a>>,
    pub score: Option<f64>,
    pub truth: Option<wire::Position>,
    /// The score of a live item; next to `match_probability`, the score that `sightfix pair --match` states, which is not stored.
    #[serde(borrow)]
    pub tracker_id: Option<Text<'a>>,
    #[serde(rename = "match_probability")]
    pub _match_probability: Option<f64>,
    /// Only fixes and live items have it.
    #[serde(borrow)]
    pub receiver_id: Option<Text<'a>>,
}

/// The name, shared with the previous row if it is the same.
pub(super) fn shared<T: Clone>(
    text: Option<&Text<'_>>,
    previous: &mut Option<T>,
    as_str: impl Fn(&T) -> &str,
    make: impl Fn(&str) -> Result<T>,
) -> Result<Option<T>> {
    let Some(text) = text else { return Ok(None) };
    if previous.as_ref().is_none_or(|name| as_str(name) != text.as_str()) {
        *previous = Some(make(text.as_str())?);
    }
    Ok(previous.clone())
}
