//! The tracks of one camera's targets, and what was seen of them lately.
//!
//! What never happens here: waiting, and growth beyond the limits.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use crate::config::Limits;
use crate::domain::{CameraId, Error, ErrorKind, Observation, Result, TargetId};
use crate::fusion::track::{Measured, Measurement, Track, TrackSettings, TrackState};
use crate::fusion::watch::{Compared, Meeting, Spot};
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
    plane: Option<LocalPlane>,
    targets: HashMap<TargetId, Followed>,
}

struct Followed {
    track: Track,
    /// By the server's clock.
    heard_at: Timestamp,
    latest: Arc<TrackPoint>,
    history: VecDeque<Arc<TrackPoint>>,
    meeting: Meeting,
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
        &mut self,
        id: &CameraId,
        seen: &Seen<'_>,
        limits: &Limits,
    ) -> Result<(Option<Arc<TrackPoint>>, Option<Compared>)> {
        let Some(measurement) = self.measurement(seen) else { return Ok((None, None)) };
        let state = match self.targets.get_mut(seen.target_id) {
            Some(followed) if !followed.track.is_gone(measurement.time) => {
                followed.heard_at = seen.now;
                followed.track.update(&measurement)
            }
            Some(followed) => {
                let Some((track, state)) = start(seen.regressor, &measurement) else {
                    return Ok((None, None));
                };
                followed.track = track;
                followed.heard_at = seen.now;
                followed.meeting = Meeting::default();
                state
            }
            None => {
                self.make_room(id, seen.now, limits.tracks_per_camera)?;
                let Some((track, state)) = start(seen.regressor, &measurement) else {
                    return Ok((None, None));
                };
                let latest = Arc::new(self.point(seen.target_id, state));
                let followed = Followed {
                    track,
                    heard_at: seen.now,
                    latest: latest.clone(),
                    history: VecDeque::from([latest.clone()]),
                    meeting: Meeting::default(),
                };
                let followed = self.targets.entry(seen.target_id.clone()).or_insert(followed);
                let compared = compare(&mut followed.meeting, seen.target_id, &measurement);
                return Ok((Some(latest), compared));
            }
        };
        let point = Arc::new(self.point(seen.target_id, state));
        let compared = self.targets.get_mut(seen.target_id).and_then(|followed| {
            followed.remember(&point, limits.track_points);
            compare(&mut followed.meeting, seen.target_id, &measurement)
        });
        Ok((Some(point), compared))
    }

    /// Where every target is that is not gone, by target.
    pub(super) fn latest(&mut self, now: Timestamp) -> Vec<Arc<TrackPoint>> {
        self.drop_gone(now);
        let mut points: Vec<_> = self.targets.values().map(|followed| followed.latest.clone()).collect();
        points.sort_by(|a, b| a.target_id.cmp(&b.target_id));
        points
    }

    /// Where a target was, oldest first, as far back as is kept; `None` if it is not followed.
    pub(super) fn history(&mut self, target_id: &TargetId, now: Timestamp) -> Option<Vec<Arc<TrackPoint>>> {
        self.drop_gone(now);
        let followed = self.targets.get(target_id)?;
        let mut points: Vec<_> = followed.history.iter().cloned().collect();
        if points.last().is_none_or(|last| last.state.time < followed.latest.state.time) {
            points.push(followed.latest.clone());
        }
        Some(points)
    }

    fn measurement(&mut self, seen: &Seen<'_>) -> Option<Measurement> {
        let Observation { time, bounding_box, fix, .. } = seen.observation;
        // From the box alone, also where the recipe could look at the fix: the track must not be
        // told the fix twice.
        let regression = bounding_box
            .as_ref()
            .zip(seen.regressor)
            .map(|(drawn, regressor)| (regressor.plane(), regressor.regress(drawn, None)));
        let regressed = regression.map(|(plane, it)| (plane.to_position(it.regressed), it.variance_m2()));
        let anywhere = fix.map(|fix| fix.position).or(regressed.map(|(position, _)| position))?;
        let plane = self.plane.get_or_insert_with(|| LocalPlane::new(anywhere));
        let measured = |(position, variance_m2)| Measured::isotropic(plane.to_plane(position), variance_m2);
        Some(Measurement {
            time: *time,
            fix: fix.map(|fix| measured((fix.position, seen.e_gnss_m2))),
            regressed: regressed.map(measured),
        })
    }

    fn point(&self, target_id: &TargetId, state: TrackState) -> TrackPoint {
        let plane = self.plane.as_ref().expect("a state comes from a measurement, which makes the plane");
        TrackPoint { target_id: target_id.clone(), position: plane.to_position(state.position), state }
    }

    fn make_room(&mut self, id: &CameraId, now: Timestamp, most: usize) -> Result<()> {
        if self.targets.len() >= most {
            self.drop_gone(now);
        }
        if self.targets.len() < most {
            return Ok(());
        }
        Err(Error::refused(
            ErrorKind::Overloaded,
            format!(
                "camera {id} follows {most} targets already; target ids that change with every frame do that"
            ),
        ))
    }

    /// By the server's clock, for recorded times may be of any year; and by the latest time told,
    /// for recordings may be played fast.
    fn drop_gone(&mut self, now: Timestamp) {
        let told = self.targets.values().map(|followed| followed.track.measured_at()).max();
        self.targets.retain(|_, followed| {
            let silent_s = now.duration_since(followed.heard_at).as_secs_f64();
            let gone = told.is_some_and(|told| followed.track.is_gone(told));
            !gone && silent_s <= followed.track.settings().time_to_live_s
        });
    }
}

impl Followed {
    fn remember(&mut self, point: &Arc<TrackPoint>, most: usize) {
        self.latest = point.clone();
        let last = self.history.back();
        if last.is_some_and(|last| point.state.time.duration_since(last.state.time) < HISTORY_STEP) {
            return;
        }
        while self.history.len() >= most.max(1) {
            self.history.pop_front();
        }
        self.history.push_back(point.clone());
    }
}

fn start(regressor: Option<&Regressor>, measurement: &Measurement) -> Option<(Track, TrackState)> {
    let settings = regressor.map_or_else(TrackSettings::default, TrackSettings::learnt_by);
    let track = Track::start(settings, measurement)?;
    let state = track.state_at(measurement.time);
    Some((track, state))
}

fn compare(meeting: &mut Meeting, target_id: &TargetId, measurement: &Measurement) -> Option<Compared> {
    let spot = |measured: Measured| Spot {
        time: measurement.time,
        position: measured.position,
        variance_m2: measured.covariance.per_axis_m2(),
    };
    let by_box = measurement.regressed.and_then(|measured| meeting.regressed(spot(measured)));
    let by_fix = measurement.fix.and_then(|measured| meeting.fix(spot(measured)));
    let (regressed, fix) = by_box.or(by_fix)?;
    Some(Compared {
        time: fix.time,
        target_id: target_id.clone(),
        regressed: regressed.position,
        fix: fix.position,
        e_regression_m2: regressed.variance_m2,
        e_gnss_m2: fix.variance_m2,
    })
}
