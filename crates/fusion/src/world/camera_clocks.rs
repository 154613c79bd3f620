//! The offsets of the cameras' clocks from each other, from targets that two cameras see at once.
//!
//! A camera whose times are late by `o` shows a target where it was `o` ago. For two cameras and a target with the velocity v
//!
//! ```text
//! z_a - z_b - v (t_a - t_b) = -(o_a - o_b) v + m(x) + w
//! ```
//!
//! with the difference m of their maps at the target's position x and the noise w. What one target shows within some seconds
//! is one observation: v is the line through the positions by both cameras, for the velocity of the track follows each camera's
//! map. m is a Gaussian process over x with an unknown mean, so a difference of the maps that people meet on opposite sides of a
//! street is not taken for one of the clocks. The difference of the clocks is the generalized least-squares solution. The
//! offsets of all cameras are the least-squares solution of their pairs; most clocks are taken to be right, so the median is 0.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use nalgebra::{DMatrix, DVector, Matrix2xX, Vector2};

use super::frame::WorldTrackId;
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
/// Latest observations of two cameras that count, and the fewest.
const MOST_OBSERVATIONS: usize = 60;
const LEAST_OBSERVATIONS: usize = 16;
/// Pairs of cameras and targets under way at most.
const MOST_UNDER_WAY: usize = 10_000;
/// Mean square by which the velocities of targets differ from their mean at least, m2/s2: where all walk alike, the
/// difference of two maps looks like that of two clocks.
const LEAST_SPREAD_M2_S2: f64 = 0.25;
/// The difference of two maps: its variance in variances of an observation's noise, and its length in root mean square
/// distances of the targets from their mean.
const MAP_VARIANCE: f64 = 2.0;
const MAP_LENGTH: f64 = 1.5;
/// The length at least, m.
const LEAST_LENGTH_M: f64 = 1.0;
/// An offset is wrong, and corrected, beyond this one, s, and that many standard deviations.
const LEAST_WRONG_S: f64 = 0.2;
const SIGNIFICANT: f64 = 4.0;
/// Observations that miss the others by more than this many standard deviations count less (Huber), down to the least weight.
const HUBER: f64 = 1.5;
const LEAST_WEIGHT: f64 = 0.05;
/// Rounds of reweighting.
const ROUNDS: usize = 4;
/// Time between two estimates, s.
const REVIEW_S: f64 = 2.0;

/// How late the times of a camera are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraClock {
    /// Seconds by which the camera's times are later than those of most cameras.
    pub offset_s: f64,
    /// Standard deviation of the estimate, s.
    pub sigma_s: f64,
}

impl CameraClock {
    /// True if the offset is neither chance nor a difference of two maps. The times of the camera's frames are corrected by it.
    #[must_use]
    pub fn is_wrong(&self) -> bool {
        self.offset_s.abs() > LEAST_WRONG_S.max(SIGNIFICANT * self.sigma_s)
    }
}

/// Two cameras, the smaller id first.
type CameraPair = (CameraId, CameraId);

/// A target in two cameras: sums over its comparisons, with the time since the first, s, and positions, m.
#[derive(Debug, Clone, Copy)]
struct Common {
    first: Timestamp,
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
    fn new(first: Timestamp) -> Self {
        let zero = Vector2::zeros();
        Self {
            first,
            latest: first,
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
        let elapsed_s = time.duration_since(self.first).as_secs_f64();
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
        self.latest.duration_since(self.first).as_secs_f64()
    }

    /// `None` if there is too little of it.
    fn observation(&self) -> Option<Observation> {
        if self.comparisons < LEAST_COMPARISONS || self.duration_s() < LEAST_S {
            return None;
        }
        let mean_s = self.elapsed / self.comparisons;
        let spread = self.elapsed_squared - mean_s * self.elapsed;
        let velocity = (self.middle_elapsed - self.middle * mean_s) / spread;
        Some(Observation {
            velocity,
            apart: (self.apart - velocity * self.stated) / self.comparisons,
            position: self.middle / self.comparisons,
        })
    }
}

/// What a target shows of two cameras: its velocity, m/s, its position, m, and what the first camera's positions are
/// ahead of the second's at equal times, m.
#[derive(Debug, Clone, Copy)]
struct Observation {
    velocity: Vector2<f64>,
    apart: Vector2<f64>,
    position: Vector2<f64>,
}

/// A box as it is compared with those of other cameras.
#[derive(Debug, Clone, Copy)]
pub(super) struct TimedPosition<'a> {
    pub(super) camera: &'a CameraId,
    /// As corrected.
    pub(super) time: Timestamp,
    pub(super) position: EastNorth,
}

/// Estimates of the clocks of a site's cameras.
#[derive(Debug, Clone, Default)]
pub(super) struct CameraClocks {
    under_way: BTreeMap<(CameraPair, WorldTrackId), Common>,
    observations: BTreeMap<CameraPair, Vec<Observation>>,
    clocks: BTreeMap<CameraId, CameraClock>,
    /// When observations that had ended were looked for last.
    swept: Option<Timestamp>,
}

impl CameraClocks {
    /// The estimates so far.
    pub(super) const fn clocks(&self) -> &BTreeMap<CameraId, CameraClock> {
        &self.clocks
    }

    /// A camera's time by the clock of most cameras.
    pub(super) fn corrected(&self, camera: &CameraId, time: Timestamp) -> Timestamp {
        let late = SignedDuration::try_from_secs_f64(self.applied_s(camera)).unwrap_or_default();
        time.checked_sub(late).unwrap_or(time)
    }

    fn applied_s(&self, camera: &CameraId) -> f64 {
        let clock = self.clocks.get(camera).filter(|clock| clock.is_wrong());
        clock.map_or(0.0, |clock| clock.offset_s)
    }

    /// Compares two boxes of a track.
    pub(super) fn compare(&mut self, track: WorldTrackId, own: TimedPosition<'_>, other: TimedPosition<'_>) {
        let elapsed_s = own.time.duration_since(other.time).as_secs_f64();
        if elapsed_s.abs() > MAX_APART_S || own.camera == other.camera {
            return;
        }
        let (first, second, sign) =
            if own.camera < other.camera { (own, other, 1.0) } else { (other, own, -1.0) };
        let key = ((first.camera.clone(), second.camera.clone()), track);
        if self.under_way.len() >= MOST_UNDER_WAY && !self.under_way.contains_key(&key) {
            return;
        }
        // By the times as they were stated.
        let stated_s = sign * elapsed_s + self.applied_s(first.camera) - self.applied_s(second.camera);
        let time = own.time.max(other.time);
        let common = self.under_way.entry(key).or_insert_with(|| Common::new(time));
        common.add(time, vector(first.position), vector(second.position), stated_s);
    }

    /// Estimates again, at most every two seconds, if observations have ended; true if it did.
    pub(super) fn advance(&mut self, time: Timestamp) -> bool {
        let since_s = self.swept.map_or(f64::INFINITY, |swept| time.duration_since(swept).as_secs_f64());
        if since_s.abs() < REVIEW_S {
            return false;
        }
        self.swept = Some(time);
        let is_over = |common: &Common| {
            let unseen_s = time.duration_since(common.latest).as_secs_f64().abs();
            unseen_s > ENDED_AFTER_S || common.duration_s() > MOST_S
        };
        let mut has_ended = false;
        for ((pair, _), common) in self.under_way.extract_if(.., |_, common| is_over(common)) {
            let Some(observation) = common.observation() else { continue };
            let own = self.observations.entry(pair).or_default();
            own.push(observation);
            if own.len() > MOST_OBSERVATIONS {
                own.remove(0);
            }
            has_ended = true;
        }
        if !has_ended {
            return false;
        }
        self.clocks = solved(&self.observations);
        true
    }
}

fn vector(position: EastNorth) -> Vector2<f64> {
    Vector2::new(position.east_m, position.north_m)
}

/// Slope of what is apart over the velocity and its standard deviation, s; `None` where the velocities hardly differ.
fn slope(observations: &[Observation]) -> Option<(f64, f64)> {
    let count = observations.len();
    if count < LEAST_OBSERVATIONS {
        return None;
    }
    let row = |of: fn(&Observation) -> Vector2<f64>| {
        Matrix2xX::from_columns(&observations.iter().map(of).collect::<Vec<_>>())
    };
    let (velocity, apart, position) =
        (row(|own| own.velocity), row(|own| own.apart), row(|own| own.position));
    let spread = |of: &Matrix2xX<f64>| of.column_variance().sum();
    if spread(&velocity) < LEAST_SPREAD_M2_S2 {
        return None;
    }
    let length_m = (MAP_LENGTH * spread(&position).sqrt()).max(LEAST_LENGTH_M);
    let map = DMatrix::from_fn(count, count, |one, other| {
        let apart_m = (position.column(one) - position.column(other)).norm();
        MAP_VARIANCE * (-0.5 * (apart_m / length_m).powi(2)).exp()
    });
    let mut weights = DVector::from_element(count, 1.0);
    let mut found = None;
    for _ in 0..ROUNDS {
        let noise = DMatrix::from_diagonal(&weights.map(f64::recip));
        let precision = (&map + noise).cholesky()?.inverse();
        let of_mean = precision.row_sum();
        // Of both axes, without their means.
        let product = |one: &Matrix2xX<f64>, other: &Matrix2xX<f64>| {
            let means = (one * of_mean.transpose()).dot(&(other * of_mean.transpose()));
            (one * &precision).dot(other) - means / of_mean.sum()
        };
        let information = product(&velocity, &velocity);
        let slope_s = product(&velocity, &apart) / information;
        let residual = &apart - &velocity * slope_s;
        let variance_m2 = product(&residual, &residual) / (2 * count - 3) as f64;
        found = Some((slope_s, (variance_m2 / information).sqrt()));
        let mean = &residual * of_mean.transpose() / of_mean.sum();
        let mut centred = residual;
        for mut column in centred.column_iter_mut() {
            column -= &mean;
        }
        // What each misses by if the others tell its value.
        let missed = centred * &precision;
        weights = DVector::from_fn(count, |at, _| {
            let deviations = missed.column(at).norm() / (2.0 * variance_m2 * precision[(at, at)]).sqrt();
            (HUBER / deviations.max(1e-9)).clamp(LEAST_WEIGHT, 1.0)
        });
    }
    found
}

/// The clocks of all cameras that pairs tell of.
fn solved(observations: &BTreeMap<CameraPair, Vec<Observation>>) -> BTreeMap<CameraId, CameraClock> {
    let slopes: Vec<(&CameraPair, (f64, f64))> =
        observations.iter().filter_map(|(pair, own)| Some((pair, slope(own)?))).collect();
    let mut cameras: Vec<&CameraId> = slopes.iter().flat_map(|((one, other), _)| [one, other]).collect();
    cameras.sort();
    cameras.dedup();
    let count = cameras.len();
    if count == 0 {
        return BTreeMap::new();
    }
    let at = |camera: &CameraId| cameras.binary_search(&camera).ok();
    // A weak prior: only differences are observed.
    let mut precision = DMatrix::<f64>::identity(count, count) * 1e-2;
    let mut right = DVector::<f64>::zeros(count);
    for ((one, other), (slope_s, sigma_s)) in &slopes {
        let (Some(one), Some(other)) = (at(one), at(other)) else { continue };
        let weight = sigma_s.max(1e-3).powi(-2);
        for (camera, sign) in [(one, 1.0), (other, -1.0)] {
            precision[(camera, camera)] += weight;
            // The slope is the negative difference of the offsets.
            right[camera] -= sign * weight * slope_s;
        }
        precision[(one, other)] -= weight;
        precision[(other, one)] -= weight;
    }
    let Some(covariance) = precision.try_inverse() else { return BTreeMap::new() };
    let offsets_s = &covariance * right;
    // Pairs that contradict each other know less than they state.
    let missed = slopes.iter().filter_map(|((one, other), (slope_s, sigma_s))| {
        let difference_s = offsets_s[at(one)?] - offsets_s[at(other)?];
        Some(((slope_s + difference_s) / sigma_s.max(1e-3)).powi(2))
    });
    let beyond_tree = (slopes.len() + 1).saturating_sub(count).max(1) as f64;
    let inflation = (missed.sum::<f64>() / beyond_tree).max(1.0);
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|one, other| offsets_s[*one].total_cmp(&offsets_s[*other]));
    let median = order[(count - 1) / 2];
    let clock = |camera: usize| {
        let offset_s = offsets_s[camera] - offsets_s[median];
        let variance_s2 =
            covariance[(camera, camera)] + covariance[(median, median)] - 2.0 * covariance[(camera, median)];
        CameraClock { offset_s, sigma_s: (inflation * variance_s2.max(0.0)).sqrt() }
    };
    cameras.iter().map(|camera| (*camera).clone()).zip((0..count).map(clock)).collect()
}
