//! Search of place and direction of a camera whose ground plane is known up to these: nobody says whose
//! fixes belong to whose boxes.
//!
//! With ground points `g` and fixes `z` as complex numbers (east + i north), a placement is `z = w g + t`
//! with `w = s exp(-i yaw)`. Under the coloured noise of a pair of tracklet and receiver (precision K^-1)
//! the log-likelihood is a quadratic form of (w, t) with seven coefficients, so a placement is scored in
//! constant time per pair. Placements that single pairs suggest, and a grid of yaws, are refined by
//! expectation-maximisation: soft assignment of receivers to tracklets, then the least-squares (w, t) in
//! closed form. Where the scale is unknown, the likelihood is that of the ground points given the fixes: `|w|^2` for
//! each point. `docs/explanation/association.md` has the formulas.

use std::cmp::Ordering;

use nalgebra::{Complex, DMatrix};

use super::axis_filter::MAP_TIME_CONSTANT_S;
use super::cancellation::Cancellation;
use super::disjoint;
use super::evidence::{EvidenceModel, free_log_likelihood};
use super::tracklet::{Residual, SceneMotion, TimedFix, Tracklet, concurrent};
use crate::geo::EastNorth;

type C = Complex<f64>;

/// Fixes of a pair at most; more are thinned evenly.
const MAX_FIXES: usize = 40;
/// Fixes of a pair at least.
const MIN_FIXES: usize = 3;
/// Largest gap between two points of a tracklet to interpolate over, s.
const MAX_GAP_S: f64 = 2.5;
/// Probability that the carrier of a receiver is among the boxes.
const SEEN_PROBABILITY: f64 = 0.8;
/// Largest factor between the ground by usual heights and the true one.
const MAX_SCALE: f64 = 100.0;
const YAWS: usize = 48;
/// Longest pairs whose position suggests a translation for each yaw.
const GRID_PAIRS: usize = 80;
/// Longest pairs that suggest a placement each.
const SUGGESTING_PAIRS: usize = 2_000;
/// Placements refined, and rounds of refinement.
const REFINED: usize = 32;
const ROUNDS: usize = 25;
/// Log-likelihood ratios are multiplied by it: what the noise model leaves out makes them overstated.
const TEMPERING: f64 = 0.6;

/// The variable of the densities whose ratio is a likelihood ratio.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Density {
    /// Densities of the fixes, given the boxes.
    Fixes,
    /// Densities of the ground points of the boxes, given the fixes: a ground that has shrunk to the place of an emitter at
    /// anchor explains every fix of that, but no box.
    GroundPoints,
}

/// How well boxes alone determine the ground.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroundPrior {
    /// Standard deviation per axis of a target's position, m.
    pub(super) map_sigma_m: f64,
    /// Standard deviation of the logarithm of the scale.
    pub(super) scale_sigma: f64,
    /// The variable of the evidence's density.
    pub(super) density: Density,
}

/// Scale, direction and place: `z = w g + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Placement {
    turn: C,
    shift_m: C,
    /// Sum over receivers of the log of their evidence, and the log priors of ground and scale.
    pub(super) score: f64,
}

impl Placement {
    /// East and north of a ground point, m.
    pub(super) fn apply(&self, right_m: f64, forward_m: f64) -> [f64; 2] {
        let at = self.turn * C::new(right_m, forward_m) + self.shift_m;
        [at.re, at.im]
    }

    /// Root mean square distance to another placement over ground points, m.
    fn distance_m(&self, other: &Self, points: &[C]) -> f64 {
        let sum: f64 = points
            .iter()
            .map(|point| ((self.turn - other.turn) * point + self.shift_m - other.shift_m).norm_sqr())
            .sum();
        (sum / points.len().max(1) as f64).sqrt()
    }
}

/// Quadratic form of one pair.
struct Pair {
    /// First and last instant of the tracklet, s.
    span_s: [f64; 2],
    /// Log prior odds that the receiver's carrier is the target of the tracklet.
    log_prior_odds: f64,
    /// Log-likelihood ratio at residuals of zero.
    peak: f64,
    ones: f64,
    z: C,
    g: C,
    zz: f64,
    gg: f64,
    gz: C,
    /// Points whose density is taken on the ground.
    ground_points: f64,
}

/// A placement's part of the quadratic forms, the same for all pairs.
struct Coefficients {
    turn: C,
    shift: C,
    turn_squared: f64,
    log_turn_squared: f64,
    shift_squared: f64,
    mixed: C,
}

impl Coefficients {
    fn new(turn: C, shift: C) -> Self {
        let (turn_squared, shift_squared) = (turn.norm_sqr(), shift.norm_sqr());
        let log_turn_squared = turn_squared.ln();
        Self { turn, shift, turn_squared, log_turn_squared, shift_squared, mixed: shift.conj() * turn }
    }
}

impl Pair {
    /// Log-likelihood ratio at a placement: with half the negative of `(z - w g - t)' K^-1 (z - w g - t)`.
    #[inline]
    fn log_ratio(&self, at: &Coefficients) -> f64 {
        let squared = self.zz + at.turn_squared * self.gg + at.shift_squared * self.ones
            - 2.0 * (at.turn.re * self.gz.re + at.turn.im * self.gz.im)
            - 2.0 * (at.shift.re * self.z.re + at.shift.im * self.z.im)
            + 2.0 * (at.mixed.re * self.g.re - at.mixed.im * self.g.im);
        self.peak + self.ground_points * at.log_turn_squared - 0.5 * squared
    }

    /// The longest first, by the weight of its fixes.
    fn by_length(one: &&Self, other: &&Self) -> Ordering {
        other.ones.total_cmp(&one.ones)
    }

    /// Log of prior odds times tempered ratio.
    #[inline]
    fn log_weight(&self, at: &Coefficients) -> f64 {
        TEMPERING * self.log_ratio(at) + self.log_prior_odds
    }
}

/// The tracklets that the carrier of one receiver may have, in the order of their last instants, each with every clock offset
/// that is tried.
struct ReceiverPairs {
    pairs: Vec<Pair>,
    /// By pair, the number of those that end before it begins.
    before: Vec<usize>,
}

impl ReceiverPairs {
    fn new(
        tracklets: &[Tracklet],
        fixes: &[TimedFix],
        offsets_s: &[(f64, f64)],
        (carried, other): (&EvidenceModel, &EvidenceModel),
        ground: &GroundPrior,
    ) -> Self {
        let mut pairs = Vec::new();
        for (offset_s, log_prior) in offsets_s {
            let of_tracklet = |own| pair(own, fixes, *offset_s, (carried, other), ground);
            let of_offset: Vec<Pair> = tracklets.iter().filter_map(of_tracklet).collect();
            let spans_s: Vec<[f64; 2]> = of_offset.iter().map(|own| own.span_s).collect();
            pairs.extend(of_offset.into_iter().map(|own| {
                let candidates = concurrent(own.span_s, spans_s.iter().copied());
                let log_odds = (SEEN_PROBABILITY / (1.0 - SEEN_PROBABILITY) / candidates).ln();
                Pair { log_prior_odds: log_odds + log_prior, ..own }
            }));
        }
        pairs.sort_by(|one, other| one.span_s[1].total_cmp(&other.span_s[1]));
        let spans_s: Vec<[f64; 2]> = pairs.iter().map(|own| own.span_s).collect();
        Self { pairs, before: disjoint::ended_before(&spans_s) }
    }

    fn longest(&self, most: usize) -> Vec<&Pair> {
        let mut order: Vec<&Pair> = self.pairs.iter().collect();
        order.sort_by(Pair::by_length);
        order.truncate(most);
        order
    }

    fn log_weights(&self, at: &Coefficients) -> impl Iterator<Item = (f64, usize)> {
        self.pairs.iter().map(|own| own.log_weight(at)).zip(self.before.iter().copied())
    }

    /// Log-likelihood ratio of the receiver's fixes at a placement, over all sets of tracklets that its carrier may have.
    fn log_evidence(&self, at: &Coefficients) -> f64 {
        disjoint::log_sums(self.log_weights(at)).last().copied().unwrap_or(0.0)
    }

    /// Probability of each pair at a placement.
    fn probabilities(&self, at: &Coefficients) -> Vec<f64> {
        disjoint::probabilities(&self.log_weights(at).collect::<Vec<_>>())
    }
}

/// The pairs of a recording under one ground plane.
pub(super) struct PlacementSearch {
    pairs: Vec<ReceiverPairs>,
    /// Standard deviation of the logarithm of the scale.
    scale_sigma: f64,
    /// Log prior density of the ground plane, a part of every score.
    log_prior: f64,
    /// Some of the ground points, m.
    points: Vec<C>,
}

impl PlacementSearch {
    /// `tracklets` have positions (right, forward) instead of (east, north). `offsets_s` are the clock offsets that are tried,
    /// each with the logarithm of its prior probability.
    pub(super) fn new(
        tracklets: &[Tracklet],
        receivers: &[Vec<TimedFix>],
        offsets_s: &[(f64, f64)],
        model: &EvidenceModel,
        ground: &GroundPrior,
        log_prior: f64,
    ) -> Self {
        // The other hypothesis is that of the side whose density is taken.
        let motion = match ground.density {
            Density::Fixes => model.motion,
            Density::GroundPoints => SceneMotion::of(tracklets),
        };
        let other = EvidenceModel { motion, ..*model };
        let of_receiver =
            |fixes: &Vec<TimedFix>| ReceiverPairs::new(tracklets, fixes, offsets_s, (model, &other), ground);
        let pairs = receivers.iter().map(of_receiver).collect();
        let all: Vec<C> = tracklets
            .iter()
            .flat_map(|own| &own.points)
            .map(|point| C::new(point.position.east_m, point.position.north_m))
            .collect();
        let stride = all.len().div_ceil(200).max(1);
        Self {
            pairs,
            scale_sigma: ground.scale_sigma,
            log_prior,
            points: all.into_iter().step_by(stride).collect(),
        }
    }

    /// Log-likelihood ratio of each pair where ground and plane are the same.
    #[cfg(test)]
    pub(super) fn log_ratios_at_identity(&self) -> Vec<f64> {
        let all_pairs = self.pairs.iter().flat_map(|own| &own.pairs);
        all_pairs.map(|pair| pair.log_ratio(&Coefficients::new(C::new(1.0, 0.0), C::default()))).collect()
    }

    /// The longest pairs, those of all receivers among them: pairs of a few only would all be wrong where these are out of
    /// view.
    fn longest(&self, most: usize) -> Vec<&Pair> {
        let per_receiver = (most / self.pairs.len().max(1)).max(4);
        let mut longest: Vec<&Pair> = self.pairs.iter().flat_map(|own| own.longest(per_receiver)).collect();
        longest.sort_by(Pair::by_length);
        longest.truncate(most);
        longest
    }

    fn score(&self, turn: C, shift: C) -> f64 {
        let scale = turn.norm().ln() / self.scale_sigma;
        let at = Coefficients::new(turn, shift);
        let evidence: f64 = self.pairs.iter().map(|own| own.log_evidence(&at)).sum();
        evidence + self.log_prior - 0.5 * scale * scale
    }

    /// The best placements that differ from each other, the best first. The best starts lie mostly about the best
    /// placement, so others are also searched for farther away than `apart_m` from it.
    /// None once it is cancelled.
    pub(super) fn search(&self, most: usize, apart_m: f64, cancellation: Cancellation<'_>) -> Vec<Placement> {
        let mut starts = self.suggested(cancellation);
        starts.extend(self.grid(cancellation));
        starts.sort_by(|one, other| other.score.total_cmp(&one.score));
        let near = distinct(&starts, &self.points, REFINED, 1.0);
        let refined = |starts: Vec<Placement>| {
            let going_on = starts.into_iter().take_while(|_| !cancellation.is_cancelled());
            going_on.map(|start| self.refined(start)).collect::<Vec<_>>()
        };
        let mut modes = refined(near);
        modes.sort_by(|one, other| other.score.total_cmp(&one.score));
        if let Some(best) = modes.first().copied() {
            starts.retain(|start| start.distance_m(&best, &self.points) > apart_m);
            let far = distinct(&starts, &self.points, REFINED, 0.5 * apart_m);
            modes.extend(refined(far));
        }
        modes.sort_by(|one, other| other.score.total_cmp(&one.score));
        if cancellation.is_cancelled() { Vec::new() } else { distinct(&modes, &self.points, most, 1.0) }
    }

    /// The placement that each of the longest pairs alone suggests: scoring one takes all pairs.
    fn suggested(&self, cancellation: Cancellation<'_>) -> Vec<Placement> {
        self.longest(SUGGESTING_PAIRS)
            .into_iter()
            .take_while(|_| !cancellation.is_cancelled())
            .filter_map(|pair| {
                let moved = pair.gz - pair.g.conj() * pair.z / pair.ones;
                let spread = pair.gg - pair.g.norm_sqr() / pair.ones;
                // A target that stands still tells no direction.
                (moved.norm() > 4.0 && spread > 4.0).then(|| {
                    let turn = moved / moved.norm() * self.scale(moved.norm(), spread, pair.ground_points);
                    self.placed(turn, (pair.z - turn * pair.g) / pair.ones)
                })
            })
            .collect()
    }

    /// For each yaw the translations that the longest pairs suggest.
    fn grid(&self, cancellation: Cancellation<'_>) -> Vec<Placement> {
        let longest = self.longest(GRID_PAIRS);
        let mut best = Vec::with_capacity(YAWS * 3);
        for step in (0..YAWS).take_while(|_| !cancellation.is_cancelled()) {
            let turn = C::from_polar(1.0, step as f64 / YAWS as f64 * std::f64::consts::TAU);
            let mut own: Vec<Placement> =
                longest.iter().map(|pair| self.placed(turn, (pair.z - turn * pair.g) / pair.ones)).collect();
            own.sort_by(|one, other| other.score.total_cmp(&one.score));
            best.extend(own.into_iter().take(3));
        }
        best
    }

    /// The scale s of greatest `s moved - s^2 spread / 2 + 2 n ln s` with n ground points, by the prior to first order about 1.
    fn scale(&self, moved: f64, spread: f64, ground_points: f64) -> f64 {
        let precision = self.scale_sigma.powi(-2);
        let (moved, spread) = (moved + precision, spread + precision);
        let scale = (moved + (moved * moved + 8.0 * spread * ground_points).sqrt()) / (2.0 * spread);
        scale.clamp(1.0 / MAX_SCALE, MAX_SCALE)
    }

    fn placed(&self, turn: C, shift: C) -> Placement {
        Placement { turn, shift_m: shift, score: self.score(turn, shift) }
    }

    /// Expectation-maximisation from a placement; the best of its rounds.
    fn refined(&self, start: Placement) -> Placement {
        let (mut best, mut at) = (start, start);
        for _ in 0..ROUNDS {
            let Some(next) = self.maximised(at.turn, at.shift_m) else { break };
            let gain = next.score - at.score;
            at = next;
            if at.score > best.score {
                best = at;
            }
            if gain.abs() < 1e-3 {
                break;
            }
        }
        best
    }

    fn maximised(&self, turn: C, shift: C) -> Option<Placement> {
        let (mut ones, mut gg, mut ground_points) = (0.0, 0.0, 0.0);
        let (mut z, mut g, mut gz) = (C::default(), C::default(), C::default());
        let at = Coefficients::new(turn, shift);
        for own in &self.pairs {
            for (pair, probability) in own.pairs.iter().zip(own.probabilities(&at)) {
                let weight = TEMPERING * probability;
                ones += weight * pair.ones;
                gg += weight * pair.gg;
                ground_points += weight * pair.ground_points;
                z += pair.z * weight;
                g += pair.g * weight;
                gz += pair.gz * weight;
            }
        }
        let spread = gg - g.norm_sqr() / ones;
        if !(ones > 1e-9 && spread > 1e-9) {
            return None;
        }
        let moved = gz - g.conj() * z / ones;
        let turn = moved / moved.norm().max(1e-12) * self.scale(moved.norm(), spread, ground_points);
        Some(self.placed(turn, (z - turn * g) / ones))
    }
}

/// Those that differ from all better ones by at least a distance, m, up to a number.
fn distinct(sorted: &[Placement], points: &[C], most: usize, apart_m: f64) -> Vec<Placement> {
    let mut kept: Vec<Placement> = Vec::new();
    for own in sorted {
        if kept.len() == most {
            break;
        }
        if kept.iter().all(|better| better.distance_m(own, points) > apart_m) {
            kept.push(*own);
        }
    }
    kept
}

fn pair(
    tracklet: &Tracklet,
    fixes: &[TimedFix],
    offset_s: f64,
    (model, other): (&EvidenceModel, &EvidenceModel),
    ground: &GroundPrior,
) -> Option<Pair> {
    let map_sigma_m = ground.map_sigma_m;
    let residuals = tracklet.residuals(fixes, offset_s, MAX_GAP_S);
    let stride = residuals.len().div_ceil(MAX_FIXES).max(1);
    let rows: Vec<_> = residuals.into_iter().step_by(stride).collect();
    if rows.len() < MIN_FIXES {
        return None;
    }
    let bias_m2 = model.gnss.coloured_variance_m2();
    let white_m2 = model.gnss.white_variance_m2();
    let covariance = DMatrix::from_fn(rows.len(), rows.len(), |i, j| {
        let lag_s = (rows[i].fix.time_s - rows[j].fix.time_s).abs();
        let white = if i == j { white_m2 + rows[i].box_variance_m2 } else { 0.0 };
        bias_m2 * model.gnss.correlation.decay(lag_s)
            + map_sigma_m * map_sigma_m * (-lag_s / MAP_TIME_CONSTANT_S).exp()
            + white
    });
    let factor = covariance.cholesky()?;
    let log_determinant = 2.0 * factor.l_dirty().diagonal().iter().map(|own| own.ln()).sum::<f64>();
    let count = rows.len() as f64;
    let on_ground = |row: &Residual| {
        let [east_m, north_m] = row.difference_m;
        row.fix.position.minus(EastNorth { east_m, north_m })
    };
    let observed: Vec<TimedFix> = match ground.density {
        Density::Fixes => rows.iter().map(|row| row.fix).collect(),
        Density::GroundPoints => {
            rows.iter().map(|row| TimedFix { position: on_ground(row), ..row.fix }).collect()
        }
    };
    let ground_points = if ground.density == Density::GroundPoints { count } else { 0.0 };
    let peak = -log_determinant - count * std::f64::consts::TAU.ln() - free_log_likelihood(&observed, other);
    // Columns: one, z (east, north), g (right, forward), whitened.
    let mut columns = DMatrix::from_fn(rows.len(), 5, |i, column| {
        let (fix, point) = (rows[i].fix.position, on_ground(&rows[i]));
        [1.0, fix.east_m, fix.north_m, point.east_m, point.north_m][column]
    });
    factor.l_dirty().solve_lower_triangular_mut(&mut columns);
    let dot = |a: usize, b: usize| columns.column(a).dot(&columns.column(b));
    Some(Pair {
        span_s: tracklet.span_s(),
        log_prior_odds: 0.0,
        peak,
        ones: dot(0, 0),
        z: C::new(dot(0, 1), dot(0, 2)),
        g: C::new(dot(0, 3), dot(0, 4)),
        zz: dot(1, 1) + dot(2, 2),
        gg: dot(3, 3) + dot(4, 4),
        // conj(g) z
        gz: C::new(dot(3, 1) + dot(4, 2), dot(3, 2) - dot(4, 1)),
        ground_points,
    })
}
