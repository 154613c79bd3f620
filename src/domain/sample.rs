//! Training samples.

use jiff::Timestamp;

use super::bounding_box::BoundingBox;
use super::error::{Error, Result};
use super::names::{TargetClass, TargetId};
use super::observation::Fix;
use crate::geo::Position;

/// A detector's score, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Score(f64);

impl Score {
    /// # Errors
    /// Refuses what is not within 0..=1; the field is named `score`.
    pub fn new(score: f64) -> Result<Self> {
        if (0.0..=1.0).contains(&score) {
            Ok(Self(score))
        } else {
            Err(Error::invalid("score", "must be from 0 to 1"))
        }
    }

    /// The score, 0 to 1.
    #[must_use]
    pub const fn value(self) -> f64 {
        self.0
    }
}

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
