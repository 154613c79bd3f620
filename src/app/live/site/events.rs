//! The events of a site.

use std::sync::Arc;

use jiff::Timestamp;

use super::published::WorldTrackPoint;
use crate::domain::{CameraId, LiveId, TargetId};

/// An event of a site.
#[derive(Debug)]
pub struct SiteEvent {
    /// Its instant by the clock of the cameras.
    pub time: Timestamp,
    /// The kind of event.
    pub kind: SiteEventKind,
}

/// The kinds of events of a site.
#[derive(Debug)]
pub enum SiteEventKind {
    /// A target was measured.
    Measured(Arc<WorldTrackPoint>),
    /// A track is confirmed.
    Started(LiveId),
    /// A camera sees a target that another camera saw before.
    HandedOver {
        /// The target's track.
        track: LiveId,
        /// The camera that saw it last.
        from: CameraId,
        /// The camera that sees it now.
        to: CameraId,
    },
    /// The target of a track is known by a receiver that it carries.
    Identified { track: LiveId, target_id: TargetId },
    /// Two tracks were of one target.
    Merged {
        /// The track that goes on.
        track: LiveId,
        /// The track that ends.
        ended: LiveId,
    },
    /// A track ends without a measurement for too long.
    Ended(LiveId),
}
