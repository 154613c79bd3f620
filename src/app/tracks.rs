//! Live tracks: the sequence fusion of every target that is being watched, per camera.
//!
//! Tracks live in memory: they are what is known now, made of what is stored or streamed. What
//! never happens here: waiting for the database while an observation is answered.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use futures_util::Stream;
use jiff::Timestamp;
use tokio::sync::broadcast;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::BroadcastStream;

use super::App;
use crate::domain::{CameraId, Error, ErrorKind, FusedFix, Observation, Result, TargetId};
use crate::fusion::PlaneCovariance;
use crate::fusion::track::{Measured, Measurement, Rejection, Track, TrackSettings, TrackState, Velocity};
use crate::fusion::two_step::UNKNOWN_RECEIVER_M2;
use crate::geo::{LocalPlane, Position};

/// Points that a slow reader of events may lag behind before it loses some.
const EVENTS_BEHIND: usize = 256;

/// Where a target is by its track, at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackPoint {
    /// Who.
    pub target_id: TargetId,
    /// When.
    pub time: Timestamp,
    /// Where.
    pub position: Position,
    /// How fast and where to, m/s.
    pub velocity: Velocity,
    /// Covariance of the position's error, m2.
    pub covariance: PlaneCovariance,
    /// Radius about `position` that holds the truth with 95 % probability, m.
    pub r95_m: f64,
    /// Normalised innovation squared of what was taken up, by its degrees of freedom (2 each).
    pub nis: Option<f64>,
    /// What was not taken up, and why.
    pub rejected: Vec<Rejection>,
    /// Whether the track began anew.
    pub restarted: bool,
}

/// The tracks of all cameras.
#[derive(Default)]
pub struct Tracks {
    cameras: Mutex<HashMap<CameraId, Arc<CameraTracks>>>,
}

struct CameraTracks {
    /// Of the first position: models come and go, the tracks stay in their plane.
    plane: OnceLock<LocalPlane>,
    targets: Mutex<HashMap<TargetId, Live>>,
    points: broadcast::Sender<Arc<TrackPoint>>,
}

struct Live {
    track: Track,
    history: VecDeque<Arc<TrackPoint>>,
}

impl Tracks {
    fn of(&self, id: &CameraId) -> Arc<CameraTracks> {
        let mut cameras = lock(&self.cameras);
        cameras.entry(id.clone()).or_insert_with(|| Arc::new(CameraTracks::new())).clone()
    }

    /// Forgets the tracks of a deleted camera.
    pub(super) fn forget(&self, id: &CameraId) {
        lock(&self.cameras).remove(id);
    }
}

impl CameraTracks {
    fn new() -> Self {
        Self {
            plane: OnceLock::new(),
            targets: Mutex::default(),
            points: broadcast::channel(EVENTS_BEHIND).0,
        }
    }
}

impl App {
    /// Takes an answered observation up into its target's track; `None` without a target.
    ///
    /// # Errors
    /// `Overloaded` if the camera has as many tracks as it may and none of them is gone.
    pub async fn track(
        &self,
        id: &CameraId,
        observation: &Observation,
        fused: &FusedFix,
    ) -> Result<Option<Arc<TrackPoint>>> {
        let Some(target) = &observation.target_id else { return Ok(None) };
        let camera = self.tracks.of(id);
        let plane = camera.plane.get_or_init(|| LocalPlane::new(fused.fused));
        let measured =
            |position: Position, variance_m2: f64| Measured::isotropic(plane.to_plane(position), variance_m2);
        let measurement = Measurement {
            time: observation.time,
            fix: fused.gnss.map(|fix| measured(fix.position, fused.e_gnss_m2.unwrap_or(UNKNOWN_RECEIVER_M2))),
            regressed: fused.regressed.zip(fused.e_regression_m2).map(|(position, e)| measured(position, e)),
        };
        let mut targets = lock(&camera.targets);
        let state = match targets.get_mut(target) {
            Some(live) if !live.track.is_gone(observation.time) => live.track.update(&measurement),
            Some(live) => {
                let Some((track, state)) = start(&measurement) else { return Ok(None) };
                live.track = track;
                state
            }
            None => {
                make_room(&mut targets, self.limits.tracks_per_camera, observation.time)?;
                let Some((track, state)) = start(&measurement) else { return Ok(None) };
                targets.insert(target.clone(), Live { track, history: VecDeque::new() });
                state
            }
        };
        let point = Arc::new(point_of(target, &state, plane));
        if let Some(live) = targets.get_mut(target) {
            if live.history.len() >= self.limits.track_points {
                live.history.pop_front();
            }
            live.history.push_back(point.clone());
        }
        drop(targets);
        self.metrics.tracked(point.nis, point.rejected.len() as u64);
        // Without a listener there is nobody to tell.
        let _ = camera.points.send(point.clone());
        Ok(Some(point))
    }

    /// Where every target of a camera is now, by target; those gone are left out.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn tracks(&self, id: &CameraId) -> Result<Vec<Arc<TrackPoint>>> {
        self.serving(id).await?;
        let now = self.clock.now();
        let camera = self.tracks.of(id);
        let mut targets = lock(&camera.targets);
        targets.retain(|_, live| !live.track.is_gone(now) || live.track.measured_at() > now);
        let mut points: Vec<_> = targets.values().filter_map(|live| live.history.back().cloned()).collect();
        points.sort_by(|a, b| a.target_id.cmp(&b.target_id));
        Ok(points)
    }

    /// Where a target was, oldest first, as far back as is kept.
    ///
    /// # Errors
    /// `CameraNotFound`, `TrackNotFound`.
    pub async fn track_history(&self, id: &CameraId, target: &TargetId) -> Result<Vec<Arc<TrackPoint>>> {
        self.serving(id).await?;
        let camera = self.tracks.of(id);
        let targets = lock(&camera.targets);
        let live = targets.get(target).ok_or_else(|| {
            Error::refused(ErrorKind::TrackNotFound, format!("camera {id} does not follow a target {target}"))
        })?;
        Ok(live.history.iter().cloned().collect())
    }

    /// Every new point of a camera's tracks, from now on. A reader that is too slow loses the
    /// oldest of what it has not read, never the newest.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn watch_tracks(
        &self,
        id: &CameraId,
    ) -> Result<impl Stream<Item = Arc<TrackPoint>> + Send + use<>> {
        self.serving(id).await?;
        let points = self.tracks.of(id).points.subscribe();
        Ok(BroadcastStream::new(points).filter_map(std::result::Result::ok))
    }
}

fn start(measurement: &Measurement) -> Option<(Track, TrackState)> {
    let track = Track::start(TrackSettings::default(), measurement)?;
    let state = track.state_at(measurement.time);
    Some((track, state))
}

/// Drops tracks that are gone, if there is no room for another.
fn make_room(targets: &mut HashMap<TargetId, Live>, most: usize, now: Timestamp) -> Result<()> {
    if targets.len() >= most {
        targets.retain(|_, live| !live.track.is_gone(now));
    }
    if targets.len() >= most {
        return Err(Error::refused(
            ErrorKind::Overloaded,
            format!("the camera follows {most} targets already; ids that change with every frame do that"),
        ));
    }
    Ok(())
}

fn point_of(target: &TargetId, state: &TrackState, plane: &LocalPlane) -> TrackPoint {
    TrackPoint {
        target_id: target.clone(),
        time: state.time,
        position: plane.to_position(state.position),
        velocity: state.velocity,
        covariance: state.covariance,
        r95_m: state.r95_m,
        nis: state.nis,
        rejected: state.rejected.clone(),
        restarted: state.restarted,
    }
}

/// A panic elsewhere leaves tracks as they are: each update is whole or not begun.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
