//! The path of one track, from its first estimate to the rows of the archive.

use jiff::{SignedDuration, Timestamp};

use crate::domain::{
    ArchivedPosition, HistorySettings, TRACK_GAP, TargetClass, TargetId, TrackScope, Velocity,
};
use crate::fusion::smoother::{FilterMoments, FilteredState, PathState, TrackPath};
use crate::geo::{LocalPlane, METRES_PER_DEGREE, PlaneCovariance, Position};

/// Time after an instant in which later estimates still improve its smoothed state (docs/explanation/method.md).
const LAG: SignedDuration = SignedDuration::from_secs(10);
/// Time of which the path of a track that goes on is written at once.
const WINDOW: SignedDuration = SignedDuration::from_secs(20);

/// An estimate of a track, with what names its target.
pub(in crate::app) struct RecordedState<'a> {
    /// The track's id in its scope; `None` to name it by its target and its first instant.
    pub(in crate::app) track: Option<String>,
    pub(in crate::app) target: Option<&'a TargetId>,
    pub(in crate::app) class: Option<&'a TargetClass>,
    pub(in crate::app) time: Timestamp,
    pub(in crate::app) position: Position,
    pub(in crate::app) velocity: Velocity,
    /// m2.
    pub(in crate::app) covariance: PlaneCovariance,
    /// m2/s2.
    pub(in crate::app) velocity_covariance: PlaneCovariance,
    pub(in crate::app) stationary_probability: f64,
    pub(in crate::app) moments: FilterMoments,
    /// True if the track begins again with this estimate.
    pub(in crate::app) is_restarted: bool,
}

/// The estimates of one track so far, or as far as they are needed still.
#[derive(Clone)]
pub(super) struct RecordedPath {
    track: String,
    target: Option<TargetId>,
    class: Option<TargetClass>,
    plane: LocalPlane,
    path: TrackPath,
    /// Everything before this instant has been queued.
    queued_until: Option<Timestamp>,
}

/// A track that has ended, or what is certain of one that goes on.
pub(in crate::app) struct FinishedTrack {
    pub(in crate::app) scope: TrackScope,
    pub(super) settings: HistorySettings,
    pub(super) path: RecordedPath,
    /// Of a track that goes on: states from this instant on are smoothed later.
    pub(super) until: Option<Timestamp>,
}

impl RecordedPath {
    pub(super) fn start(state: &RecordedState<'_>, most_bytes: usize) -> Self {
        let by_target = || {
            let target = state.target.map_or("", TargetId::as_str);
            format!("{target}@{}", state.time.as_millisecond())
        };
        Self {
            track: state.track.clone().unwrap_or_else(by_target),
            target: None,
            class: None,
            plane: LocalPlane::new(state.position),
            path: TrackPath::new(most_bytes),
            queued_until: None,
        }
    }

    pub(super) fn is_continued_by(&self, state: &RecordedState<'_>) -> bool {
        let Some(latest) = self.path.latest() else { return true };
        let step = state.time.duration_since(latest.time);
        let is_same = state.track.as_ref().is_none_or(|track| self.track == *track);
        is_same
            && !state.is_restarted
            && (SignedDuration::ZERO..TRACK_GAP).contains(&step)
            && self.plane.to_plane_within_range(state.position).is_some()
    }

    pub(super) fn push(&mut self, state: &RecordedState<'_>) {
        self.target = state.target.cloned().or(self.target.take());
        self.class = state.class.cloned().or(self.class.take());
        self.path.push(FilteredState {
            time: state.time,
            position: self.plane.to_plane(state.position),
            velocity: state.velocity,
            covariance: state.covariance,
            velocity_covariance: state.velocity_covariance,
            stationary_probability: state.stationary_probability,
            moments: state.moments,
        });
    }

    /// The end of what can be smoothed and written, once that is a window.
    pub(super) fn settled_until(&self) -> Option<Timestamp> {
        let (first, latest) = (self.path.first()?, self.path.latest()?);
        let from = self.queued_until.unwrap_or(first.time);
        let is_window = latest.time.duration_since(from) >= WINDOW + LAG;
        latest.time.checked_sub(LAG).ok().filter(|_| is_window)
    }

    /// The path goes on after an instant before which everything is queued.
    pub(super) fn continue_from(&mut self, time: Timestamp) {
        self.path.forget_before(time);
        self.queued_until = Some(time);
    }
}

impl FinishedTrack {
    /// The rows of the smoothed path that were not queued before.
    pub(super) fn rows(&self) -> Vec<ArchivedPosition> {
        let RecordedPath { track, target, class, plane, path, queued_until } = &self.path;
        let mesh_m = self.settings.coarsen_m();
        let row = |state: PathState| {
            let (position, covariance_m2) = coarsened(plane, &state, mesh_m);
            ArchivedPosition {
                time: state.time,
                track: track.clone(),
                target: target.clone(),
                class: class.clone(),
                position,
                covariance_m2,
                motion: state.motion(),
                acceleration: state.acceleration,
            }
        };
        let is_due = |state: &PathState| {
            queued_until.is_none_or(|from| state.time >= from)
                && self.until.is_none_or(|until| state.time < until)
        };
        path.smoothed().into_iter().filter(is_due).map(row).collect()
    }
}

/// The position at the nearest knot of a grid, with the variance of the rounding. The grid is one of degrees: it does
/// not depend on the track, which would tell where it began.
fn coarsened(plane: &LocalPlane, state: &PathState, mesh_m: f64) -> (Position, PlaneCovariance) {
    let exact = plane.to_position(state.position);
    if mesh_m <= 0.0 {
        return (exact, state.covariance);
    }
    let mesh_deg = mesh_m / METRES_PER_DEGREE;
    let knot = |degrees: f64, mesh_deg: f64| (degrees / mesh_deg).round() * mesh_deg;
    let latitude_deg = knot(exact.latitude_deg(), mesh_deg).clamp(-90.0, 90.0);
    let east_mesh_deg = mesh_deg / latitude_deg.to_radians().cos().max(1e-6);
    let longitude_deg = knot(exact.longitude_deg(), east_mesh_deg).clamp(-180.0, 180.0);
    let rounding = PlaneCovariance::isotropic(mesh_m * mesh_m / 12.0);
    let position = Position::new(longitude_deg, latitude_deg).unwrap_or(exact);
    (position, state.covariance.plus(rounding))
}
