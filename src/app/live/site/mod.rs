//! World tracks of a site: one set of tracks, fed by all its cameras.
//!
//! Answers put what they measured into a bounded queue and never wait; one task per site assembles frames, runs
//! the world tracker and publishes its tracks and events. Everything is in memory: tracks describe the present.

mod clocks;
mod events;
mod feed;
mod item;
mod places;
mod published;
mod reader;
mod rounds;
pub(in crate::app) mod state;
mod task;
mod tracker;

use std::sync::Arc;

use super::sync::lock;
use crate::app::App;
use crate::app::cluster::Nodes;
use crate::app::site_registry::{ActiveSite, SiteRegistry};
use crate::domain::{Error, ErrorKind, LiveId, Result, SiteId};
use crate::store::Store;
use crate::telemetry::Metrics;

pub use clocks::SiteClocks;
pub use events::{SiteEvent, SiteEventKind};
pub use published::{WorldSighting, WorldTrackPoint};
pub use reader::{LossReason, LostSiteEvents, SiteEvents, StoredSiteEvent};

/// The tracks of a site at one instant.
#[derive(Debug)]
pub struct SiteTracks {
    /// The latest point of every track, in the order of the ids.
    pub points: Vec<Arc<WorldTrackPoint>>,
    /// How late the clocks of its cameras and receivers are.
    pub clocks: SiteClocks,
    /// The event after which a reader misses nothing that is not among the points.
    pub last_event: LiveId,
}

/// The world tracks of sites, for readers.
#[derive(Clone, Copy)]
pub struct WorldTracks<'a> {
    store: &'a Store,
    site_registry: &'a SiteRegistry,
    nodes: Nodes<'a>,
    metrics: &'a Metrics,
}

impl App {
    /// The world tracks of sites, for readers.
    #[must_use]
    pub fn world_tracks(&self) -> WorldTracks<'_> {
        WorldTracks {
            store: &self.store,
            site_registry: &self.site_registry,
            nodes: self.nodes(),
            metrics: &self.metrics,
        }
    }
}

impl WorldTracks<'_> {
    /// Where every target of a site is now.
    ///
    /// # Errors
    /// `SiteNotFound`, `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub async fn latest(&self, id: &SiteId) -> Result<SiteTracks> {
        let live = &self.readable_site(id).await?.live;
        // The event first: what is published in between is in both.
        let last_event = live.id_of(live.events.latest());
        let (points, clocks) = (lock(&live.tracks).latest(), lock(&live.clocks).clone());
        Ok(SiteTracks { points, clocks, last_event })
    }

    /// Where a target was, oldest first, as far back as the history reaches.
    ///
    /// # Errors
    /// As [`WorldTracks::latest`]; `TrackNotFound` if the track has ended.
    pub async fn history(&self, id: &SiteId, track: LiveId) -> Result<Vec<Arc<WorldTrackPoint>>> {
        let site = self.readable_site(id).await?;
        let history = lock(&site.live.tracks).history(track);
        history.ok_or_else(|| {
            let message = format!("site {id} has no world track {track} now");
            Error::refused(ErrorKind::TrackNotFound, message)
        })
    }

    /// The events of a site: after an event, or from now on.
    ///
    /// # Errors
    /// As [`WorldTracks::latest`].
    pub async fn events(&self, id: &SiteId, after: Option<LiveId>) -> Result<SiteEvents> {
        let site = self.readable_site(id).await?;
        let watch = self.nodes.watch_site_owner(site.key);
        Ok(SiteEvents::new(site.live.clone(), after, watch, self.metrics.clone()))
    }

    /// A site whose live state is read.
    pub(in crate::app) async fn readable_site(&self, id: &SiteId) -> Result<Arc<ActiveSite>> {
        let site = self.active_site(id).await?;
        self.nodes.check_site_readable(id, site.key).await?;
        // Its live state may be a new one.
        self.active_site(id).await
    }

    /// A site in memory; looks into the store for one that another process has created.
    async fn active_site(&self, id: &SiteId) -> Result<Arc<ActiveSite>> {
        match self.site_registry.get(id) {
            Some(site) => Ok(site),
            None => self.site_registry.refresh_site(self.store, id).await,
        }
    }
}
