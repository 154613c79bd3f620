//! Which piece of a tracklet another one continues, by their positions alone: trackers lose a target and number
//! it again.
//!
//! The end of piece A and the start of piece B are of one target with weight
//!
//! ```text
//! w = (1 - p) / p * exp(-gap / tau) / tau * N(start_B - predicted end_A; S) / density of starts
//! ```
//!
//! where p is the probability that an end is the last of its target. Each end has at most one continuation, and
//! each start continues at most one end. The marginal probabilities under this constraint are found by belief
//! propagation (Williams and Lau 2014, "Approximate evaluation of marginal association probabilities with belief
//! propagation").

use std::f64::consts::{PI, TAU};

use super::tracklet::{SceneMotion, Tracklet};

/// Probability that the end of a tracklet is the last that is seen of its target.
const LAST_PROBABILITY: f64 = 0.4;
/// Mean gap between the tracklets of one target, and the largest that is considered, s.
const GAP_TIME_CONSTANT_S: f64 = 2.0;
const MAX_GAP_S: f64 = 8.0;
/// Two boxes of one target under an old and a new id may overlap by this, s.
const MAX_OVERLAP_S: f64 = 0.6;
/// Time over which the velocity at the end of a tracklet is measured, s.
const VELOCITY_S: f64 = 1.5;
/// Correlation time of a target's velocity, s.
const VELOCITY_TIME_CONSTANT_S: f64 = 8.0;
/// Standard deviation per axis of the start of a continuation that neither the boxes' noise nor the motion explain, m.
const START_SIGMA_M: f64 = 0.2;
/// Share of the scene's speed by which a velocity changes within a gap.
const SPEED_CHANGE: f64 = 0.5;
/// Links below it are left out.
const LEAST_PROBABILITY: f64 = 0.01;
const ITERATIONS: usize = 30;

/// A piece that continues another one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Link {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) probability: f64,
}

/// The links between tracks whose marginal probability is not negligible, in the order of `from`, then `to`.
pub(super) fn links(tracks: &[Tracklet], motion: SceneMotion) -> Vec<Link> {
    let mut weights = weights(tracks, motion);
    // Messages from ends to starts are the weights over what else the end may be; those back, what is left
    // for the end of the start.
    let mut back = vec![1.0; weights.len()];
    for _ in 0..ITERATIONS {
        let mut of_end = vec![1.0; tracks.len()];
        for (link, back) in weights.iter().zip(&back) {
            of_end[link.from] += link.probability * back;
        }
        let forward: Vec<f64> = weights
            .iter()
            .zip(&back)
            .map(|(link, back)| link.probability / (of_end[link.from] - link.probability * back).max(1.0))
            .collect();
        let mut of_start = vec![1.0; tracks.len()];
        for (link, forward) in weights.iter().zip(&forward) {
            of_start[link.to] += forward;
        }
        for ((link, forward), back) in weights.iter().zip(&forward).zip(&mut back) {
            *back = (of_start[link.to] - forward).max(1.0).recip();
        }
    }
    let mut of_end = vec![1.0; tracks.len()];
    for (link, back) in weights.iter().zip(&back) {
        of_end[link.from] += link.probability * back;
    }
    for (link, back) in weights.iter_mut().zip(&back) {
        link.probability *= back / of_end[link.from];
    }
    weights.retain(|link| link.probability >= LEAST_PROBABILITY);
    weights
}

/// Links with their weights instead of probabilities.
fn weights(tracks: &[Tracklet], motion: SceneMotion) -> Vec<Link> {
    let mut by_start: Vec<usize> = (0..tracks.len()).collect();
    let start_s = |at: usize| tracks[at].span_s()[0];
    by_start.sort_by(|one, other| start_s(*one).total_cmp(&start_s(*other)));
    let first_s = by_start.first().map_or(0.0, |at| start_s(*at));
    let last_s = tracks.iter().map(|own| own.span_s()[1]).fold(first_s, f64::max);
    // A disc whose points have the scene's standard deviation.
    let area_m2 = 4.0 * PI * motion.spread_m * motion.spread_m;
    let density = tracks.len() as f64 / ((last_s - first_s).max(1.0) * area_m2);
    let odds = (1.0 - LAST_PROBABILITY) / LAST_PROBABILITY;
    let mut weights = Vec::new();
    for (from, track) in tracks.iter().enumerate() {
        let end_s = track.span_s()[1];
        let begin = by_start.partition_point(|at| start_s(*at) < end_s - MAX_OVERLAP_S);
        for &to in by_start[begin..].iter().take_while(|at| start_s(**at) <= end_s + MAX_GAP_S) {
            if to == from || tracks[to].span_s()[1] <= end_s {
                continue;
            }
            let gap_s = (start_s(to) - end_s).max(0.0);
            let Some(log_density) = log_continuation_density(track, &tracks[to], motion) else { continue };
            let log_weight =
                log_density - gap_s / GAP_TIME_CONSTANT_S - GAP_TIME_CONSTANT_S.ln() - density.ln();
            if log_weight > -6.0 {
                weights.push(Link { from, to, probability: odds * log_weight.min(50.0).exp() });
            }
        }
    }
    weights
}

/// Log density of the first position of a track, predicted from the last ones of another, 1/m2.
fn log_continuation_density(from: &Tracklet, to: &Tracklet, motion: SceneMotion) -> Option<f64> {
    let (end, start) = (from.points.last()?, to.points.first()?);
    let elapsed_s = start.time_s - end.time_s;
    let earlier = from.points.iter().rev().find(|own| end.time_s - own.time_s >= VELOCITY_S);
    let velocity = earlier.map_or([0.0; 2], |earlier| {
        let baseline_s = end.time_s - earlier.time_s;
        [
            (end.position.east_m - earlier.position.east_m) / baseline_s,
            (end.position.north_m - earlier.position.north_m) / baseline_s,
        ]
    });
    let gap_s = elapsed_s.max(0.0);
    let integrated_s = VELOCITY_TIME_CONSTANT_S * (1.0 - (-gap_s / VELOCITY_TIME_CONSTANT_S).exp());
    let east_m = start.position.east_m - end.position.east_m - integrated_s * velocity[0];
    let north_m = start.position.north_m - end.position.north_m - integrated_s * velocity[1];
    let unknown_speed = if earlier.is_some() { SPEED_CHANGE } else { 1.0 };
    let variance_m2 = START_SIGMA_M * START_SIGMA_M
        + end.box_variance_m2
        + start.box_variance_m2
        + (unknown_speed * motion.speed_m_s * elapsed_s).powi(2);
    Some(-(TAU * variance_m2).ln() - 0.5 * (east_m * east_m + north_m * north_m) / variance_m2)
}
