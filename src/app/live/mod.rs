//! Live: every target of a camera is tracked as boxes and fixes come, samples are recorded, and drift of
//! the camera is detected.
//!
//! Tracks live in memory, for they describe the present. A position is never answered late for the
//! database: samples and alarms go there by tasks of their own. What an outside client can make large is
//! bounded by the limits.

#[cfg(test)]
mod acknowledgement_schedules;
mod acknowledgements;
mod alarms;
pub(super) mod camera;
mod camera_events;
mod drift;
mod event_log;
mod history;
mod identification;
mod learning;
mod matching;
mod retraining;
mod sample_committer;
mod sample_recorder;
mod sink_feeds;
pub(super) mod site;
mod stream;
pub(super) mod sync;
mod tracks;

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tokio_util::task::TaskTracker;

use self::camera::CameraLive;
use self::camera_events::CameraEventReader;
use self::identification::Identified;
use self::sync::lock;
use self::tracks::TargetObservation;
use super::App;
use super::active_cameras::ActiveCameras;
use super::cluster::{CameraLease, Nodes, Watch};
use super::fusion::fuse_for_camera;
use super::history::queue::ArchivedHistory;
use super::history::recorder::TrackRecorder;
use super::places::PlaceMonitor;
use super::registry::ActiveCamera;
use super::site_registry::SiteRegistry;
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{
    CameraId, Error, ErrorKind, FusedFix, HistorySettings, LiveId, Observation, ReceiverMatch, Result,
    TargetId, TrackScope,
};
use crate::exchange::RowRules;
use crate::fusion::observed::ObservedPositions;
use crate::telemetry::Metrics;

pub use acknowledgements::{Acknowledgement, NotStored, NotStoredReason};
pub(super) use alarms::{ResidualQueue, residual_queue};
pub use camera::{CameraEvent, TargetUpdate, UnplacedBox};
pub use camera_events::{EventId, LostEvents};
pub(super) use identification::MatchingSlot;
pub(super) use learning::LearningProgress;
pub(super) use retraining::RetrainSchedule;
pub use retraining::Retraining;
pub use sink_feeds::{SinkFeed, SinkFeeds, SinkPosition, WantedEvents, WantedPositions};
pub use site::{
    LossReason, LostSiteEvents, SiteClocks, SiteEvent, SiteEventKind, SiteEvents, SiteTracks,
    StoredSiteEvent, WorldSighting, WorldTrackPoint, WorldTracks,
};
pub(super) use stream::StreamSlots;
pub use stream::{ChangeNotices, LiveStream};
pub use tracks::TrackPoint;

/// The result of one live observation.
#[derive(Debug, Clone)]
pub struct ItemResult {
    /// Its own position; `None` for a box while the camera has no model.
    pub fused: Option<FusedFix>,
    /// The target's track with it; `None` without a target or anything usable.
    pub track: Option<Arc<TrackPoint>>,
    /// The target's world track in the camera's site, as of the latest frame that was tracked there.
    pub world_track: Option<LiveId>,
    /// The receiver that the target of a box carries which came with a tracker's id alone, if it was matched.
    pub receiver_match: Option<ReceiverMatch>,
}

/// The activity in a camera's view, since the server was started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CameraActivity {
    /// Targets that are tracked now.
    pub targets: usize,
    /// Open live streams.
    pub streams: usize,
    /// When a live observation came last.
    pub last_observed_at: Option<Timestamp>,
    /// Since when every box has been the same to the pixel for longer than a standing target shows.
    pub frozen_since: Option<Timestamp>,
}

impl CameraActivity {
    /// That of a camera, with its targets only where the node owns it: a former owner does not know what the present
    /// one sees.
    pub(super) fn of(camera: &ActiveCamera, is_owned: bool, now: Duration) -> Self {
        let observed = camera.live.latest_observed();
        Self {
            targets: if is_owned { camera.live.tracks.latest(now).len() } else { 0 },
            streams: camera.live.open_streams(),
            last_observed_at: observed.last_at,
            frozen_since: observed.frozen_since,
        }
    }
}

/// The events of one camera from some instant on; they end when it is deleted, or another node has become its owner.
pub struct CameraEvents {
    reader: CameraEventReader<CameraEvent>,
    live: Arc<CameraLive>,
    watch: Watch,
}

impl CameraEvents {
    /// True if they have ended since they continue elsewhere: the reader should ask again.
    #[must_use]
    pub fn continue_elsewhere(&self) -> bool {
        self.watch.has_ended() || self.live.is_replaced()
    }

    /// The next event; `None` once the camera is deleted or goes on elsewhere.
    pub async fn next(&mut self) -> Option<Result<(EventId, Arc<CameraEvent>), LostEvents>> {
        tokio::select! {
            biased;
            () = self.live.deleted() => None,
            () = self.live.replaced() => None,
            () = self.watch.ended() => None,
            event = self.reader.next() => Some(event),
        }
    }
}

/// Targets as boxes and fixes come, and readers of where they are.
#[derive(Clone, Copy)]
pub struct Live<'a> {
    cameras: ActiveCameras<'a>,
    nodes: Nodes<'a>,
    places: &'a Arc<PlaceMonitor>,
    archived_history: &'a ArchivedHistory,
    site_registry: &'a SiteRegistry,
    sink_feeds: &'a SinkFeeds,
    residuals: &'a ResidualQueue,
    matching_slot: &'a MatchingSlot,
    tasks: &'a TaskTracker,
    clock: &'a Clock,
    limits: &'a Limits,
    metrics: &'a Metrics,
}

impl App {
    /// Targets as boxes and fixes come, and readers of where they are.
    #[must_use]
    pub fn live(&self) -> Live<'_> {
        Live {
            cameras: self.active_cameras(),
            nodes: self.nodes(),
            places: &self.place_monitor,
            archived_history: &self.archived_history,
            site_registry: &self.site_registry,
            sink_feeds: &self.sink_feeds,
            residuals: &self.residuals,
            matching_slot: &self.matching_slot,
            tasks: &self.tasks,
            clock: &self.clock,
            limits: &self.limits,
            metrics: &self.metrics,
        }
    }
}

impl Live<'_> {
    /// The rules for live observations of a camera.
    #[must_use]
    pub fn rules(&self, camera: &ActiveCamera) -> RowRules {
        let time_bounds = self.limits.live_time_bounds(self.clock.now());
        RowRules { time_bounds, image_size: camera.image_size }
    }

    /// Answers an observation, feeds its target's track and the tracker of the camera's site, and compares box
    /// and fix.
    ///
    /// # Errors
    /// `CameraBetweenNodes` if the lease has ended; `InvalidArgument` naming `time` for a time ahead of the
    /// server's clock; `Overloaded` if the camera has reached its limit of targets.
    pub fn follow(
        &self,
        (camera, lease): (&Arc<ActiveCamera>, &CameraLease),
        observation: Observation,
    ) -> Result<ItemResult> {
        // A time that no track takes must not move the matching either.
        let now = self.clock.now();
        self.limits.live_time_bounds(now).check(observation.time())?;
        let identified = self.identify(camera, observation);
        self.follow_identified((camera, lease), identified, now)
    }

    fn follow_identified(
        &self,
        (camera, lease): (&Arc<ActiveCamera>, &CameraLease),
        identified: Identified,
        observed_at: Timestamp,
    ) -> Result<ItemResult> {
        let now = self.clock.monotonic();
        lease.check(now)?;
        let Identified { observation, receiver_match, .. } = identified;
        let observation = &observation;
        let model = camera.model();
        let regressor = model.map(|(regressor, _)| regressor);
        let ActiveCamera { image_size, e_gnss_m2, .. } = **camera;
        // A box without a model measures nothing, so it makes no target.
        let measures = regressor.is_some() || observation.fix().is_some();
        let target = match observation.target_id().filter(|_| measures) {
            Some(id) => {
                Some(camera.live.tracks.target(&camera.id, id, now, self.limits.tracks_per_camera)?)
            }
            None => None,
        };
        let mut target = target.as_ref().map(|target| lock(target));
        let observed = match &mut target {
            Some(target) => target.observe(observation, regressor, image_size, e_gnss_m2),
            None => ObservedPositions::of(observation, regressor, image_size, e_gnss_m2, None),
        };
        let fused = fuse_for_camera(camera, observation, &observed);
        self.metrics.fused(fused.as_slice());
        camera.live.observed(observed_at, observed.regressed.map(|seen| seen.is_frozen));
        let world_track = self.feed_site(camera, observation, &observed);
        let (track, residual) = match (target, observation.target_id()) {
            (Some(mut target), Some(target_id)) => {
                let receiver_match = receiver_match.as_ref();
                let seen = TargetObservation { target_id, receiver_match, observed, model, now };
                let (point, residual) = target.update(&seen, self.limits);
                if let Some(point) = &point {
                    let recorder =
                        camera.history.map(|settings| move || self.track_recorder(&camera.id, settings));
                    target.record(point, observation.class(), recorder);
                }
                drop(target);
                (point, residual.or_else(|| camera.live.tracks.compared_with_fixes(&seen)))
            }
            _ => (None, None),
        };
        if let Some(point) = &track {
            self.metrics.tracked(point.state.innovations.iter().map(|it| it.nis), &point.state.rejected);
            self.sink_feeds.push(&camera.id, observation, point);
            if !self.is_fix_of_shown_carrier(camera, observation) {
                self.places.measured_by_camera(&camera.id, observation, point);
            }
            camera.live.announce_track(now, || TargetUpdate {
                point: point.clone(),
                bounding_box: observation.bounding_box(),
                fused: fused.clone(),
            });
        }
        if let Some(residual) = residual {
            self.residuals.hand_over(camera, residual);
        }
        Ok(ItemResult { fused, track, world_track, receiver_match })
    }

    fn track_recorder(&self, camera: &CameraId, settings: HistorySettings) -> TrackRecorder {
        TrackRecorder::new(
            self.archived_history.queue().clone(),
            TrackScope::Camera(camera.clone()),
            settings,
        )
    }

    /// Where every target of a camera is now, by target; those that expired are left out.
    ///
    /// # Errors
    /// `CameraNotFound`, `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub async fn tracks(&self, id: &CameraId) -> Result<Vec<Arc<TrackPoint>>> {
        let camera = self.readable_camera(id).await?;
        Ok(camera.live.tracks.latest(self.clock.monotonic()))
    }

    /// Where every target of a camera was, by target, each oldest first; those that expired are left out.
    ///
    /// # Errors
    /// As [`Live::tracks`].
    pub async fn track_histories(&self, id: &CameraId) -> Result<Vec<Vec<Arc<TrackPoint>>>> {
        let camera = self.readable_camera(id).await?;
        let now = self.clock.monotonic();
        let latest = camera.live.tracks.latest(now);
        Ok(latest.iter().filter_map(|point| camera.live.tracks.history(&point.target_id, now)).collect())
    }

    /// Where a target was, oldest first, as far back as the history reaches.
    ///
    /// # Errors
    /// As [`Live::tracks`]; `TrackNotFound`.
    pub async fn track_history(&self, id: &CameraId, target_id: &TargetId) -> Result<Vec<Arc<TrackPoint>>> {
        let camera = self.readable_camera(id).await?;
        let history = camera.live.tracks.history(target_id, self.clock.monotonic());
        history.ok_or_else(|| {
            let message = format!("camera {id} does not follow a target {target_id} now");
            Error::refused(ErrorKind::TrackNotFound, message)
        })
    }

    /// A camera whose live state is read.
    pub(in crate::app) async fn readable_camera(&self, id: &CameraId) -> Result<Arc<ActiveCamera>> {
        let camera = self.cameras.get(id).await?;
        self.nodes.check_readable(&camera).await?;
        // Its live state may be a new one.
        self.cameras.get(id).await
    }

    /// Everything that happens in a camera's view from now on, or after the last event that the reader has
    /// seen. A reader that is too slow, or was away for too long, misses the oldest of what it has not read.
    ///
    /// # Errors
    /// As [`Live::tracks`].
    pub async fn camera_events(&self, id: &CameraId, last_seen: Option<EventId>) -> Result<CameraEvents> {
        let camera = self.readable_camera(id).await?;
        let watch = self.nodes.watch_camera_owner(&camera);
        Ok(CameraEvents { reader: camera.live.events.reader(last_seen), live: camera.live.clone(), watch })
    }
}
