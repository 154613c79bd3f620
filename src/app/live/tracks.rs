//! The tracks of one camera's targets, and what was seen of them lately.
//!
//! Each target has a lock of its own, so that streams do not wait for each other's filters. What
//! never happens here: waiting for anything else, and growth beyond the limits.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, OnceLock};

use jiff::{SignedDuration, Timestamp};

use super::lock;
use crate::config::Limits;
use crate::domain::{CameraId, Error, ErrorKind, Observation, Result, TargetId};
use crate::fusion::drift_detector::{ResidualSample, TimeAligner, TimedEstimate};
use crate::fusion::track::{MeasuredPosition, Measurement, Track, TrackSettings, TrackState};
use crate::geo::{LocalPlane, Position};
use crate::model::Regressor;

/// Points of a history are at least this far apart in time; the latest is always there.
const HISTORY_STEP: SignedDuration = SignedDuration::from_millis(500);

/// Where a target is by its track, at the latest instant measured.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackPoint {
    /// Who.
    pub target_id: TargetId,
    /// Where.
    pub position: Position,
    /// All that the track says, in the camera's plane.
    pub state: TrackState,
}

/// Everything that is followed in one camera's view.
#[derive(Default)]
pub(super) struct Tracks {
    /// Of the first position: models come and go, the tracks stay in their plane.
    plane: OnceLock<LocalPlane>,
    targets: Mutex<HashMap<TargetId, Arc<Mutex<Target>>>>,
}

/// A place for a target; empty until something usable was measured of it.
#[derive(Default)]
struct Target(Option<Followed>);

struct Followed {
    track: Track,
    /// By the server's clock.
    heard_at: Timestamp,
    /// In order of time; the last is the latest.
    history: VecDeque<Arc<TrackPoint>>,
    meeting: TimeAligner,
}

/// One instant of one target, ready to be taken up.
pub(super) struct Seen<'a> {
    pub(super) target_id: &'a TargetId,
    pub(super) observation: &'a Observation,
    pub(super) regressor: Option<&'a Regressor>,
    /// Error variance per axis of the fix, m2.
    pub(super) e_gnss_m2: f64,
    /// By the server's clock.
    pub(super) now: Timestamp,
}

impl Tracks {
    /// Takes up what was seen; `None` for what is not usable. With it comes what box and fix say of
    /// the same instant, if now both are known.
    ///
    /// # Errors
    /// `Overloaded` if as many targets are followed as may be, none of them gone.
    pub(super) fn take_up(
        &self,
        id: &CameraId,
        seen: &Seen<'_>,
        limits: &Limits,
    ) -> Result<(Option<Arc<TrackPoint>>, Option<ResidualSample>)> {
        let Some((plane, measurement)) = self.measurement(seen) else { return Ok((None, None)) };
        let target = self.target(id, seen, limits.tracks_per_camera)?;
        let mut target = lock(&target);
        let state = match &mut target.0 {
            Some(followed) if !followed.track.is_expired(measurement.time) => {
                followed.track.update(&measurement)
            }
            gone_or_new => {
                let settings = seen.regressor.map_or_else(TrackSettings::default, TrackSettings::from_model);
                let Some(track) = Track::start(settings, &measurement) else { return Ok((None, None)) };
                let state = track.state_at(measurement.time);
                *gone_or_new = Some(Followed::new(track, seen.now));
                state
            }
        };
        let Some(followed) = &mut target.0 else { return Ok((None, None)) };
        followed.heard_at = seen.now;
        let position = plane.to_position(state.position);
        let point = Arc::new(TrackPoint { target_id: seen.target_id.clone(), position, state });
        followed.remember(&point, limits.track_points);
        let compared = compare(&mut followed.meeting, seen.target_id, &measurement);
        Ok((Some(point), compared))
    }

    /// Where every target is that is not gone, by target.
    pub(super) fn latest(&self, now: Timestamp) -> Vec<Arc<TrackPoint>> {
        let targets = self.present(now);
        let mut points: Vec<_> =
            targets.iter().filter_map(|target| lock(target).0.as_ref()?.history.back().cloned()).collect();
        points.sort_by(|a, b| a.target_id.cmp(&b.target_id));
        points
    }

    /// Where a target was, oldest first, as far back as is kept; `None` if it is not followed.
    pub(super) fn history(&self, target_id: &TargetId, now: Timestamp) -> Option<Vec<Arc<TrackPoint>>> {
        drop(self.present(now));
        let target = lock(&self.targets).get(target_id).cloned()?;
        let target = lock(&target);
        Some(target.0.as_ref()?.history.iter().cloned().collect())
    }

    /// The target's place, made if there is room for it.
    fn target(&self, id: &CameraId, seen: &Seen<'_>, most: usize) -> Result<Arc<Mutex<Target>>> {
        let mut targets = lock(&self.targets);
        if let Some(target) = targets.get(seen.target_id) {
            return Ok(target.clone());
        }
        if targets.len() >= most {
            drop_gone(&mut targets, seen.now);
        }
        if targets.len() >= most {
            let message = format!(
                "camera {id} follows {most} targets already; target ids that change with every frame do that"
            );
            return Err(Error::refused(ErrorKind::Overloaded, message));
        }
        Ok(targets.entry(seen.target_id.clone()).or_default().clone())
    }

    /// The targets that are not gone.
    fn present(&self, now: Timestamp) -> Vec<Arc<Mutex<Target>>> {
        let mut targets = lock(&self.targets);
        drop_gone(&mut targets, now);
        targets.values().cloned().collect()
    }

    /// The plane of all tracks and comparisons; about the first position that is asked for.
    pub(super) fn plane(&self, anywhere: Position) -> &LocalPlane {
        self.plane.get_or_init(|| LocalPlane::new(anywhere))
    }

    fn measurement(&self, seen: &Seen<'_>) -> Option<(&LocalPlane, Measurement)> {
        let Observation { time, bounding_box, fix, .. } = seen.observation;
        // From the box alone, also where the recipe could look at the fix: the track must not be
        // told the fix twice.
        let regression = bounding_box
            .as_ref()
            .zip(seen.regressor)
            .map(|(drawn, regressor)| (regressor.plane(), regressor.regress(drawn, None)));
        let regressed = regression.map(|(plane, it)| (plane.to_position(it.regressed), it.variance_m2()));
        let anywhere = fix.map(|fix| fix.position).or(regressed.map(|(position, _)| position))?;
        let plane = self.plane(anywhere);
        let measured =
            |(position, variance_m2)| MeasuredPosition::isotropic(plane.to_plane(position), variance_m2);
        let measurement = Measurement {
            time: *time,
            fix: fix.map(|fix| measured((fix.position, seen.e_gnss_m2))),
            regressed: regressed.map(measured),
        };
        Some((plane, measurement))
    }
}

/// By the server's clock, for recorded times may be of any year; and by the latest time told, for
/// recordings may be played fast.
fn drop_gone(targets: &mut HashMap<TargetId, Arc<Mutex<Target>>>, now: Timestamp) {
    let measured_at = |target: &Arc<Mutex<Target>>| Some(lock(target).0.as_ref()?.track.measured_at());
    let told = targets.values().filter_map(measured_at).max();
    targets.retain(|_, target| {
        let target = lock(target);
        target.0.as_ref().is_some_and(|followed| {
            let silent_s = now.duration_since(followed.heard_at).as_secs_f64();
            let gone = told.is_some_and(|told| followed.track.is_expired(told));
            !gone && silent_s <= followed.track.settings().time_to_live_s
        })
    });
}

impl Followed {
    fn new(track: Track, now: Timestamp) -> Self {
        Self { track, heard_at: now, history: VecDeque::new(), meeting: TimeAligner::default() }
    }

    /// Keeps the latest point, and before it only points some time apart.
    fn remember(&mut self, point: &Arc<TrackPoint>, most: usize) {
        let time = |at: usize| self.history.get(at).map(|point| point.state.time);
        let last = self.history.len().saturating_sub(1);
        let too_near = time(last)
            .zip(last.checked_sub(1).and_then(time))
            .is_some_and(|(latest, before)| latest.duration_since(before) < HISTORY_STEP);
        if too_near {
            self.history.pop_back();
        }
        while self.history.len() >= most.max(2) {
            self.history.pop_front();
        }
        self.history.push_back(point.clone());
    }
}

fn compare(
    meeting: &mut TimeAligner,
    target_id: &TargetId,
    measurement: &Measurement,
) -> Option<ResidualSample> {
    let spot = |measured: MeasuredPosition| TimedEstimate {
        time: measurement.time,
        position: measured.position,
        variance_m2: measured.covariance.per_axis_m2(),
    };
    let by_box = measurement.regressed.and_then(|measured| meeting.push_regressed(spot(measured)));
    let by_fix = measurement.fix.and_then(|measured| meeting.push_fix(spot(measured)));
    let (regressed, fix) = by_box.or(by_fix)?;
    Some(ResidualSample {
        time: fix.time,
        target_id: target_id.clone(),
        regressed: regressed.position,
        fix: fix.position,
        e_regression_m2: regressed.variance_m2,
        e_gnss_m2: fix.variance_m2,
    })
}
