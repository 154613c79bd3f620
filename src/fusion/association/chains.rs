//! Chains: sets of pieces of tracklets, without overlap in time, that one receiver may own.

use super::evidence::{EvidenceModel, LikelihoodRatio};
use super::tracklet::{Residual, SceneMotion, TimedFix, Tracklet};

/// A part of a tracklet between two cuts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Piece {
    /// Index of the tracklet.
    pub(super) tracklet: usize,
    /// First of its points.
    pub(super) first: usize,
    /// Behind its last point.
    pub(super) end: usize,
}

/// Settings of the enumeration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainSettings {
    /// Fixes within a piece at least.
    pub min_fixes: usize,
    /// Pieces of one chain at most.
    pub max_pieces: usize,
    /// Chains kept per receiver.
    pub max_chains: usize,
    /// Largest gap between two points of a tracklet to interpolate over, s.
    pub max_gap_s: f64,
    /// Overlap of two pieces of one chain that is tolerated, s.
    pub max_overlap_s: f64,
    /// Factor on log-likelihood ratios: what the model of the noise leaves out makes them overstated.
    pub tempering: f64,
    /// Probability that the carrier of a receiver is among the boxes.
    pub seen_probability: f64,
    /// Log odds per second that a carrier is seen rather than not, beside the rest.
    pub seen_per_s: f64,
    /// Log prior odds, at most, that a tracklet that begins where and when another one ends is of the same
    /// target rather than of another one.
    pub max_continuation: f64,
    /// Standard deviation per axis of a tracklet's ends, m.
    pub end_sigma_m: f64,
    /// Probability that a tracklet goes on with another target after a cut.
    pub switch_probability: f64,
}

impl Default for ChainSettings {
    fn default() -> Self {
        Self {
            min_fixes: 3,
            max_pieces: 100,
            max_chains: 60,
            max_gap_s: 2.5,
            max_overlap_s: 0.6,
            tempering: 0.7,
            seen_probability: 0.8,
            seen_per_s: 0.2,
            max_continuation: 0.7,
            end_sigma_m: 0.5,
            switch_probability: 0.2,
        }
    }
}

/// A chain with its log weight against the empty chain.
#[derive(Debug, Clone)]
pub(super) struct Chain {
    /// Indices of pieces, in order of time.
    pub(super) pieces: Vec<usize>,
    pub(super) log_weight: f64,
}

/// Pieces as the enumeration sees them.
pub(super) struct PieceTable {
    pub(super) pieces: Vec<Piece>,
    /// Each as a tracklet of its own.
    pub(super) tracks: Vec<Tracklet>,
    /// Log prior probability that a given receiver's carrier is the target of the piece.
    log_prior: Vec<f64>,
    /// In order of their first instants.
    order: Vec<usize>,
}

impl PieceTable {
    pub(super) fn new(tracklets: &[Tracklet], pieces: Vec<Piece>, settings: &ChainSettings) -> Self {
        let tracks: Vec<Tracklet> = pieces
            .iter()
            .map(|piece| Tracklet {
                points: tracklets[piece.tracklet].points[piece.first..piece.end].to_vec(),
            })
            .collect();
        let log_prior = tracks
            .iter()
            .map(|own| {
                let [from_s, to_s] = own.span_s();
                let overlap_s: f64 =
                    tracks.iter().map(|other| overlap_s([from_s, to_s], other.span_s())).sum();
                let concurrent = (overlap_s / (to_s - from_s).max(0.5)).max(1.0);
                (settings.seen_probability / concurrent).ln()
            })
            .collect();
        let mut order: Vec<usize> = (0..tracks.len()).collect();
        order.sort_by(|one, other| tracks[*one].span_s()[0].total_cmp(&tracks[*other].span_s()[0]));
        Self { pieces, tracks, log_prior, order }
    }

    /// The best chains of one receiver by beam search; the first is the empty one.
    pub(super) fn chains(
        &self,
        fixes: &[TimedFix],
        offset_s: f64,
        model: &EvidenceModel,
        settings: &ChainSettings,
    ) -> Vec<Chain> {
        let mut beam = vec![Partial {
            pieces: Vec::new(),
            ratio: LikelihoodRatio::new(),
            log_prior: (1.0 - settings.seen_probability).ln(),
            end_s: f64::NEG_INFINITY,
            log_weight: (1.0 - settings.seen_probability).ln(),
        }];
        for &at in &self.order {
            let residuals = self.tracks[at].residuals(fixes, offset_s, settings.max_gap_s);
            if residuals.len() < settings.min_fixes {
                continue;
            }
            let longer: Vec<Partial> =
                beam.iter().filter_map(|own| self.extended(own, at, &residuals, model, settings)).collect();
            beam.extend(longer);
            if beam.len() > 2 * settings.max_chains {
                prune(&mut beam, settings.max_chains);
            }
        }
        prune(&mut beam, settings.max_chains);
        beam.into_iter().map(|own| Chain { pieces: own.pieces, log_weight: own.log_weight }).collect()
    }

    /// Log density of the first position of a piece, if its target is that of an earlier piece, against that
    /// of a target anywhere in the scene.
    fn continuity(&self, last: usize, next: usize, motion: SceneMotion, settings: &ChainSettings) -> f64 {
        let (Some(end), Some(start)) = (self.tracks[last].points.last(), self.tracks[next].points.first())
        else {
            return 0.0;
        };
        let gap_s = start.time_s - end.time_s;
        let earlier = self.tracks[last].points.iter().rev().find(|own| end.time_s - own.time_s >= VELOCITY_S);
        let velocity = earlier.map_or([0.0; 2], |earlier| {
            let elapsed_s = end.time_s - earlier.time_s;
            [
                (end.position.east_m - earlier.position.east_m) / elapsed_s,
                (end.position.north_m - earlier.position.north_m) / elapsed_s,
            ]
        });
        // A target keeps its velocity for a few seconds.
        let lever_s = VELOCITY_TIME_CONSTANT_S * (1.0 - (-gap_s.max(0.0) / VELOCITY_TIME_CONSTANT_S).exp());
        let east_m = start.position.east_m - end.position.east_m - lever_s * velocity[0];
        let north_m = start.position.north_m - end.position.north_m - lever_s * velocity[1];
        let moved_m2 = (0.5 * motion.speed_m_s * gap_s).powi(2);
        let scene_m2 = motion.spread_m * motion.spread_m;
        let variance_m2 = settings.end_sigma_m * settings.end_sigma_m + moved_m2.min(scene_m2);
        1.0 + (scene_m2 / variance_m2).ln() - 0.5 * (east_m * east_m + north_m * north_m) / variance_m2
    }

    fn extended(
        &self,
        own: &Partial,
        at: usize,
        residuals: &[Residual],
        model: &EvidenceModel,
        settings: &ChainSettings,
    ) -> Option<Partial> {
        let [from_s, to_s] = self.tracks[at].span_s();
        if own.pieces.len() >= settings.max_pieces || from_s < own.end_s - settings.max_overlap_s {
            return None;
        }
        let ratio = own.ratio.extended(residuals, model);
        let continues = own.pieces.last().is_some_and(|last| {
            let (last, next) = (self.pieces[*last], self.pieces[at]);
            last.tracklet == next.tracklet && last.end == next.first
        });
        let step = if continues {
            (1.0 - settings.switch_probability).ln()
        } else {
            let continuity =
                own.pieces.last().map_or(0.0, |last| self.continuity(*last, at, model.motion, settings));
            (self.log_prior[at] + continuity).min(settings.max_continuation)
        };
        let covered_s = residuals.last()?.fix.time_s - residuals.first()?.fix.time_s;
        let log_prior = own.log_prior + step + settings.seen_per_s * covered_s;
        let log_weight = settings.tempering * ratio.log_ratio + log_prior;
        // A piece that contradicts the others so much is no part of the chain.
        (log_weight > own.log_weight - 6.0).then(|| {
            let mut pieces = own.pieces.clone();
            pieces.push(at);
            Partial { pieces, ratio, log_prior, end_s: to_s, log_weight }
        })
    }
}

/// Time over which the velocity at the end of a tracklet is measured, s.
const VELOCITY_S: f64 = 1.5;
/// Correlation time of a target's velocity, s.
const VELOCITY_TIME_CONSTANT_S: f64 = 8.0;

/// A chain that may grow.
#[derive(Clone)]
struct Partial {
    pieces: Vec<usize>,
    ratio: LikelihoodRatio,
    log_prior: f64,
    end_s: f64,
    log_weight: f64,
}

/// Keeps the heaviest chains, and the empty one at the front.
fn prune(beam: &mut Vec<Partial>, most: usize) {
    beam[1..].sort_by(|one, other| other.log_weight.total_cmp(&one.log_weight));
    beam.truncate(most.max(1));
}

fn overlap_s([from_s, to_s]: [f64; 2], [other_from_s, other_to_s]: [f64; 2]) -> f64 {
    (to_s.min(other_to_s) - from_s.max(other_from_s)).max(0.0)
}
