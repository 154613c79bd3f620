//! Measured positions on their way to the tracker of a site.

use jiff::Timestamp;

use crate::domain::{CameraId, TargetClass, TargetId};
use crate::geo::{PlaneCovariance, Position};
use crate::model::JointError;

/// One measured position of one target.
#[derive(Debug)]
pub(super) struct SiteItem {
    /// The camera whose observation it was.
    pub(super) camera: CameraId,
    pub(super) time: Timestamp,
    pub(super) target_id: Option<TargetId>,
    /// The name under which the camera's tracker follows the target.
    pub(super) tracked_as: Option<TargetId>,
    /// Class reported by the detector.
    pub(super) class: Option<TargetClass>,
    pub(super) position: Position,
    pub(super) source: ItemSource,
}

/// The sensor that measured a position.
#[derive(Debug)]
pub(super) enum ItemSource {
    /// A box, through the camera's model.
    Box {
        /// The model's version.
        model_version: u32,
        /// Covariance of the error, m2, axes east and north of the model's plane, which those of the site's plane
        /// are to within its range.
        covariance_m2: PlaneCovariance,
        /// The part of it that is the error of the map from pixels to the ground, which is the same from frame to frame
        /// at a place, m2.
        map_covariance_m2: PlaneCovariance,
        /// How it divides among cameras that were trained together; `None` for a camera that was trained by itself.
        joint: Option<JointError>,
        /// Origin of the model's plane.
        model_origin: Position,
    },
    /// A fix of a receiver.
    Fix {
        /// Error variance per axis, m2.
        variance_m2: f64,
    },
}
