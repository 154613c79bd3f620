//! An observation kept for training.

use jiff::Timestamp;

use super::bounding_box::BoundingBox;
use super::names::{TargetClass, TargetId};
use super::observation::Fix;
use super::score::Score;
use crate::geo::Position;

/// A box and a fix of one target at one instant. Unique by camera, target and time.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// When, to the microsecond.
    pub time: Timestamp,
    /// Who.
    pub target_id: TargetId,
    /// What the camera saw.
    pub bounding_box: BoundingBox,
    /// What the receiver said.
    pub fix: Fix,
    /// What the detector takes the target for.
    pub class: Option<TargetClass>,
    /// How sure the detector is.
    pub score: Option<Score>,
    /// Where the target truly was, for evaluation alone; never used in training.
    pub truth: Option<Position>,
}
