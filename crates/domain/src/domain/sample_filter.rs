//! Which samples of a camera, and their order.

use jiff::Timestamp;

use super::evaluation::TimeRange;
use super::names::TargetId;
use super::sample::Sample;

/// Which samples of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SampleFilter {
    /// From this instant on.
    pub from: Option<Timestamp>,
    /// Before this instant.
    pub until: Option<Timestamp>,
    /// Only samples of this target.
    pub target_id: Option<TargetId>,
    /// Only samples that have a fix, or only those that have none.
    pub has_fix: Option<bool>,
}

impl SampleFilter {
    /// All samples of an interval of time.
    #[must_use]
    pub fn within(range: TimeRange) -> Self {
        Self { from: range.from(), until: range.until(), ..Self::default() }
    }
}

/// The place of a sample in its camera's order: by time, then by target (bytes of its UTF-8).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampleKey {
    /// The sample's time.
    pub time: Timestamp,
    /// The sample's target.
    pub target_id: TargetId,
}

impl SampleKey {
    /// The key of a sample, to go on after it.
    #[must_use]
    pub fn of<F>(sample: &Sample<F>) -> Self {
        Self { time: sample.time, target_id: sample.target_id.clone() }
    }
}
