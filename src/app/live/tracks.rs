//! The tracks of one camera's targets, and what was observed of them lately.
//!
//! Each target has a lock of its own, so that streams do not wait for each other's filters. Nothing else
//! is waited for, and everything is bounded by the limits. Ages are read from the monotonic clock, so a
//! step of the wall clock neither hides targets nor keeps them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::history::History;
use super::sync::lock;
use crate::app::history::path::{FinishedTrack, RecordedState};
use crate::app::history::recorder::TrackRecorder;
use crate::config::Limits;
use crate::domain::{
    CameraId, Error, ErrorKind, ImageSize, Observation, ReceiverMatch, Result, TargetClass, TargetId,
};
use crate::fusion::drift_detector::{ResidualSample, TimeAligner, TimedEstimate};
use crate::fusion::observed::ObservedPositions;
use crate::fusion::target_track::{TargetTrack, TrackEstimate};
use crate::fusion::track::{TrackSettings, TrackState};
use crate::geo::Position;
use crate::model::Regressor;

/// A target without an observation for this long gives way to a new one where there is no room.
const EVICT_AFTER: Duration = Duration::from_secs(2);

/// Where a target is by its track, at the latest instant measured.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackPoint {
    pub target_id: TargetId,
    /// The receiver that the target carries, where only a tracker's id is known and it was matched.
    pub receiver_match: Option<ReceiverMatch>,
    /// The target's position.
    pub position: Position,
    /// All that the track states, in its own plane.
    pub state: TrackState,
}

/// Every target that is tracked in one camera's view.
#[derive(Default)]
pub(super) struct Tracks {
    targets: Mutex<HashMap<TargetId, Arc<Mutex<TrackedTarget>>>>,
}

/// One target; without a track until something usable was measured of it.
pub(super) struct TrackedTarget {
    track: TargetTrack,
    /// Reading of the monotonic clock at the last observation.
    last_item_at: Duration,
    history: History<TrackPoint>,
    residuals: ResidualSource,
    /// Only where the camera has a history.
    recorder: Option<TrackRecorder>,
}

/// One instant of one target.
pub(super) struct TargetObservation<'a> {
    pub(super) target_id: &'a TargetId,
    pub(super) receiver_match: Option<&'a ReceiverMatch>,
    pub(super) observed: ObservedPositions<'a>,
    pub(super) model: Option<(&'a Regressor, u32)>,
    /// Reading of the monotonic clock.
    pub(super) now: Duration,
}

impl Tracks {
    /// Removes the targets that have not been observed for too long, which ends their recordings.
    pub(super) fn remove_silent(&self, now: Duration) {
        remove_expired(&mut lock(&self.targets), now);
    }

    /// Ends all recordings.
    pub(super) fn finish_all(&self) -> Vec<FinishedTrack> {
        let targets = lock(&self.targets);
        let recorders = targets.values().filter_map(|target| lock(target).recorder.take());
        recorders.filter_map(TrackRecorder::finish).collect()
    }

    /// The latest point of every target, by target.
    pub(super) fn latest(&self, now: Duration) -> Vec<Arc<TrackPoint>> {
        let mut targets = lock(&self.targets);
        remove_expired(&mut targets, now);
        let mut points: Vec<_> =
            targets.values().filter_map(|target| lock(target).history.latest().cloned()).collect();
        points.sort_by(|a, b| a.target_id.cmp(&b.target_id));
        points
    }

    /// Where a target was, oldest first, as far back as the history reaches; `None` if it is not tracked.
    pub(super) fn history(&self, target_id: &TargetId, now: Duration) -> Option<Vec<Arc<TrackPoint>>> {
        let target = {
            let mut targets = lock(&self.targets);
            remove_expired(&mut targets, now);
            targets.get(target_id).cloned()?
        };
        let points = lock(&target).history.points();
        Some(points).filter(|points| !points.is_empty())
    }

    /// The target's entry, made if there is room for it.
    ///
    /// # Errors
    /// `Overloaded` if as many targets are tracked as may be, all of them observed lately.
    pub(super) fn target(
        &self,
        id: &CameraId,
        target_id: &TargetId,
        now: Duration,
        most: usize,
    ) -> Result<Arc<Mutex<TrackedTarget>>> {
        let mut targets = lock(&self.targets);
        if let Some(target) = targets.get(target_id) {
            return Ok(target.clone());
        }
        if targets.len() >= most {
            remove_expired(&mut targets, now);
        }
        if targets.len() >= most {
            evict_longest_silent(&mut targets, now);
        }
        if targets.len() >= most {
            let message = format!(
                "camera {id} follows {most} targets already; target ids that change with every frame do that"
            );
            return Err(Error::refused(ErrorKind::Overloaded, message));
        }
        let target = Arc::new(Mutex::new(TrackedTarget::new(now)));
        targets.insert(target_id.clone(), target.clone());
        Ok(target)
    }

    /// Compares a box with the fixes of the receiver that it was matched with, whose track is another.
    pub(super) fn compared_with_fixes(&self, seen: &TargetObservation<'_>) -> Option<ResidualSample> {
        let carried = TargetId::from(seen.receiver_match?.receiver_id.clone());
        let target = lock(&self.targets).get(&carried).cloned()?;
        let residual = lock(&target).residuals.observe(seen);
        residual.map(|own| ResidualSample { target_id: carried, ..own })
    }
}

type Targets = HashMap<TargetId, Arc<Mutex<TrackedTarget>>>;

/// Removes targets without an observation for longer than the time to live. The times of observations play
/// no part: a recording may be of any year, and one target's clock is nothing to another.
fn remove_expired(targets: &mut Targets, now: Duration) {
    let time_to_live = Duration::from_secs_f64(TrackSettings::default().time_to_live_s);
    targets.retain(|_, target| now.saturating_sub(lock(target).last_item_at) <= time_to_live);
}

/// Recordings played fast and trackers that rename targets bring new ids sooner than old ones expire.
fn evict_longest_silent(targets: &mut Targets, now: Duration) {
    let last_items = targets.iter().map(|(target_id, target)| (lock(target).last_item_at, target_id));
    let longest = last_items.min().filter(|(at, _)| now.saturating_sub(*at) >= EVICT_AFTER);
    if let Some(target_id) = longest.map(|(_, target_id)| target_id.clone()) {
        targets.remove(&target_id);
    }
}

impl TrackedTarget {
    /// Returns the positions that an observation measures, compared with the target's latest boxes.
    pub(super) fn observe<'a>(
        &mut self,
        observation: &Observation,
        regressor: Option<&'a Regressor>,
        image_size: Option<ImageSize>,
        e_gnss_m2: Option<f64>,
    ) -> ObservedPositions<'a> {
        self.track.observe(observation, regressor, image_size, e_gnss_m2)
    }

    /// Feeds what was observed to the track; `None` while nothing usable was observed. With it comes the
    /// regressed position beside the fix of the same instant, if now both are known.
    pub(super) fn update(
        &mut self,
        seen: &TargetObservation<'_>,
        limits: &Limits,
    ) -> (Option<Arc<TrackPoint>>, Option<ResidualSample>) {
        if seen.observed.is_empty() {
            return (None, None);
        }
        self.last_item_at = seen.now;
        let settings =
            || seen.model.map_or_else(TrackSettings::default, |(it, _)| TrackSettings::from_model(it));
        let estimate = self.track.update(&seen.observed, settings);
        let residual = self.residuals.observe(seen);
        let Some(TrackEstimate { position, state }) = estimate else { return (None, residual) };
        let receiver_match = seen.receiver_match.cloned();
        let point =
            Arc::new(TrackPoint { target_id: seen.target_id.clone(), receiver_match, position, state });
        self.history.push(&point, |point| point.state.time, limits.track_points);
        (Some(point), residual)
    }

    /// Records the estimate, with the recorder of the camera's history as it is now.
    pub(super) fn record(
        &mut self,
        point: &TrackPoint,
        class: Option<&TargetClass>,
        recorder: Option<impl FnOnce() -> TrackRecorder>,
    ) {
        let Some(recorder) = recorder else {
            self.recorder = None;
            return;
        };
        let state = &point.state;
        self.recorder.get_or_insert_with(recorder).push(&RecordedState {
            track: None,
            target: Some(&point.target_id),
            class,
            time: state.time,
            position: point.position,
            velocity: state.velocity,
            covariance: state.normal_covariance(),
            velocity_covariance: state.velocity_covariance,
            stationary_probability: state.stationary_probability,
            moments: state.moments,
            is_restarted: state.restarted,
        });
    }

    fn new(now: Duration) -> Self {
        Self {
            track: TargetTrack::default(),
            last_item_at: now,
            history: History::default(),
            residuals: ResidualSource::default(),
            recorder: None,
        }
    }
}

/// Brings boxes and fixes of one target to the same instants, in the plane of one model version.
#[derive(Default)]
struct ResidualSource {
    model_version: Option<u32>,
    aligner: TimeAligner,
}

impl ResidualSource {
    /// The drift detector also needs what a gate rejects, or a moved camera would never be found; only a
    /// position that no plane about the camera holds is left out, and a frozen box, which shows no pose.
    fn observe(&mut self, seen: &TargetObservation<'_>) -> Option<ResidualSample> {
        let version = seen.model.map(|(_, version)| version);
        if self.model_version != version {
            *self = Self { model_version: version, aligner: TimeAligner::default() };
        }
        let estimate =
            |position, variance_m2| TimedEstimate { time: seen.observed.time, position, variance_m2 };
        let box_of_now = seen.observed.usable_box().filter(|observed| !observed.is_frozen);
        let by_box = box_of_now.and_then(|observed| {
            let regression = &observed.independent;
            self.aligner.push_regressed(estimate(regression.regressed, regression.variance_m2()))
        });
        let fix = seen.observed.fix.and_then(|fix| Some(estimate(fix.in_plane?, fix.variance_m2)));
        let by_fix = fix.and_then(|fix| self.aligner.push_fix(fix));
        let (regressed, fix) = by_box.or(by_fix)?;
        Some(ResidualSample {
            time: fix.time,
            target_id: seen.target_id.clone(),
            regressed: regressed.position,
            fix: fix.position,
            e_regression_m2: regressed.variance_m2,
            e_gnss_m2: fix.variance_m2,
        })
    }
}
