//! The rule for new samples of a camera that has reached its limit.

use serde::{Deserialize, Serialize};

/// The rule for new samples of a camera that has reached its limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleOverflow {
    /// More are refused, so that nothing is lost that nobody deleted.
    #[default]
    Refuse,
    /// The oldest of the camera are deleted, by their times.
    DeleteOldest,
}
