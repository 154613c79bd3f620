//! The offsets of the cameras' clocks from each other, from targets that two cameras see at once.
//!
//! A camera whose times are late by `o` shows a target where it was `o` ago. For two cameras and a target with the velocity v
//!
//! ```text
//! z_a - z_b - v (t_a - t_b) = -(o_a - o_b) v + m + w
//! ```
//!
//! with the difference m of their maps and the noise w. What one target shows while both see it is one observation, its
//! mean: neither map nor box changes much meanwhile. The difference of the clocks and m are the least-squares line through
//! the targets, so that nothing is said of clocks where all targets walk alike. The offsets of all cameras are the
//! least-squares solution of their pairs; most clocks are taken to be right, so the median is 0.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use nalgebra::{DMatrix, DVector};

use super::frame::WorldTrackId;
use crate::domain::{CameraId, Velocity};
use crate::geo::EastNorth;

/// Two cameras are compared by boxes at most so far apart in time, s.
const MAX_APART_S: f64 = 1.0;
/// Common boxes of a target that are an observation at least.
const LEAST_BOXES: u32 = 3;
/// An observation ends when its target was not seen by both cameras for this time, s.
const ENDED_AFTER_S: f64 = 3.0;
/// Latest observations of two cameras that count, and the fewest.
const MOST_TARGETS: usize = 60;
const LEAST_TARGETS: usize = 8;
/// Pairs of cameras and targets under way at most.
const MOST_UNDER_WAY: usize = 10_000;
/// Mean square by which the velocities of targets differ from their mean at least, m2/s2: where all walk alike, the
/// difference of two maps looks like that of two clocks.
const LEAST_SPREAD_M2_S2: f64 = 0.25;
/// An offset is corrected beyond the first, s, and said to be wrong beyond the second, both only beyond that many standard
/// deviations. The differences of two maps look like offsets of up to 0.2 s, whose correction does no harm.
const LEAST_CORRECTED_S: f64 = 0.15;
const LEAST_WRONG_S: f64 = 0.3;
const SIGNIFICANT: f64 = 4.0;
/// Residuals of targets count less beyond this many standard deviations (Huber).
const HUBER: f64 = 1.5;
/// Rounds of reweighting.
const ROUNDS: usize = 5;

/// How late the times of a camera are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraClock {
    /// Seconds by which the camera's times are later than those of most cameras.
    pub offset_s: f64,
    /// Standard deviation of the estimate, s.
    pub sigma_s: f64,
}

impl CameraClock {
    /// True if the times of the camera's frames are corrected by the offset.
    #[must_use]
    pub fn is_corrected(&self) -> bool {
        self.exceeds(LEAST_CORRECTED_S)
    }

    /// True if the offset is neither chance nor a difference of two maps.
    #[must_use]
    pub fn is_wrong(&self) -> bool {
        self.exceeds(LEAST_WRONG_S)
    }

    fn exceeds(&self, least_s: f64) -> bool {
        self.offset_s.abs() > least_s.max(SIGNIFICANT * self.sigma_s)
    }
}

/// Two cameras, the smaller id first.
type CameraPair = (CameraId, CameraId);

/// A target in two cameras: sums over its boxes.
#[derive(Debug, Clone, Copy)]
struct Common {
    velocity_m_s: [f64; 2],
    apart_m: [f64; 2],
    boxes: u32,
    latest: Timestamp,
}

/// The mean of a target's velocity, m/s, and of what the first camera's positions are ahead of the second's, m.
#[derive(Debug, Clone, Copy)]
struct Observation {
    velocity_m_s: [f64; 2],
    apart_m: [f64; 2],
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
        let clock = self.clocks.get(camera).filter(|clock| clock.is_corrected());
        clock.map_or(0.0, |clock| clock.offset_s)
    }

    /// Compares two boxes of a track with that velocity.
    pub(super) fn compare(
        &mut self,
        track: WorldTrackId,
        velocity: Velocity,
        own: TimedPosition<'_>,
        other: TimedPosition<'_>,
    ) {
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
        let velocity_m_s = [velocity.east_m_s, velocity.north_m_s];
        let apart = first.position.minus(second.position);
        let apart_m = [apart.east_m - velocity_m_s[0] * stated_s, apart.north_m - velocity_m_s[1] * stated_s];
        let latest = own.time.max(other.time);
        let common = self.under_way.entry(key).or_insert(Common {
            velocity_m_s: [0.0; 2],
            apart_m: [0.0; 2],
            boxes: 0,
            latest,
        });
        for axis in 0..2 {
            common.velocity_m_s[axis] += velocity_m_s[axis];
            common.apart_m[axis] += apart_m[axis];
        }
        common.boxes += 1;
        common.latest = common.latest.max(latest);
    }

    /// Estimates again, at most once a second, if observations have ended; true if it did.
    pub(super) fn advance(&mut self, time: Timestamp) -> bool {
        let since_s = self.swept.map_or(f64::INFINITY, |swept| time.duration_since(swept).as_secs_f64());
        if since_s.abs() < 1.0 {
            return false;
        }
        self.swept = Some(time);
        let is_over =
            |common: &Common| time.duration_since(common.latest).as_secs_f64().abs() > ENDED_AFTER_S;
        let mut has_ended = false;
        for ((pair, _), common) in self.under_way.extract_if(.., |_, common| is_over(common)) {
            if common.boxes < LEAST_BOXES {
                continue;
            }
            let mean = |sums: [f64; 2]| sums.map(|sum| sum / f64::from(common.boxes));
            let own = self.observations.entry(pair).or_default();
            own.push(Observation { velocity_m_s: mean(common.velocity_m_s), apart_m: mean(common.apart_m) });
            if own.len() > MOST_TARGETS {
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

/// Slope and standard deviation of the least-squares line with an intercept, with the weights of Huber; `None` where the
/// velocities hardly differ.
fn line(observations: &[Observation]) -> Option<(f64, f64)> {
    if observations.len() < LEAST_TARGETS {
        return None;
    }
    let mut weights = vec![1.0; observations.len()];
    let mut line = None;
    for _ in 0..ROUNDS {
        let total: f64 = weights.iter().sum();
        let mean = |of: fn(&Observation) -> [f64; 2]| {
            let sum = |axis: usize| {
                observations.iter().zip(&weights).map(|(own, weight)| weight * of(own)[axis]).sum::<f64>()
            };
            [sum(0) / total, sum(1) / total]
        };
        let (velocity, apart) = (mean(|own| own.velocity_m_s), mean(|own| own.apart_m));
        let (mut spread, mut mixed) = (0.0, 0.0);
        for (own, weight) in observations.iter().zip(&weights) {
            for axis in 0..2 {
                let of_velocity = own.velocity_m_s[axis] - velocity[axis];
                spread += weight * of_velocity * of_velocity;
                mixed += weight * of_velocity * (own.apart_m[axis] - apart[axis]);
            }
        }
        if spread < LEAST_SPREAD_M2_S2 * total {
            return None;
        }
        let slope_s = mixed / spread;
        let residual_m = |own: &Observation| {
            let axis =
                |at: usize| own.apart_m[at] - apart[at] - slope_s * (own.velocity_m_s[at] - velocity[at]);
            axis(0).hypot(axis(1))
        };
        let squares = observations.iter().zip(&weights).map(|(own, weight)| weight * residual_m(own).powi(2));
        let variance_m2 = squares.sum::<f64>() / (2.0 * total - 3.0).max(1.0);
        line = Some((slope_s, (variance_m2 / spread).sqrt()));
        let bound_m = HUBER * (2.0 * variance_m2).sqrt();
        weights = observations.iter().map(|own| (bound_m / residual_m(own).max(1e-9)).min(1.0)).collect();
    }
    line
}

/// The clocks of all cameras that pairs tell of.
fn solved(observations: &BTreeMap<CameraPair, Vec<Observation>>) -> BTreeMap<CameraId, CameraClock> {
    let lines: Vec<(&CameraPair, (f64, f64))> =
        observations.iter().filter_map(|(pair, own)| Some((pair, line(own)?))).collect();
    let mut cameras: Vec<&CameraId> = lines.iter().flat_map(|((one, other), _)| [one, other]).collect();
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
    for ((one, other), (slope_s, sigma_s)) in &lines {
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
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|one, other| offsets_s[*one].total_cmp(&offsets_s[*other]));
    let median = order[(count - 1) / 2];
    let clock = |camera: usize| {
        let offset_s = offsets_s[camera] - offsets_s[median];
        let variance_s2 =
            covariance[(camera, camera)] + covariance[(median, median)] - 2.0 * covariance[(camera, median)];
        CameraClock { offset_s, sigma_s: variance_s2.max(0.0).sqrt() }
    };
    cameras.iter().map(|camera| (*camera).clone()).zip((0..count).map(clock)).collect()
}
