//! Detections, fixes, observations and fused positions.

use jiff::Timestamp;
use strum::IntoStaticStr;

use super::bounding_box::BoundingBox;
use super::error::{Error, Result};
use super::gnss_error::SigmaM;
use super::names::{ReceiverId, TargetClass, TargetId, TrackerId};
use super::score::Score;
use crate::geo::{PlaneCovariance, Position};

/// A GNSS position; its time is that of the [`Observation`] or [`super::Sample`] that holds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// Measured position.
    pub position: Position,
    /// Standard deviation per axis as the receiver states it with the fix, else as the camera's profile states it for the
    /// receiver; `None` where neither does.
    pub sigma_m: Option<SigmaM>,
}

/// A bounding box with its time and target.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// Time of the frame.
    pub time: Timestamp,
    /// The detected target.
    pub target_id: TargetId,
    /// The box in the image.
    pub bounding_box: BoundingBox,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
}

/// A box, a fix, or both, as sent by a device.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveItem {
    /// Time by the clock of the device.
    pub time: Timestamp,
    /// The target, if known.
    pub target_id: Option<TargetId>,
    /// Number that the camera's tracker gave a box whose target is not known.
    pub tracker_id: Option<TrackerId>,
    /// The receiver of a fix that does not name its target.
    pub receiver_id: Option<ReceiverId>,
    /// The detection.
    pub bounding_box: Option<BoundingBox>,
    /// The fix.
    pub fix: Option<Fix>,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
}

/// A box, a fix, or both, of one target at one instant; at least one of the two.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    time: Timestamp,
    target_id: Option<TargetId>,
    tracker_id: Option<TrackerId>,
    bounding_box: Option<BoundingBox>,
    fix: Option<Fix>,
    class: Option<TargetClass>,
}

/// The receiver that the target of a box carries, by association.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceiverMatch {
    /// The receiver.
    pub receiver_id: ReceiverId,
    /// Posterior probability.
    pub probability: f64,
}

impl Observation {
    /// # Errors
    /// Refuses an observation with neither box nor fix; the field is `bounding_box`.
    pub fn new(
        time: Timestamp,
        target_id: Option<TargetId>,
        bounding_box: Option<BoundingBox>,
        fix: Option<Fix>,
    ) -> Result<Self> {
        if bounding_box.is_none() && fix.is_none() {
            return Err(Error::invalid("bounding_box", "give a bounding_box, a fix, or both"));
        }
        Ok(Self { time, target_id, tracker_id: None, bounding_box, fix, class: None })
    }

    /// Returns the observation of a box that has only the number of its camera's tracker.
    ///
    /// # Errors
    /// Names `tracker_id` beside a target or a fix, whose target would be known.
    pub fn with_tracker_id(self, tracker_id: Option<TrackerId>) -> Result<Self> {
        if tracker_id.is_some() && (self.target_id.is_some() || self.fix.is_some()) {
            return Err(Error::invalid(
                "tracker_id",
                "belongs to a box without a target, a receiver and a fix",
            ));
        }
        Ok(Self { tracker_id, ..self })
    }

    /// The same with the class that the detector reports.
    #[must_use]
    pub fn with_class(self, class: Option<TargetClass>) -> Self {
        Self { class, ..self }
    }

    /// Class reported by the detector.
    #[must_use]
    pub const fn class(&self) -> Option<&TargetClass> {
        self.class.as_ref()
    }

    /// The name under which the camera's tracker follows the target: its number, else the target. It stays when the
    /// target of the number becomes known.
    #[must_use]
    pub fn tracked_as(&self) -> Option<TargetId> {
        self.tracker_id.as_ref().map(TargetId::from).or_else(|| self.target_id.clone())
    }

    /// The same of a known target.
    #[must_use]
    pub fn with_target(self, target_id: TargetId) -> Self {
        Self { target_id: Some(target_id), ..self }
    }

    /// Returns the observation of a fix, with or without a box.
    #[must_use]
    pub const fn with_fix(
        time: Timestamp,
        target_id: Option<TargetId>,
        bounding_box: Option<BoundingBox>,
        fix: Fix,
    ) -> Self {
        Self { time, target_id, tracker_id: None, bounding_box, fix: Some(fix), class: None }
    }

    /// Time of the measurement.
    #[must_use]
    pub const fn time(&self) -> Timestamp {
        self.time
    }

    /// The target, if known.
    #[must_use]
    pub const fn target_id(&self) -> Option<&TargetId> {
        self.target_id.as_ref()
    }

    /// Number that the camera's tracker gave a box whose target was not known.
    #[must_use]
    pub const fn tracker_id(&self) -> Option<&TrackerId> {
        self.tracker_id.as_ref()
    }

    /// The detection.
    #[must_use]
    pub const fn bounding_box(&self) -> Option<BoundingBox> {
        self.bounding_box
    }

    /// The fix.
    #[must_use]
    pub const fn fix(&self) -> Option<Fix> {
        self.fix
    }

    /// The same with the fix alone; `None` without one.
    #[must_use]
    pub fn without_box(&self) -> Option<Self> {
        self.fix.map(|fix| Self::with_fix(self.time, self.target_id.clone(), None, fix))
    }

    /// The same with the box alone; `None` without one.
    #[must_use]
    pub fn without_fix(&self) -> Option<Self> {
        self.bounding_box.map(|_| Self { fix: None, ..self.clone() })
    }

    /// The same with its box changed, if it has one.
    ///
    /// # Errors
    /// That of the change.
    pub fn try_map_box(self, change: impl FnOnce(BoundingBox) -> Result<BoundingBox>) -> Result<Self> {
        Ok(Self { bounding_box: self.bounding_box.map(change).transpose()?, ..self })
    }

    /// Time, target, box and fix.
    #[must_use]
    pub fn into_parts(self) -> (Timestamp, Option<TargetId>, Option<BoundingBox>, Option<Fix>) {
        (self.time, self.target_id, self.bounding_box, self.fix)
    }
}

/// A warning about a [`FusedFix`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum Flag {
    /// No fix: the position is regressed from the box alone.
    GnssDenied,
    /// No box: the position is the fix.
    BoxMissing,
    /// The image border truncates the box, so foot point and height are not the target's.
    BoxAtBorder,
    /// The box is outside of the domain of the training samples.
    OutsideTraining,
    /// The camera has no model; only fixes are passed through.
    NoModel,
    /// The camera's pose has changed since its model was trained.
    CameraMoved,
    /// Box and fix contradict each other beyond their stated errors (chi-square gate, 99.9 %).
    SourcesDisagree,
    /// The fix was not used for the position: it contradicts the box, or it is out of range.
    FixRejected,
    /// The box was not used for the position: it contradicts the fix and is unusual, or the model gives
    /// no position for it.
    BoxRejected,
    /// The fix lies farther than 20 km from the camera's scene.
    FixOutOfRange,
    /// The target's boxes have been the same to the pixel for longer than a standing target shows: the picture or the
    /// detector stands still.
    BoxFrozen,
    /// Something hides the target's lower part, more probably than not: its box is too short for its width and place.
    /// The position is that of the completed box.
    FootHidden,
}

impl Flag {
    /// Name in files and wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// The weights of regression and GNSS by (6) and (7); they sum to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Confidences {
    /// Weight of the regressed position.
    pub regression: f64,
    /// Weight of the fix.
    pub gnss: f64,
}

/// The fused position of one [`Observation`].
#[derive(Debug, Clone, PartialEq)]
pub struct FusedFix {
    /// Time of the observation.
    pub time: Timestamp,
    /// Target of the observation.
    pub target_id: Option<TargetId>,
    /// The two-step position (8); the regressed position without a fix, the fix without a box.
    pub fused: Position,
    /// The one-step position, if there is a box.
    pub regressed: Option<Position>,
    /// The fix of the observation.
    pub gnss: Option<Fix>,
    /// Weights of both.
    pub confidences: Confidences,
    /// Error variance per axis of the regressed position, m2.
    pub e_regression_m2: Option<f64>,
    /// Error variance per axis of the fix, m2.
    pub e_gnss_m2: Option<f64>,
    /// Radius about `fused` that contains the true position with 95 % probability, m.
    pub r95_m: f64,
    /// Covariance of the normal distribution about `fused` that has this radius, m2.
    pub covariance: PlaneCovariance,
    /// The same of the regressed position, if there is one.
    pub regressed_covariance: Option<PlaneCovariance>,
    /// eX of (1): the auto-encoder's reconstruction error, in the recipe's units.
    pub reconstruction_error: Option<f64>,
    /// Number of the model version used.
    pub model_version: Option<u32>,
    /// Warnings.
    pub flags: Vec<Flag>,
}
