//! World tracks of a site: one set of tracks, fed by all its cameras.
//!
//! Answers put what they measured into a bounded queue and never wait; one task per site assembles frames, runs
//! the world tracker and publishes its tracks and events. Everything is in memory: tracks describe the present.

mod events;
mod feed;
mod published;
mod task;
mod tracker;

use std::sync::{Arc, Mutex, OnceLock};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use self::feed::SiteItem;
use self::published::PublishedTracks;
use super::event_log::EventLog;
use super::sync::lock;
use crate::app::App;
use crate::app::site_registry::ActiveSite;
use crate::domain::{CameraId, Error, ErrorKind, LiveId, Result, SiteId, TargetId};
use crate::geo::Position;

pub use events::{LossReason, LostSiteEvents, SiteEvent, SiteEventKind, SiteEvents, StoredSiteEvent};
pub use published::{WorldSighting, WorldTrackPoint};

/// The state in memory of one site that exists, from its creation (or the start of the server) to its deletion.
pub(in crate::app) struct SiteLive {
    /// Of the ids of tracks and events.
    epoch: u32,
    /// Origin of the plane, if the operator states it.
    origin: Mutex<Option<Position>>,
    /// The way to the task, which starts with the first item.
    queue: OnceLock<mpsc::Sender<SiteItem>>,
    tracks: Mutex<PublishedTracks>,
    events: Arc<EventLog<SiteEvent>>,
    ended: CancellationToken,
}

impl SiteLive {
    pub(in crate::app) fn new(epoch: u32, events: usize) -> Arc<Self> {
        Arc::new(Self {
            epoch,
            origin: Mutex::default(),
            queue: OnceLock::new(),
            tracks: Mutex::default(),
            events: Arc::new(EventLog::new(events)),
            ended: CancellationToken::new(),
        })
    }

    /// Changes the origin of the plane; tracks start again where it differs.
    pub(in crate::app) fn set_origin(&self, origin: Option<Position>) {
        *lock(&self.origin) = origin;
    }

    /// Ends the task and the readers of a site that is deleted, or of a server that ends.
    pub(in crate::app) fn end(&self) {
        self.ended.cancel();
    }

    const fn id_of(&self, number: u64) -> LiveId {
        LiveId { epoch: self.epoch, number }
    }

    /// The world track of which a camera's tracker saw the target lately.
    pub(super) fn track_of(&self, camera: &CameraId, target_id: &TargetId) -> Option<LiveId> {
        lock(&self.tracks).track_of(camera, target_id)
    }
}

/// The tracks of a site at one instant.
#[derive(Debug)]
pub struct SiteTracks {
    /// The latest point of every track, in the order of the ids.
    pub points: Vec<Arc<WorldTrackPoint>>,
    /// The event behind which a reader misses nothing that is not among the points.
    pub last_event: LiveId,
}

impl App {
    /// Where every target of a site is now.
    ///
    /// # Errors
    /// `SiteNotFound`.
    pub async fn world_tracks(&self, id: &SiteId) -> Result<SiteTracks> {
        let live = &self.active_site(id).await?.live;
        // The event first: what is published in between is in both.
        let last_event = live.id_of(live.events.latest());
        Ok(SiteTracks { points: lock(&live.tracks).latest(), last_event })
    }

    /// Where a target was, oldest first, as far back as the history reaches.
    ///
    /// # Errors
    /// `SiteNotFound`; `TrackNotFound` if the track has ended.
    pub async fn world_track_history(&self, id: &SiteId, track: LiveId) -> Result<Vec<Arc<WorldTrackPoint>>> {
        let site = self.active_site(id).await?;
        let history = lock(&site.live.tracks).history(track);
        history.ok_or_else(|| {
            let message = format!("site {id} has no world track {track} now");
            Error::refused(ErrorKind::TrackNotFound, message)
        })
    }

    /// What happens at a site: behind an event, or from now on.
    ///
    /// # Errors
    /// `SiteNotFound`.
    pub async fn site_events(&self, id: &SiteId, after: Option<LiveId>) -> Result<SiteEvents> {
        let site = self.active_site(id).await?;
        Ok(SiteEvents::new(site.live.clone(), after, self.metrics.clone()))
    }

    /// A site in memory; looks into the store for one that another process has created.
    async fn active_site(&self, id: &SiteId) -> Result<Arc<ActiveSite>> {
        match self.site_registry.get(id) {
            Some(site) => Ok(site),
            None => self.site_registry.refresh_site(&self.store, id).await,
        }
    }
}
