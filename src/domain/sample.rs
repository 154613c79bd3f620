//! Training samples.

use jiff::Timestamp;

use super::bounding_box::BoundingBox;
use super::names::{TargetClass, TargetId};
use super::observation::Fix;
use super::score::Score;
use crate::geo::Position;

/// A box and a fix of one target at one instant, stored for training. Unique by camera, target and time.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Time, to the microsecond.
    pub time: Timestamp,
    /// The target.
    pub target_id: TargetId,
    /// The detection.
    pub bounding_box: BoundingBox,
    /// The fix.
    pub fix: Fix,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
    /// True position, for evaluation only; never used in training.
    pub truth: Option<Position>,
}
