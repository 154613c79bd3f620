//! Chains: sets of pieces of tracklets, without overlap in time, that one receiver may own.

use super::evidence::{EvidenceModel, LikelihoodRatio};
use super::links::links;
use super::tracklet::{MAX_OVERLAP_S, Residual, SceneMotion, TimedFix, Tracklet, concurrent};

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
    /// Probability that the carrier of a receiver is among the boxes.
    pub seen_probability: f64,
    /// Log odds per second that a carrier is seen rather than not, beside the rest.
    pub seen_per_s: f64,
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
            seen_probability: 0.8,
            seen_per_s: 0.05,
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
    /// By piece, those that may continue it, with the probability that they do.
    continuations: Vec<Vec<(usize, f64)>>,
}

impl PieceTable {
    pub(super) fn new(
        tracklets: &[Tracklet],
        pieces: Vec<Piece>,
        motion: SceneMotion,
        settings: &ChainSettings,
    ) -> Self {
        let tracks: Vec<Tracklet> = pieces
            .iter()
            .map(|piece| Tracklet {
                points: tracklets[piece.tracklet].points[piece.first..piece.end].to_vec(),
            })
            .collect();
        let log_prior = tracks
            .iter()
            .map(|own| {
                let concurrent = concurrent(own.span_s(), tracks.iter().map(Tracklet::span_s));
                (settings.seen_probability / concurrent).ln()
            })
            .collect();
        let mut order: Vec<usize> = (0..tracks.len()).collect();
        order.sort_by(|one, other| tracks[*one].span_s()[0].total_cmp(&tracks[*other].span_s()[0]));
        let continuations = continuations(&pieces, &tracks, motion, settings);
        Self { pieces, tracks, log_prior, order, continuations }
    }

    /// The best chains of one receiver by beam search; the first is the empty one.
    pub(super) fn chains(
        &self,
        fixes: &[TimedFix],
        offset_s: f64,
        model: &EvidenceModel,
        settings: &ChainSettings,
    ) -> Vec<Chain> {
        let residuals: Vec<Vec<Residual>> =
            self.tracks.iter().map(|own| own.residuals(fixes, offset_s, settings.max_gap_s)).collect();
        let ends = self.ends(&residuals);
        let unseen = (1.0 - settings.seen_probability).ln();
        let mut beam = vec![Partial {
            pieces: Vec::new(),
            ratio: LikelihoodRatio::new(),
            log_prior: 0.0,
            end_s: f64::NEG_INFINITY,
            log_weight: unseen,
        }];
        for &at in self.order.iter().filter(|at| !residuals[**at].is_empty()) {
            let longer: Vec<Partial> = beam
                .iter()
                .filter_map(|own| self.extended(own, at, &residuals[at], &ends, model, settings))
                .collect();
            beam.extend(longer);
            if beam.len() > 2 * settings.max_chains {
                prune(&mut beam, settings.max_chains);
            }
        }
        for own in &mut beam {
            own.log_weight += own.pieces.last().map_or(0.0, |last| ends.last[*last].ln());
        }
        prune(&mut beam, settings.max_chains);
        beam.into_iter().map(|own| Chain { pieces: own.pieces, log_weight: own.log_weight }).collect()
    }

    /// Probabilities that a piece continues none, and that none continues it, among those with fixes.
    fn ends(&self, residuals: &[Vec<Residual>]) -> Ends {
        let mut ends = Ends { first: vec![1.0; self.tracks.len()], last: vec![1.0; self.tracks.len()] };
        for (from, continuations) in self.continuations.iter().enumerate() {
            for (to, probability) in continuations {
                if !residuals[*to].is_empty() {
                    ends.last[from] -= probability;
                }
                if !residuals[from].is_empty() {
                    ends.first[*to] -= probability;
                }
            }
        }
        for own in ends.first.iter_mut().chain(&mut ends.last) {
            *own = own.max(LEAST_END_PROBABILITY);
        }
        ends
    }

    fn extended(
        &self,
        own: &Partial,
        at: usize,
        residuals: &[Residual],
        ends: &Ends,
        model: &EvidenceModel,
        settings: &ChainSettings,
    ) -> Option<Partial> {
        let [from_s, to_s] = self.tracks[at].span_s();
        if own.pieces.len() >= settings.max_pieces || from_s < own.end_s - MAX_OVERLAP_S {
            return None;
        }
        let last = own.pieces.last();
        let continuation = last.and_then(|last| {
            self.continuations[*last].iter().find(|(to, _)| *to == at).map(|(_, probability)| *probability)
        });
        let step = match continuation {
            Some(probability) => probability.ln(),
            // Fewer fixes tell little about a piece that nothing else links to the receiver.
            None if residuals.len() < settings.min_fixes => return None,
            None => self.log_prior[at] + ends.first[at].ln() + last.map_or(0.0, |last| ends.last[*last].ln()),
        };
        let ratio = own.ratio.extended(residuals, model);
        let covered_s = residuals.last()?.fix.time_s - residuals.first()?.fix.time_s;
        let log_prior = own.log_prior + step + settings.seen_per_s * covered_s;
        let log_weight = ratio.log_ratio() + log_prior;
        // A piece that contradicts the others so much is no part of the chain.
        (log_weight > own.log_weight - MAX_LOSS).then(|| {
            let mut pieces = own.pieces.clone();
            pieces.push(at);
            Partial { pieces, ratio, log_prior, end_s: to_s, log_weight }
        })
    }
}

/// By piece, those that may continue it. A cut says where the tracker's id may have moved on, so it decides between
/// the next piece of the tracklet and all others.
fn continuations(
    pieces: &[Piece],
    tracks: &[Tracklet],
    motion: SceneMotion,
    settings: &ChainSettings,
) -> Vec<Vec<(usize, f64)>> {
    let is_cut = |from: usize, to: usize| {
        pieces[from].tracklet == pieces[to].tracklet && pieces[from].end == pieces[to].first
    };
    let cuts: Vec<usize> = (1..pieces.len()).filter(|at| is_cut(at - 1, *at)).collect();
    let mut continuations = vec![Vec::new(); pieces.len()];
    for link in links(tracks, motion) {
        if is_cut(link.from, link.to) {
            continue;
        }
        let touches_cut = cuts.iter().any(|cut| *cut == link.to || *cut - 1 == link.from);
        let share = if touches_cut { settings.switch_probability } else { 1.0 };
        continuations[link.from].push((link.to, share * link.probability));
    }
    for at in cuts {
        continuations[at - 1].push((at, 1.0 - settings.switch_probability));
    }
    continuations
}

/// Probabilities that a piece is the first, or the last, that is seen of its target.
struct Ends {
    first: Vec<f64>,
    last: Vec<f64>,
}

/// An end is a target's last with at least this probability: a detector may lose anything.
const LEAST_END_PROBABILITY: f64 = 0.03;
/// Largest loss of log weight by one more piece.
const MAX_LOSS: f64 = 6.0;

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
