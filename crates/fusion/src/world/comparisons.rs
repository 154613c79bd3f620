//! What two cameras that see a target at once state of it: how far apart they place it.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use nalgebra::Vector2;

use super::frame::WorldTrackId;
use super::map_difference::{MapDifference, Observation};
use super::world_track::seconds_from;
use crate::domain::CameraId;
use crate::geo::EastNorth;

/// Two cameras are compared by boxes at most so far apart in time, s.
const MAX_APART_S: f64 = 1.0;
/// Comparisons and duration, s, of an observation at least, and its duration at most.
const LEAST_COMPARISONS: f64 = 5.0;
const LEAST_S: f64 = 3.0;
const MOST_S: f64 = 10.0;
/// An observation ends when its target was not seen by both cameras for this time, s.
const ENDED_AFTER_S: f64 = 3.0;
/// Latest observations of two cameras that count, and those of them that tell of clocks, which may be set at any time.
const MOST_OBSERVATIONS: usize = 180;
const MOST_FOR_CLOCKS: usize = 60;
/// The long difference is computed again after that many observations; of that many pairs in one look, the one that has
/// waited longest first.
const LONG_AFTER: usize = 16;
const MOST_LONG_AT_ONCE: usize = 4;
/// Rounds of reweighting.
const SHORT_ROUNDS: usize = 4;
const LONG_ROUNDS: usize = 2;
/// Variance of what a target keeps between two cameras, such as the shape of its boxes, in variances of an observation's noise.
const TARGET_VARIANCE: f64 = 2.0;
/// Pairs of cameras and targets under way at most.
const MOST_UNDER_WAY: usize = 10_000;
/// Time between two looks for observations that have ended, s.
const REVIEW_S: f64 = 2.0;

/// Two cameras, the smaller id first.
pub(super) type CameraPair = (CameraId, CameraId);

/// A target in two cameras: sums over its comparisons, with the time since the first, s, and positions, m.
#[derive(Debug, Clone, Copy)]
struct Common {
    began: Timestamp,
    latest: Timestamp,
    comparisons: f64,
    elapsed: f64,
    elapsed_squared: f64,
    /// Middle of the positions by both cameras, and the first camera's ahead of the second's.
    middle: Vector2<f64>,
    middle_elapsed: Vector2<f64>,
    apart: Vector2<f64>,
    /// Time of the first camera after that of the second, as stated.
    stated: f64,
}

impl Common {
    fn new(began: Timestamp) -> Self {
        let zero = Vector2::zeros();
        Self {
            began,
            latest: began,
            comparisons: 0.0,
            elapsed: 0.0,
            elapsed_squared: 0.0,
            middle: zero,
            middle_elapsed: zero,
            apart: zero,
            stated: 0.0,
        }
    }

    fn add(&mut self, time: Timestamp, first: Vector2<f64>, second: Vector2<f64>, stated_s: f64) {
        let elapsed_s = seconds_from(self.began, time);
        let middle = (first + second) / 2.0;
        self.latest = self.latest.max(time);
        self.comparisons += 1.0;
        self.elapsed += elapsed_s;
        self.elapsed_squared += elapsed_s * elapsed_s;
        self.middle += middle;
        self.middle_elapsed += middle * elapsed_s;
        self.apart += first - second;
        self.stated += stated_s;
    }

    fn duration_s(&self) -> f64 {
        seconds_from(self.began, self.latest)
    }

    fn is_over(&self, now: Timestamp) -> bool {
        seconds_from(self.latest, now).abs() > ENDED_AFTER_S || self.duration_s() > MOST_S
    }

    /// `None` if there is too little of it.
    fn observation(&self, track: WorldTrackId) -> Option<Observation> {
        if self.comparisons < LEAST_COMPARISONS || self.duration_s() < LEAST_S {
            return None;
        }
        let mean_s = self.elapsed / self.comparisons;
        let spread = self.elapsed_squared - mean_s * self.elapsed;
        let velocity = (self.middle_elapsed - self.middle * mean_s) / spread;
        Some(Observation {
            track,
            began: self.began,
            velocity,
            apart: (self.apart - velocity * self.stated) / self.comparisons,
            position: self.middle / self.comparisons,
        })
    }
}

/// A box as it is compared with those of other cameras.
#[derive(Debug, Clone, Copy)]
pub(super) struct TimedPosition<'a> {
    pub(super) camera: &'a CameraId,
    /// As corrected.
    pub(super) time: Timestamp,
    /// What the correction took off, s.
    pub(super) corrected_s: f64,
    pub(super) position: EastNorth,
}

/// What two cameras have in common.
#[derive(Debug, Clone, Default)]
pub(super) struct Overlap {
    /// The latest ones, in the order in which they ended.
    pub(super) observations: Vec<Observation>,
    /// The difference of the maps by the latest ones that tell of clocks; `None` while they are too few.
    pub(super) short: Option<MapDifference>,
    /// The same by all that there were when it was computed.
    pub(super) long: Option<LongDifference>,
    /// Observations since `long` was computed.
    new_observations: usize,
    /// Since when it waits to be computed again.
    waiting_since: Option<Timestamp>,
}

/// The difference of two maps with its observations.
#[derive(Debug, Clone)]
pub(super) struct LongDifference {
    pub(super) observations: Vec<Observation>,
    pub(super) difference: MapDifference,
}

/// What a look for observations that have ended has brought.
#[derive(Debug, Default)]
pub(super) struct Review {
    /// True if there are new observations.
    pub(super) has_observations: bool,
    /// The pairs whose long difference was computed again.
    pub(super) long: Vec<CameraPair>,
}

/// The comparisons of a site's cameras.
#[derive(Debug, Clone, Default)]
pub(super) struct Comparisons {
    under_way: BTreeMap<(CameraPair, WorldTrackId), Common>,
    overlaps: BTreeMap<CameraPair, Overlap>,
    /// When observations that had ended were looked for last.
    reviewed: Option<Timestamp>,
}

impl Comparisons {
    /// By pair of cameras.
    pub(super) const fn overlaps(&self) -> &BTreeMap<CameraPair, Overlap> {
        &self.overlaps
    }

    /// Compares two boxes of a track.
    pub(super) fn compare(&mut self, track: WorldTrackId, own: TimedPosition<'_>, other: TimedPosition<'_>) {
        let elapsed_s = seconds_from(other.time, own.time);
        if elapsed_s.abs() > MAX_APART_S || own.camera == other.camera {
            return;
        }
        let (first, second) = if own.camera < other.camera { (own, other) } else { (other, own) };
        let key = ((first.camera.clone(), second.camera.clone()), track);
        if self.under_way.len() >= MOST_UNDER_WAY && !self.under_way.contains_key(&key) {
            return;
        }
        let stated_s = seconds_from(second.time, first.time) + first.corrected_s - second.corrected_s;
        let time = own.time.max(other.time);
        let common = self.under_way.entry(key).or_insert_with(|| Common::new(time));
        common.add(time, vector(first.position), vector(second.position), stated_s);
    }

    /// Ends observations, at most every two seconds.
    pub(super) fn advance(&mut self, now: Timestamp) -> Review {
        let is_early = |reviewed: Timestamp| seconds_from(reviewed, now).abs() < REVIEW_S;
        if self.reviewed.is_some_and(is_early) {
            return Review::default();
        }
        self.reviewed = Some(now);
        let mut changed = BTreeSet::new();
        for ((pair, track), common) in self.under_way.extract_if(.., |_, common| common.is_over(now)) {
            let Some(observation) = common.observation(track) else { continue };
            let own = self.overlaps.entry(pair.clone()).or_default();
            own.new_observations += 1;
            own.observations.push(observation);
            if own.observations.len() > MOST_OBSERVATIONS {
                own.observations.remove(0);
            }
            changed.insert(pair);
        }
        for pair in &changed {
            let Some(own) = self.overlaps.get_mut(pair) else { continue };
            let latest = own.observations.len().saturating_sub(MOST_FOR_CLOCKS);
            own.short = MapDifference::of(&own.observations[latest..], 0.0, SHORT_ROUNDS);
            if own.new_observations >= LONG_AFTER {
                own.waiting_since.get_or_insert(now);
            }
        }
        Review { has_observations: !changed.is_empty(), long: self.compute_long() }
    }

    fn compute_long(&mut self) -> Vec<CameraPair> {
        let mut waiting: Vec<(&CameraPair, &mut Overlap)> =
            self.overlaps.iter_mut().filter(|(_, own)| own.waiting_since.is_some()).collect();
        waiting.sort_by_key(|(_, own)| own.waiting_since);
        let computed = waiting.into_iter().take(MOST_LONG_AT_ONCE).map(|(pair, own)| {
            (own.waiting_since, own.new_observations) = (None, 0);
            let observations = own.observations.clone();
            own.long = MapDifference::of(&observations, TARGET_VARIANCE, LONG_ROUNDS)
                .map(|difference| LongDifference { observations, difference });
            pair.clone()
        });
        computed.collect()
    }

    /// Forgets a camera, whose map is another one from now on.
    pub(super) fn forget(&mut self, camera: &CameraId) {
        let is_other = |(one, other): &CameraPair| one != camera && other != camera;
        self.under_way.retain(|(pair, _), _| is_other(pair));
        self.overlaps.retain(|pair, _| is_other(pair));
    }
}

fn vector(position: EastNorth) -> Vector2<f64> {
    Vector2::new(position.east_m, position.north_m)
}
