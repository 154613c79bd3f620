//! What happens to samples of a camera that has as many as it may.

use serde::{Deserialize, Serialize};

/// What happens when a camera has as many samples as it may.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleOverflow {
    /// More are refused, so that nothing is lost that nobody deleted.
    #[default]
    Refuse,
    /// The oldest of the camera are deleted, by their times.
    DeleteOldest,
}
