//! What is seen and received at one instant, and what is made of it.

use jiff::Timestamp;

use super::bounding_box::BoundingBox;
use super::error::{Error, Result};
use super::gnss_error::SigmaM;
use super::names::{ReceiverId, TargetClass, TargetId};
use super::score::Score;
use crate::geo::Position;

/// A GNSS position; its time is that of the [`Observation`] or [`super::Sample`] that holds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// Where the receiver says it is.
    pub position: Position,
    /// The receiver's own word on its standard deviation per axis, if it gave one.
    pub sigma_m: Option<SigmaM>,
}

/// A box with its time and target.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// When the frame was taken.
    pub time: Timestamp,
    /// Who is in the box.
    pub target_id: TargetId,
    /// Where in the image.
    pub bounding_box: BoundingBox,
    /// What the detector takes the target for.
    pub class: Option<TargetClass>,
    /// How sure the detector is.
    pub score: Option<Score>,
}

/// A box, a fix, or both, as a device sent it.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveItem {
    /// When, by the clock of whoever measured.
    pub time: Timestamp,
    /// Who, if known.
    pub target_id: Option<TargetId>,
    /// Which receiver measured the fix, for a fix that does not name its target.
    pub receiver_id: Option<ReceiverId>,
    /// What the camera saw.
    pub bounding_box: Option<BoundingBox>,
    /// What the receiver said.
    pub fix: Option<Fix>,
    /// What the detector takes the target for.
    pub class: Option<TargetClass>,
    /// How sure the detector is.
    pub score: Option<Score>,
}

/// A box, a fix, or both, of one target at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// When.
    pub time: Timestamp,
    /// Who, if known.
    pub target_id: Option<TargetId>,
    /// What the camera saw.
    pub bounding_box: Option<BoundingBox>,
    /// What the receiver said.
    pub fix: Option<Fix>,
}

impl Observation {
    /// # Errors
    /// An observation of neither box nor fix; the field is named `bounding_box`.
    pub fn new(
        time: Timestamp,
        target_id: Option<TargetId>,
        bounding_box: Option<BoundingBox>,
        fix: Option<Fix>,
    ) -> Result<Self> {
        if bounding_box.is_none() && fix.is_none() {
            return Err(Error::invalid("bounding_box", "give a bounding_box, a fix, or both"));
        }
        Ok(Self { time, target_id, bounding_box, fix })
    }
}

/// What a caller should know about a [`FusedFix`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Flag {
    /// No fix: the position comes from the box alone.
    GnssDenied,
    /// No box: the fix passes through.
    BoxMissing,
    /// The image's border cuts the box, so foot point and height are not the target's.
    BoxAtBorder,
    /// The box is unlike those of the training samples.
    OutsideTraining,
    /// The camera has no model; only fixes can pass.
    NoModel,
    /// The camera no longer looks where it looked when its model was trained.
    CameraMoved,
}

impl Flag {
    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::GnssDenied => "gnss_denied",
            Self::BoxMissing => "box_missing",
            Self::BoxAtBorder => "box_at_border",
            Self::OutsideTraining => "outside_training",
            Self::NoModel => "no_model",
            Self::CameraMoved => "camera_moved",
        }
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

/// The answer for one [`Observation`].
#[derive(Debug, Clone, PartialEq)]
pub struct FusedFix {
    /// The observation's time.
    pub time: Timestamp,
    /// The observation's target.
    pub target_id: Option<TargetId>,
    /// The two-step position (8); the regressed one without a fix, the fix without a box.
    pub fused: Position,
    /// The one-step position, if there was a box.
    pub regressed: Option<Position>,
    /// The fix as it came.
    pub gnss: Option<Fix>,
    /// Weights of the two.
    pub confidences: Confidences,
    /// Error variance per axis of the regressed position, m2.
    pub e_regression_m2: Option<f64>,
    /// Error variance per axis of the fix, m2.
    pub e_gnss_m2: Option<f64>,
    /// Radius about `fused` that holds the truth with 95 % probability, m.
    pub r95_m: f64,
    /// eX of (1): how badly the auto-encoder rebuilds its input (in the recipe's units).
    pub reconstruction_error: Option<f64>,
    /// Number of the model version that spoke.
    pub model_version: Option<u32>,
    /// What to know about it.
    pub flags: Vec<Flag>,
}
