//! The state in memory of one site, from its creation (or the start of the server) to its deletion.

use std::sync::{Arc, Mutex, OnceLock};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::clocks::SiteClocks;
use super::events::SiteEvent;
use super::item::SiteItem;
use super::published::PublishedTracks;
use crate::app::live::event_log::EventLog;
use crate::app::live::sync::lock;
use crate::domain::{CameraId, HistorySettings, LiveId, ReceiverId, ReceiverMatch, TargetId, TrackScope};
use crate::geo::Position;

/// Queue, tracks and events of one site.
pub(in crate::app) struct SiteLive {
    /// The epoch of the ids of tracks and events.
    pub(super) epoch: u32,
    /// Origin of the plane, if the operator states it.
    pub(super) origin: Mutex<Option<Position>>,
    /// The site and how its history is kept, if it has one.
    pub(super) history: Mutex<Option<(TrackScope, HistorySettings)>>,
    /// The way to the task, which starts with the first item.
    pub(super) queue: OnceLock<mpsc::Sender<SiteItem>>,
    pub(super) tracks: Mutex<PublishedTracks>,
    pub(super) clocks: Mutex<SiteClocks>,
    pub(super) events: Arc<EventLog<SiteEvent>>,
    pub(super) ended: CancellationToken,
}

impl SiteLive {
    pub(in crate::app) fn new(epoch: u32, events: usize) -> Arc<Self> {
        Arc::new(Self {
            epoch,
            origin: Mutex::default(),
            history: Mutex::default(),
            queue: OnceLock::new(),
            tracks: Mutex::default(),
            clocks: Mutex::default(),
            events: Arc::new(EventLog::new(events)),
            ended: CancellationToken::new(),
        })
    }

    /// Changes the origin of the plane; tracks start again where it differs.
    pub(in crate::app) fn set_origin(&self, origin: Option<Position>) {
        *lock(&self.origin) = origin;
    }

    /// Keeps the tracks of the site that finish from now on; `None` keeps none.
    pub(in crate::app) fn set_history(&self, history: Option<(TrackScope, HistorySettings)>) {
        *lock(&self.history) = history;
    }

    /// Ends the task and the readers of a site that is deleted, or of a server that ends.
    pub(in crate::app) fn end(&self) {
        self.ended.cancel();
    }

    pub(super) const fn id_of(&self, number: u64) -> LiveId {
        LiveId { epoch: self.epoch, number }
    }

    /// The receiver of that track.
    pub(in crate::app::live) fn receiver_of(
        &self,
        camera: &CameraId,
        target_id: &TargetId,
    ) -> Option<ReceiverMatch> {
        let tracks = lock(&self.tracks);
        tracks.latest_of(tracks.track_of(camera, target_id)?)?.receiver_match.clone()
    }

    /// True if a track that cameras see carries the receiver.
    pub(in crate::app::live) fn shows(&self, receiver_id: &ReceiverId) -> bool {
        lock(&self.tracks).carries(receiver_id)
    }

    /// The world track of which a camera's tracker saw the target lately.
    pub(super) fn track_of(&self, camera: &CameraId, target_id: &TargetId) -> Option<LiveId> {
        lock(&self.tracks).track_of(camera, target_id)
    }
}
