//! Training samples.

use jiff::Timestamp;

use super::bounding_box::BoundingBox;
use super::names::{TargetClass, TargetId};
use super::observation::{Detection, Fix};
use super::score::Score;
use crate::geo::Position;

/// A box and a fix of one target at one instant, for training. Unique by camera, target and time.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample<F = Fix> {
    /// Time, to the microsecond.
    pub time: Timestamp,
    /// The target.
    pub target_id: TargetId,
    /// The detection.
    pub bounding_box: BoundingBox,
    /// The fix.
    pub fix: F,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
    /// True position, for evaluation only; never used in training.
    pub truth: Option<Position>,
}

/// A sample as it is stored and exchanged: it may have no fix. A box alone contributes to the geometry of
/// the camera, not to its place.
pub type StoredSample = Sample<Option<Fix>>;

/// How a sample's target was matched with a receiver; the sample's target is the receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct Association {
    /// Id that the tracker gave the box.
    pub tracker_id: TargetId,
    /// Posterior probability of the match, 0 to 1.
    pub probability: f64,
}

impl<F> Sample<F> {
    fn replace_fix<G>(self, replace: impl FnOnce(F) -> G) -> Sample<G> {
        let Self { time, target_id, bounding_box, fix, class, score, truth } = self;
        Sample { time, target_id, bounding_box, fix: replace(fix), class, score, truth }
    }
}

impl StoredSample {
    /// The sample, if it has a fix.
    #[must_use]
    pub fn with_fix(self) -> Option<Sample> {
        let fix = self.fix?;
        Some(self.replace_fix(|_| fix))
    }
}

impl From<Sample> for StoredSample {
    fn from(sample: Sample) -> Self {
        sample.replace_fix(Some)
    }
}

impl From<Detection> for StoredSample {
    fn from(detection: Detection) -> Self {
        let Detection { time, target_id, bounding_box, class, score } = detection;
        Self { time, target_id, bounding_box, fix: None, class, score, truth: None }
    }
}

impl From<StoredSample> for Detection {
    fn from(sample: StoredSample) -> Self {
        let Sample { time, target_id, bounding_box, class, score, .. } = sample;
        Self { time, target_id, bounding_box, class, score }
    }
}

/// Number of stored samples of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SampleCount {
    /// All of them.
    pub all: u64,
    /// Number of these samples without a fix.
    pub without_fix: u64,
}
