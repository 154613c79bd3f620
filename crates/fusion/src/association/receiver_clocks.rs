//! The offsets of receivers' clocks from those of the cameras, from the tracks of the targets that carry them.
//!
//! A receiver whose times are late by `o` states where its carrier was `o` ago:
//!
//! ```text
//! z(t) - p(t) = b + m + w - o v(t)
//! ```
//!
//! with the track's position p and velocity v, the receiver's bias b and the map's error m (Gauss-Markov) and the white noise
//! w. A filter of b and m whitens both sides, and `o` is the slope of least squares; Gauss-Newton steps move p and v along
//! the track. Who walks straight on tells little, since b looks the same; turns and starts tell.
//!
//! Receivers have the time of GNSS, so what most of them have in common is an offset of the cameras' clocks.

use std::collections::BTreeMap;

use super::axis_filter::AxisFilter;
use super::evidence::EvidenceModel;
use super::tracklet::{TimedFix, TrackPoint, Tracklet};
use crate::clock_estimate::ClockEstimate;
use crate::domain::ReceiverId;

/// Half of the interval over which a velocity is the slope of a line, s.
const VELOCITY_S: f64 = 2.0;
/// Points of such a line at least.
const LEAST_POINTS: usize = 4;
/// Positions are interpolated over at most this gap, s.
const MAX_GAP_S: f64 = 2.5;
/// Fixes of an estimate at least.
const LEAST_FIXES: usize = 15;
/// Standard deviation of an offset before anything is known, s.
const PRIOR_S: f64 = 5.0;
/// An offset beyond this is not looked for, s.
const LARGEST_S: f64 = 10.0;
/// Steps of Gauss-Newton.
const STEPS: usize = 5;
/// A fix whose normalised square of both axes is above this, after the first step, is a gross error.
const GROSS_SQUARE: f64 = 25.0;
/// Degrees of freedom of the prior of the noise.
const FREEDOM: f64 = 4.0;
/// Receivers that tell what all have in common, at least.
const LEAST_RECEIVERS: usize = 3;
/// Standard deviation of right clocks of receivers about each other, s: the delay of their filters.
const BETWEEN_S: f64 = 0.1;
/// Standard deviation of what all have in common beside a clock, s: tracks follow turns with a delay.
const DELAY_S: f64 = 0.1;
/// Standardised distance from which on a receiver counts less for what all have in common (weights of Huber).
const HUBER: f64 = 1.5;
const ROUNDS: usize = 10;

/// The clocks of a site's receivers beside those of its cameras.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReceiverClocks {
    /// How late the receivers' times are, of those that tell.
    pub by_receiver: BTreeMap<ReceiverId, ClockEstimate>,
    /// What most of them have in common, from three receivers on: with the sign changed it is how late the cameras are.
    pub common: Option<ClockEstimate>,
}

impl ReceiverClocks {
    /// From the estimates of single receivers.
    pub(super) fn new(by_receiver: BTreeMap<ReceiverId, ClockEstimate>) -> Self {
        Self { common: common(&by_receiver), by_receiver }
    }

    /// What is taken off a receiver's times, s: what all have in common, where that is wrong, and its own offset, where
    /// that differs from it.
    #[must_use]
    pub fn corrected_s(&self, receiver: &ReceiverId) -> f64 {
        let common_s = self.common.filter(ClockEstimate::is_wrong).map_or(0.0, |common| common.offset_s);
        let Some(own) = self.by_receiver.get(receiver) else { return common_s };
        let difference = ClockEstimate { offset_s: own.offset_s - common_s, ..*own };
        if difference.is_wrong() { own.offset_s } else { common_s }
    }
}

/// What all but one receiver have in common, without the one that makes it most significant: a single receiver that is known
/// better than all others does not speak for them. `None` for few receivers.
fn common(by_receiver: &BTreeMap<ReceiverId, ClockEstimate>) -> Option<ClockEstimate> {
    if by_receiver.len() < LEAST_RECEIVERS {
        return None;
    }
    let without = |left_out: &ReceiverId| {
        let others = by_receiver.iter().filter(|(receiver, _)| *receiver != left_out);
        robust_mean(&others.map(|(_, own)| *own).collect::<Vec<_>>())
    };
    let significance = |own: &ClockEstimate| (own.offset_s / own.sigma_s).abs();
    by_receiver.keys().map(without).min_by(|one, other| significance(one).total_cmp(&significance(other)))
}

/// The mean of receivers' offsets by weights of Huber.
fn robust_mean(receivers: &[ClockEstimate]) -> ClockEstimate {
    let variance_s2 = |own: &ClockEstimate| own.sigma_s.powi(2) + BETWEEN_S.powi(2);
    let mut mean = ClockEstimate { offset_s: 0.0, sigma_s: f64::INFINITY, drift: None };
    for round in 0..ROUNDS {
        let (mut weights, mut sum) = (0.0, 0.0);
        for own in receivers {
            let apart = (own.offset_s - mean.offset_s).abs() / variance_s2(own).sqrt();
            let weight = if round == 0 { 1.0 } else { (HUBER / apart.max(1e-9)).min(1.0) } / variance_s2(own);
            weights += weight;
            sum += weight * own.offset_s;
        }
        let variance_s2 = weights.recip() + DELAY_S.powi(2);
        mean = ClockEstimate { offset_s: sum / weights, sigma_s: variance_s2.sqrt(), drift: None };
    }
    mean
}

/// The parts of tracks that show the carrier of one receiver, and its fixes in the order of time.
pub(super) struct CarriedFixes<'a> {
    pub(super) pieces: &'a [&'a [TrackPoint]],
    pub(super) fixes: &'a [TimedFix],
}

/// Sums over whitened fixes, of velocities v and differences d.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    vv: f64,
    vd: f64,
    dd: f64,
    fixes: usize,
}

impl CarriedFixes<'_> {
    /// How late the receiver's times are; `None` for few fixes, or an offset that is too large.
    pub(super) fn clock(&self, model: &EvidenceModel) -> Option<ClockEstimate> {
        let (mut offset_s, mut sums, mut precision) = (0.0, Sums::default(), 0.0);
        for step in 0..STEPS {
            sums = self.sums(offset_s, model, step > 0);
            if sums.fixes < LEAST_FIXES {
                return None;
            }
            let prior = PRIOR_S.powi(-2);
            precision = sums.vv + prior;
            offset_s -= (sums.vd + prior * offset_s) / precision;
            if !offset_s.is_finite() || offset_s.abs() > LARGEST_S {
                return None;
            }
        }
        let left = (sums.dd - sums.vd * sums.vd / precision).max(0.0);
        let scale = (FREEDOM + left) / (FREEDOM + 2.0 * sums.fixes as f64);
        Some(ClockEstimate { offset_s, sigma_s: (scale.max(1.0) / precision).sqrt(), drift: None })
    }

    /// The sums about an offset.
    fn sums(&self, offset_s: f64, model: &EvidenceModel, leaves_out: bool) -> Sums {
        let (mut filter, mut last_s, mut sums) = (AxisFilter::<2, 4>::new(), None, Sums::default());
        for fix in self.fixes {
            let Some((point, [v_east, v_north])) = self.carrier_at(fix.time_s - offset_s) else { continue };
            let elapsed_s = last_s.replace(fix.time_s).map(|last_s| fix.time_s - last_s);
            let variances_m2 = [model.bias_m2(fix), point.map_variance_m2];
            filter.advance(elapsed_s, variances_m2, model.gnss.correlation);
            let d_east = fix.position.east_m - point.position.east_m;
            let d_north = fix.position.north_m - point.position.north_m;
            let noise_m2 = model.gnss.white_variance_m2() + point.box_variance_m2;
            let own = filter.innovation([d_east, d_north, v_east, v_north], [true; 2], noise_m2);
            let [d_east, d_north, v_east, v_north] = own.values;
            let dd = (d_east * d_east + d_north * d_north) / own.variance;
            if leaves_out && dd > GROSS_SQUARE {
                continue;
            }
            filter.correct(&own);
            sums.fixes += 1;
            sums.dd += dd;
            sums.vd += (d_east * v_east + d_north * v_north) / own.variance;
            sums.vv += (v_east * v_east + v_north * v_north) / own.variance;
        }
        sums
    }

    /// Position and velocity of the carrier at an instant, m and m/s, where a track has it.
    fn carrier_at(&self, time_s: f64) -> Option<(TrackPoint, [f64; 2])> {
        self.pieces.iter().find_map(|points| {
            let point = Tracklet::between(points, time_s, MAX_GAP_S)?;
            Some((point, velocity_m_s(points, time_s)?))
        })
    }
}

/// Slope of the line through the points about an instant, m/s.
fn velocity_m_s(points: &[TrackPoint], time_s: f64) -> Option<[f64; 2]> {
    let first = points.partition_point(|point| point.time_s < time_s - VELOCITY_S);
    let end = points.partition_point(|point| point.time_s <= time_s + VELOCITY_S);
    let about = points.get(first..end).filter(|about| about.len() >= LEAST_POINTS)?;
    let count = about.len() as f64;
    let mean = |of: &dyn Fn(&TrackPoint) -> f64| about.iter().map(of).sum::<f64>() / count;
    let mean_s = mean(&|point| point.time_s);
    let square_s2 = mean(&|point| (point.time_s - mean_s).powi(2));
    let slope = |of: fn(&TrackPoint) -> f64| mean(&|point| (point.time_s - mean_s) * of(point)) / square_s2;
    let slopes = [slope(|point| point.position.east_m), slope(|point| point.position.north_m)];
    slopes.iter().all(|slope| slope.is_finite()).then_some(slopes)
}
