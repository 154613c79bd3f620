//! A stored part of the recording of a camera without a model.

use jiff::Timestamp;

/// Boxes of trackers and fixes of receivers that came within a few seconds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingPart {
    /// When it was stored, by the server's clock.
    pub recorded_at: Timestamp,
    /// Number of boxes and fixes.
    pub rows: u32,
    /// The rows, encoded.
    pub content: Vec<u8>,
}

/// How much of a camera's recording is kept; the oldest parts give way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordingBounds {
    /// Number of boxes and fixes.
    pub rows: u64,
    /// Number of encoded bytes.
    pub bytes: u64,
}
