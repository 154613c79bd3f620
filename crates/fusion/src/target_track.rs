//! One target over time: starts, feeds, restarts and ends its [`Track`], and keeps the plane it runs in.
//! The live service and the evaluation both follow a target through this type.
//!
//! Each target has a plane of its own, so one target's wrong fix cannot displace another's track: that of
//! the camera's model where there is one, else one about the target's own fixes.

use std::collections::VecDeque;

use jiff::Timestamp;

use super::observed::{ObservedBox, ObservedPositions};
use super::track::{
    MeasuredPosition, Measurement, MeasurementSource, Rejection, RejectionReason, Track, TrackSettings,
    TrackState,
};
use crate::domain::{BoundingBox, ImageSize, Observation};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};
use crate::model::{RecentBoxes, Regression, Regressor};

/// Latest fixes of a target without a model that decide by majority where its plane belongs.
const RECENT_FIXES: usize = 5;
/// Distance over which the map's error is compared, m: well above the noise of boxes, and within what a speed is of.
const STRAIN_LENGTH_M: f64 = 4.0;
/// Measurements in a row from before the track's time to live, after which the track restarts at theirs:
/// one instant far ahead, or a recording that is played again, must not reject all that follows.
const REWIND_AFTER: u32 = 3;

/// The sequence fusion of one target.
#[derive(Debug, Clone, Default)]
pub struct TargetTrack {
    active: Option<ActiveTrack>,
    /// Only without a model.
    recent_fixes: VecDeque<Position>,
    /// Measurements in a row that are older than the track by more than its time to live.
    rewound: u32,
    recent_boxes: RecentBoxes,
    same_box: Repetition<BoundingBox>,
    same_fix: Repetition<Position>,
    map_strain: MapStrain,
}

/// For how long a target's measurements have been the same to the last digit.
#[derive(Debug, Clone, Copy)]
struct Repetition<T>(Option<(T, Timestamp)>);

impl<T> Default for Repetition<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: Copy + PartialEq> Repetition<T> {
    /// Takes in a measurement; the time since the first of those that are the same, s.
    fn lasting_s(&mut self, value: T, time: Timestamp) -> f64 {
        let since = self.0.filter(|(latest, _)| *latest == value).map_or(time, |(_, since)| since);
        self.0 = Some((value, since));
        time.duration_since(since).as_secs_f64().max(0.0)
    }
}

/// The error of the map in a distance, where the target went lately.
#[derive(Debug, Clone, Copy, Default)]
struct MapStrain {
    /// Per squared metre travelled, without a unit: the variance of the map's scale along the way and of its rotation
    /// across. 0 before the target has moved.
    covariance: PlaneCovariance,
    /// The box that the next one is compared with, and its position.
    since: Option<(BoundingBox, EastNorth)>,
}

impl MapStrain {
    /// Takes in a box whose stated error rests on training.
    fn observe(&mut self, bounding_box: BoundingBox, seen: &ObservedBox, regressor: &Regressor) {
        if !seen.is_usable || seen.is_unusual || seen.is_foot_hidden {
            return;
        }
        let position = seen.independent.regressed;
        let (from, start) = *self.since.get_or_insert((bounding_box, position));
        let distance_m = start.distance_m(position);
        if distance_m < STRAIN_LENGTH_M {
            return;
        }
        self.since = Some((bounding_box, position));
        if let Some(covariance) = regressor.displacement_covariance([&from, &bounding_box]) {
            self.covariance = covariance.scaled(seen.independent.normal_scale() / distance_m.powi(2));
        }
    }
}

#[derive(Debug, Clone)]
struct ActiveTrack {
    plane: LocalPlane,
    track: Track,
}

/// Where a target is by its track.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackEstimate {
    /// On the ground.
    pub position: Position,
    /// All that the track states, in its own plane.
    pub state: TrackState,
}

impl TargetTrack {
    /// Returns the positions that the next observation of the target measures. Its box is compared with the target's
    /// latest ones: a deviation too small to be noticed in one box is noticed when it lasts.
    pub fn observe<'a>(
        &mut self,
        observation: &Observation,
        regressor: Option<&'a Regressor>,
        image_size: Option<ImageSize>,
        e_gnss_m2: Option<f64>,
    ) -> ObservedPositions<'a> {
        let recent = Some(&mut self.recent_boxes);
        let mut observed = ObservedPositions::of(observation, regressor, image_size, e_gnss_m2, recent);
        if let (Some(seen), Some(bounding_box), Some(regressor)) =
            (&mut observed.regressed, observation.bounding_box(), regressor)
        {
            seen.repeated_for(self.same_box.lasting_s(bounding_box, observed.time), regressor);
            self.map_strain.observe(bounding_box, seen, regressor);
        }
        if let Some(fix) = &mut observed.fix {
            fix.repeated_s = self.same_fix.lasting_s(fix.position, observed.time);
        }
        observed
    }

    /// Feeds what was observed at one instant, late observations at their place in time. `settings` are
    /// those of a track that starts. `None` while nothing usable was observed.
    pub fn update(
        &mut self,
        observed: &ObservedPositions<'_>,
        settings: impl FnOnce() -> TrackSettings,
    ) -> Option<TrackEstimate> {
        self.end_if_outdated(observed);
        let mut rejected = Vec::new();
        let plane = self.plane_for(observed, &mut rejected);
        let Some(plane) = plane else { return self.estimate_with(rejected) };
        let mut measurement = measurement_in(&plane, observed, rejected.is_empty());
        // An active track decides about such positions itself, as it has to take back what it learnt from their source.
        if self.active.is_none() {
            withdraw_contradicting(&mut measurement, observed, &mut rejected);
            withhold_useless(&mut measurement, observed, &mut rejected);
        }
        let mut state = match &mut self.active {
            Some(active) => active.track.update(&measurement),
            None => {
                let track = Track::start(settings(), &measurement)?;
                let state = track.state_at(measurement.time);
                self.active = Some(ActiveTrack { plane, track });
                state
            }
        };
        state.rejected.extend(rejected);
        Some(self.estimate(&plane, state))
    }

    /// The state at an instant, predicted beyond the latest measurement; `None` before the first one and
    /// after the time to live.
    #[must_use]
    pub fn at(&self, time: Timestamp) -> Option<TrackEstimate> {
        let ActiveTrack { plane, track } =
            self.active.as_ref().filter(|active| !active.track.is_expired(time))?;
        Some(self.estimate(plane, track.state_at(time)))
    }

    /// With the map's scale in the velocity's error: the filter takes the map's errors for independent over some metres.
    fn estimate(&self, plane: &LocalPlane, mut state: TrackState) -> TrackEstimate {
        let squared_m2_s2 = state.velocity.speed_m_s().powi(2);
        let by_map = self.map_strain.covariance.scaled(squared_m2_s2);
        state.velocity_covariance = state.velocity_covariance.plus(by_map);
        TrackEstimate { position: plane.to_position(state.position), state }
    }

    /// The instant measured last.
    #[must_use]
    pub fn measured_at(&self) -> Option<Timestamp> {
        Some(self.active.as_ref()?.track.measured_at())
    }

    /// Ends a track that the observation cannot continue: its time to live is over, the target's clock
    /// went back for good, or the model's plane is elsewhere.
    fn end_if_outdated(&mut self, observed: &ObservedPositions<'_>) {
        let Some(ActiveTrack { plane, track }) = &self.active else { return };
        let behind_s = track.measured_at().duration_since(observed.time).as_secs_f64();
        let is_behind = behind_s > track.settings().time_to_live_s;
        self.rewound = if is_behind { self.rewound + 1 } else { 0 };
        let is_elsewhere =
            observed.plane.is_some_and(|scene| scene.to_plane_within_range(plane.origin()).is_none());
        if track.is_expired(observed.time) || is_elsewhere || self.rewound >= REWIND_AFTER {
            self.active = None;
            self.rewound = 0;
            self.recent_boxes = RecentBoxes::default();
            self.same_box = Repetition::default();
            self.same_fix = Repetition::default();
            self.map_strain = MapStrain::default();
        }
    }

    /// The plane for this observation; `None` if no position of it can be measured. A fix out of range is
    /// added to `rejected`.
    fn plane_for(
        &mut self,
        observed: &ObservedPositions<'_>,
        rejected: &mut Vec<Rejection>,
    ) -> Option<LocalPlane> {
        let out_of_range =
            Rejection { source: MeasurementSource::Fix, reason: RejectionReason::OutOfRange, nis: None };
        if let Some(scene) = observed.plane {
            if observed.fix_is_out_of_range() {
                rejected.push(out_of_range);
            }
            let usable_fix = observed.fix.is_some_and(|fix| fix.in_plane.is_some());
            let is_usable = usable_fix || observed.usable_box().is_some();
            return is_usable.then(|| self.active.as_ref().map_or(*scene, |active| active.plane));
        }
        let position = observed.fix?.position;
        if self.recent_fixes.len() == RECENT_FIXES {
            self.recent_fixes.pop_front();
        }
        self.recent_fixes.push_back(position);
        let Some(active) = &self.active else { return Some(LocalPlane::new(position)) };
        if active.plane.to_plane_within_range(position).is_some() {
            return Some(active.plane);
        }
        let candidate = LocalPlane::new(position);
        let votes = |plane: &LocalPlane| {
            self.recent_fixes.iter().filter(|fix| plane.to_plane_within_range(**fix).is_some()).count()
        };
        if votes(&candidate) > votes(&active.plane) {
            self.active = None;
            return Some(candidate);
        }
        rejected.push(out_of_range);
        None
    }

    /// The track as it is, after an observation of which nothing was used.
    fn estimate_with(&self, rejected: Vec<Rejection>) -> Option<TrackEstimate> {
        let mut estimate = self.at(self.measured_at()?)?;
        estimate.state.rejected = rejected;
        Some(estimate)
    }
}

/// The positions in a track's plane. The regressed one is that of the box alone: the track must not use a
/// fix twice.
fn measurement_in(plane: &LocalPlane, observed: &ObservedPositions<'_>, with_fix: bool) -> Measurement {
    let is_model_plane = observed.plane == Some(plane);
    let from_model_plane = |point: EastNorth| match observed.plane {
        Some(scene) if !is_model_plane => plane.to_plane(scene.to_position(point)),
        _ => point,
    };
    let fix = observed.fix.filter(|_| with_fix).map(|fix| {
        let point = fix.in_plane.map_or_else(|| plane.to_plane(fix.position), from_model_plane);
        let measured = MeasuredPosition::isotropic(point, fix.variance_m2);
        MeasuredPosition { repeated_s: fix.repeated_s, is_doubtful: !fix.is_in_scene, ..measured }
    });
    let regressed = observed.usable_box().map(|observed| {
        let point = from_model_plane(observed.independent.regressed);
        let Regression { covariance, box_noise, .. } = observed.independent;
        let scale = observed.independent.normal_scale();
        MeasuredPosition {
            position: point,
            covariance,
            white: Some(box_noise),
            stated_scale: scale,
            repeated_s: observed.repeated_s,
            is_doubtful: observed.is_unusual || observed.is_vague,
            is_vague: observed.is_vague,
        }
    });
    Measurement { time: observed.time, fix, regressed }
}

/// A box that says no more than that a target is in view, or that is frozen, starts no track.
fn withhold_useless(
    measurement: &mut Measurement,
    observed: &ObservedPositions<'_>,
    rejected: &mut Vec<Rejection>,
) {
    let reason = match observed.usable_box() {
        Some(seen) if seen.is_frozen => RejectionReason::Frozen,
        Some(seen) if seen.is_vague => RejectionReason::UnusableVariance,
        _ => return,
    };
    measurement.regressed = None;
    rejected.push(Rejection { source: MeasurementSource::Regressed, reason, nis: None });
}

/// A track must not start between, or at the wrong one of, two positions that contradict each other.
fn withdraw_contradicting(
    measurement: &mut Measurement,
    observed: &ObservedPositions<'_>,
    rejected: &mut Vec<Rejection>,
) {
    let Some(source) = observed.contradicting_source() else { return };
    match source {
        MeasurementSource::Regressed => measurement.regressed = None,
        MeasurementSource::Fix => measurement.fix = None,
    }
    let nis = observed.innovation().map(|innovation| innovation.nis);
    rejected.push(Rejection { source, reason: RejectionReason::OutsideGate, nis });
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::ops::ControlFlow;

    use jiff::SignedDuration;

    use super::*;
    use crate::domain::{Fix, GnssError, Recipe};
    use crate::model::{FitOptions, fit};
    use crate::simulation::{Options, World, simulate};

    fn fix_at(seconds: i64, longitude_deg: f64, latitude_deg: f64) -> Observation {
        let position = Position::new(longitude_deg, latitude_deg).expect("valid");
        let time = Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1_600_000_000 + seconds);
        Observation::with_fix(time, None, None, Fix { position, sigma_m: None })
    }

    fn feed(track: &mut TargetTrack, observation: &Observation) -> Option<TrackEstimate> {
        let observed = track.observe(observation, None, None, None);
        track.update(&observed, TrackSettings::default)
    }

    fn near(estimate: &TrackEstimate, longitude_deg: f64, latitude_deg: f64) -> bool {
        let position = Position::new(longitude_deg, latitude_deg).expect("valid");
        crate::geo::distance_m(estimate.position, position) < 20.0
    }

    #[test]
    fn a_first_fix_far_away_gives_way_to_the_majority() {
        for (longitude_deg, latitude_deg) in [(0.0, 0.0), (8.0, 90.0), (-172.0, -47.0), (8.0, 47.5)] {
            let mut track = TargetTrack::default();
            feed(&mut track, &fix_at(0, longitude_deg, latitude_deg)).expect("started");
            let second = feed(&mut track, &fix_at(1, 8.0, 47.0)).expect("the first is kept for now");
            assert_eq!(second.state.rejected[0].reason, RejectionReason::OutOfRange);
            let third = feed(&mut track, &fix_at(2, 8.0, 47.0)).expect("restarted");
            assert!(near(&third, 8.0, 47.0) && third.state.rejected.is_empty(), "{third:?}");
        }
    }

    #[test]
    fn a_fix_far_away_in_between_is_rejected_and_changes_nothing() {
        let mut track = TargetTrack::default();
        for second in 0..4 {
            feed(&mut track, &fix_at(second, 8.0, 47.0)).expect("followed");
        }
        let far = feed(&mut track, &fix_at(4, 0.0, 0.0)).expect("followed");
        assert!(near(&far, 8.0, 47.0), "{far:?}");
        assert_eq!(far.state.rejected[0].reason, RejectionReason::OutOfRange);
        let next = feed(&mut track, &fix_at(5, 8.0, 47.0)).expect("followed");
        assert!(near(&next, 8.0, 47.0) && next.state.rejected.is_empty(), "{next:?}");
    }

    #[test]
    fn one_instant_far_ahead_rejects_three_measurements_and_no_more() {
        let mut track = TargetTrack::default();
        feed(&mut track, &fix_at(0, 8.0, 47.0)).expect("followed");
        feed(&mut track, &fix_at(7_200, 8.0, 47.0)).expect("restarted two hours on");
        let accepted: Vec<bool> = (1..6)
            .map(|second| {
                feed(&mut track, &fix_at(second, 8.0, 47.0)).expect("followed").state.rejected.is_empty()
            })
            .collect();
        assert_eq!(accepted, [false, false, true, true, true]);
    }

    fn trained(world: &World) -> Regressor {
        let options = FitOptions {
            recipe: Recipe::GaussianProcess,
            seed: 1,
            epochs: None,
            image_size: Some(world.image_size),
            gnss_error: GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let fitted = fit(&world.training_samples(), &options, &mut |_| ControlFlow::Continue(()));
        fitted.expect("usable samples").load().expect("a model")
    }

    #[test]
    fn a_foot_that_stays_hidden_is_noticed_in_more_boxes_than_one_by_one() {
        let world = simulate(&Options { samples: 800, targets: 4, ..Options::demo() });
        let model = trained(&world);
        let is_hidden = |observed: &ObservedPositions<'_>| {
            usize::from(observed.regressed.is_some_and(|seen| seen.is_foot_hidden))
        };
        for hidden_share in [0.2, 0.0] {
            let mut tracks: BTreeMap<usize, TargetTrack> = BTreeMap::new();
            let (mut followed, mut alone) = (0, 0);
            for row in &world.rows {
                let Some(bounding_box) = row.bounding_box else { continue };
                let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
                let seen = BoundingBox::new(left_px, top_px, width_px, (1.0 - hidden_share) * height_px);
                let observation = Observation::new(row.time, None, seen.ok(), row.fix).expect("a box");
                let track = tracks.entry(row.target).or_default();
                let model = Some(&model);
                followed += is_hidden(&track.observe(&observation, model, Some(world.image_size), None));
                alone += is_hidden(&ObservedPositions::of(
                    &observation,
                    model,
                    Some(world.image_size),
                    None,
                    None,
                ));
            }
            let most_whole = alone + world.rows.len() / 8;
            let is_noticed = if hidden_share > 0.0 { followed > alone } else { followed <= most_whole };
            assert!(is_noticed, "{hidden_share}: {followed}, one by one {alone}");
        }
    }

    #[test]
    fn the_error_of_the_map_s_scale_is_in_that_of_the_velocity() {
        let world = simulate(&Options { samples: 400, ..Options::demo() });
        let model = trained(&world);
        let mut track = TargetTrack::default();
        let mut strained = 0;
        for observation in world.rows.iter().filter(|row| row.target == 0).filter_map(|row| row.observation())
        {
            let observed = track.observe(&observation, Some(&model), Some(world.image_size), None);
            let stated =
                track.update(&observed, || TrackSettings::from_model(&model)).expect("a position").state;
            let filtered = track.active.as_ref().expect("active").track.state_at(stated.time);
            let by_map =
                stated.velocity_covariance.per_axis_m2() - filtered.velocity_covariance.per_axis_m2();
            let scale_sigma = track.map_strain.covariance.per_axis_m2().sqrt();
            let speed_m_s = stated.velocity.speed_m_s();
            assert!(
                (by_map.max(0.0).sqrt() - scale_sigma * speed_m_s).abs() < 1e-6,
                "{by_map} {scale_sigma}"
            );
            strained += usize::from(scale_sigma > 0.005 && scale_sigma < 0.5);
        }
        assert!(strained > 50, "{strained}");
    }
}
