//! The input and the output of a world tracker.

use std::fmt;

use jiff::Timestamp;

use crate::domain::{CameraId, ReceiverId, TargetId};
use crate::geo::{EastNorth, PlaneCovariance};

/// Number of a world track, unique within its tracker and never used again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct WorldTrackId(pub u64);

impl fmt::Display for WorldTrackId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", self.0)
    }
}

/// The detections of one camera at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraFrame {
    /// The camera.
    pub camera: CameraId,
    /// The instant of the frame.
    pub time: Timestamp,
    /// The detections; an empty frame counts too.
    pub detections: Vec<WorldDetection>,
}

/// One detection as a position in the site's plane. Its error has three parts: the box's noise, what lasts of the
/// camera's own error, and the error that the maps of all cameras of the site have in common because they were trained
/// on the same receivers.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldDetection {
    /// The id that the camera's own tracker gave the target.
    pub tracker_id: Option<TargetId>,
    /// The receiver that the target is known to carry.
    pub receiver: Option<ReceiverId>,
    /// Regressed position, m.
    pub position: EastNorth,
    /// Covariance of the error that differs from box to box, m2.
    pub covariance_m2: PlaneCovariance,
    /// Covariance of the error that differs between cameras and lasts while the target moves some metres: the camera's
    /// own part of its map's error (V_rel) and the lasting part of the box's, m2.
    pub offset_covariance_m2: PlaneCovariance,
    /// Covariance of the error that all cameras have in common at that place (V_com), m2; zero if unknown.
    pub common_covariance_m2: PlaneCovariance,
}

/// A change of the set of tracks.
#[derive(Debug, Clone, PartialEq)]
pub enum WorldEvent {
    /// A track is confirmed: from now on it is reported.
    Born {
        /// The track.
        track: WorldTrackId,
    },
    /// A camera sees a track that another camera saw before.
    HandedOver {
        /// The track.
        track: WorldTrackId,
        /// The camera that saw it last.
        from: CameraId,
        /// The camera that sees it now.
        to: CameraId,
    },
    /// A track got the identity of a receiver.
    Identified {
        /// The track.
        track: WorldTrackId,
        /// The receiver.
        receiver: ReceiverId,
    },
    /// Two tracks were of one target; the second one ends.
    Merged {
        /// The track that goes on.
        track: WorldTrackId,
        /// The track that ends.
        ended: WorldTrackId,
    },
    /// A confirmed track ends without a measurement for too long.
    Lost {
        /// The track.
        track: WorldTrackId,
    },
}

/// A [`WorldEvent`] with the instant at which it was noticed.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedEvent {
    /// The instant of the event.
    pub time: Timestamp,
    /// The event.
    pub event: WorldEvent,
}

/// A camera whose positions are shifted beside those of the site's other cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct MovedCamera {
    /// The camera.
    pub camera: CameraId,
    /// Start of the first observation with the shift.
    pub onset_at: Timestamp,
    /// Mean shift of its positions, m.
    pub shift: EastNorth,
    /// Twice the logarithm of the likelihood ratio.
    pub statistic: f64,
    /// Targets compared since the onset.
    pub targets: usize,
}

impl MovedCamera {
    /// Error variance per axis that the move adds to that of the camera's map, m2: half the squared shift.
    #[must_use]
    pub fn change_variance_m2(&self) -> f64 {
        0.5 * (self.shift.east_m.powi(2) + self.shift.north_m.powi(2))
    }
}

/// The outcome of a frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FrameOutcome {
    /// The track of each detection, in their order; `None` for one that was not processed.
    pub tracks: Vec<Option<WorldTrackId>>,
    /// Detections beyond the bounds of the settings.
    pub dropped: usize,
    /// True if the whole frame was refused because it came too late.
    pub too_late: bool,
    /// The changes, in order.
    pub events: Vec<TimedEvent>,
    /// True if the cameras' clocks were estimated again.
    pub has_new_clocks: bool,
    /// A camera that was found to have been moved; each is reported once.
    pub moved: Option<MovedCamera>,
}

/// The outcome of a fix.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FixOutcome {
    /// The track of the receiver.
    pub track: Option<WorldTrackId>,
    /// The changes, in order.
    pub events: Vec<TimedEvent>,
}
