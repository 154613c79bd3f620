//! Live: every target of a camera followed as boxes and fixes come, samples kept, the camera watched.
//!
//! Tracks live in memory, for they are what is known now. What never happens here: waiting for the
//! database while a position is answered (only samples that are kept and alarms that are raised go
//! there), and state that an outside client can make grow beyond the limits.

mod keeping;
mod stream;
mod tracks;
mod watching;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use tokio::sync::{broadcast, watch};

use self::keeping::Keeping;
use self::stream::Places;
use self::tracks::{Seen, Tracks};
use self::watching::Watching;
use super::App;
use super::fusion::fuse_one;
use super::registry::Serving;
use crate::domain::{CameraId, CameraMoved, Error, ErrorKind, FusedFix, Observation, Result, TargetId};
use crate::fusion::two_step;

pub use stream::{LiveStream, Moves};
pub use tracks::TrackPoint;

/// Events that a slow reader may lag behind before it loses some.
const EVENTS_BEHIND: usize = 256;

/// What happens in a camera's view.
#[derive(Debug, Clone)]
pub enum CameraEvent {
    /// A target is somewhere else.
    Track(Arc<TrackPoint>),
    /// The camera no longer looks where it looked.
    Moved(Arc<CameraMoved>),
}

/// What is live, of all cameras.
#[derive(Default)]
pub struct Live {
    cameras: Mutex<HashMap<CameraId, Arc<CameraLive>>>,
    places: Places,
}

/// What is live of one camera.
struct CameraLive {
    tracks: Tracks,
    watching: Watching,
    events: broadcast::Sender<CameraEvent>,
    moved: watch::Sender<Option<Arc<CameraMoved>>>,
    keeping: Mutex<Weak<Keeping>>,
}

impl Live {
    fn of(&self, id: &CameraId) -> Arc<CameraLive> {
        let mut cameras = lock(&self.cameras);
        match cameras.get(id) {
            Some(live) => live.clone(),
            None => cameras.entry(id.clone()).or_insert_with(CameraLive::new).clone(),
        }
    }

    /// Forgets a deleted camera.
    pub(super) fn forget(&self, id: &CameraId) {
        lock(&self.cameras).remove(id);
    }
}

impl CameraLive {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            tracks: Tracks::default(),
            watching: Watching::default(),
            events: broadcast::channel(EVENTS_BEHIND).0,
            moved: watch::channel(None).0,
            keeping: Mutex::new(Weak::new()),
        })
    }

    fn tell_moved(&self, moved: Arc<CameraMoved>) {
        // Without a listener there is nobody to tell.
        let _ = self.events.send(CameraEvent::Moved(moved.clone()));
        self.moved.send_replace(Some(moved));
    }
}

/// What became of one observation that was followed.
#[derive(Debug, Clone)]
pub struct Followed {
    /// Its own position; `None` for a box while the camera has no model.
    pub fused: Option<FusedFix>,
    /// The target's track with it; `None` without a target or anything usable.
    pub track: Option<Arc<TrackPoint>>,
}

impl App {
    /// Answers an observation, takes it up into its target's track and compares box and fix.
    ///
    /// # Errors
    /// `CameraNotFound`; `Overloaded` if the camera follows as many targets as it may.
    pub async fn follow(&self, id: &CameraId, observation: &Observation) -> Result<Followed> {
        let serving = self.serving(id).await?;
        let live = self.live.of(id);
        self.follow_in(&live, id, &serving, observation).await
    }

    async fn follow_in(
        &self,
        live: &CameraLive,
        id: &CameraId,
        serving: &Serving,
        observation: &Observation,
    ) -> Result<Followed> {
        let fused = fuse_one(serving, observation);
        self.metrics.fused(fused.as_slice());
        let Some(target_id) = &observation.target_id else { return Ok(Followed { fused, track: None }) };
        let model = serving.model.as_ref().map(|(regressor, version)| (&**regressor, *version));
        let e_gnss_m2 =
            two_step::fix_variance_m2(observation, model.map(|(regressor, _)| regressor), serving.e_gnss_m2);
        let seen = Seen {
            target_id,
            observation,
            regressor: model.map(|(regressor, _)| regressor),
            e_gnss_m2,
            now: self.clock.now(),
        };
        let (track, compared) = live.tracks.take_up(id, &seen, &self.limits)?;
        if let Some(point) = &track {
            self.metrics.tracked(point.state.innovations.iter().map(|it| it.nis), &point.state.rejected);
            // Without a listener there is nobody to tell.
            let _ = live.events.send(CameraEvent::Track(point.clone()));
        }
        if let (Some(model), Some(compared)) = (model, compared) {
            self.compare(id, live, model, &compared).await;
        }
        Ok(Followed { fused, track })
    }

    /// Where every target of a camera is now, by target; those gone are left out.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn tracks(&self, id: &CameraId) -> Result<Vec<Arc<TrackPoint>>> {
        self.serving(id).await?;
        let live = self.live.of(id);
        let points = live.tracks.latest(self.clock.now());
        Ok(points)
    }

    /// Where a target was, oldest first, as far back as is kept.
    ///
    /// # Errors
    /// `CameraNotFound`, `TrackNotFound`.
    pub async fn track_history(&self, id: &CameraId, target_id: &TargetId) -> Result<Vec<Arc<TrackPoint>>> {
        self.serving(id).await?;
        let live = self.live.of(id);
        let history = live.tracks.history(target_id, self.clock.now());
        history.ok_or_else(|| {
            let message = format!("camera {id} does not follow a target {target_id} now");
            Error::refused(ErrorKind::TrackNotFound, message)
        })
    }

    /// Everything that happens in a camera's view from now on. A reader that is too slow misses the
    /// oldest of what it has not read.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn camera_events(&self, id: &CameraId) -> Result<broadcast::Receiver<CameraEvent>> {
        self.serving(id).await?;
        Ok(self.live.of(id).events.subscribe())
    }

    /// Whether a camera's active model no longer fits what the camera sees.
    #[must_use]
    pub fn camera_moved(&self, id: &CameraId) -> Option<Arc<CameraMoved>> {
        self.registry.get(id)?.moved.clone()
    }
}

/// A panic elsewhere leaves the state as it is: each change is whole or not begun.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
