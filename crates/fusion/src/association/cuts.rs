//! Cuts of tracklets where the tracker's id may have moved to another target.
//!
//! For a receiver's fixes within a tracklet, the log-likelihood ratio of the tracklet as a whole is compared
//! with that of its two parts, each carried by that receiver or by nobody, at every instant: a change point
//! (Page 1954). A cut that is not needed costs little, since both parts may be pieces of one chain.

use super::chains::{ChainSettings, Piece};
use super::evidence::{EvidenceModel, LikelihoodRatio};
use super::tracklet::{Residual, TimedFix, Tracklet};

/// Gain of the log-likelihood ratio that makes a cut.
const MIN_GAIN: f64 = 5.0;
/// Log-likelihood ratio that the better part must have.
const MIN_PART: f64 = 2.0;
/// Cuts of one tracklet at most.
const MAX_CUTS: usize = 8;

/// The pieces of all tracklets.
pub(super) fn pieces(
    tracklets: &[Tracklet],
    receivers: &[(&[TimedFix], f64)],
    model: &EvidenceModel,
    settings: &ChainSettings,
) -> Vec<Piece> {
    let mut pieces = Vec::with_capacity(tracklets.len());
    for (index, tracklet) in tracklets.iter().enumerate() {
        let residuals: Vec<Vec<Residual>> = receivers
            .iter()
            .map(|(fixes, offset_s)| tracklet.residuals(fixes, *offset_s, settings.max_gap_s))
            .filter(|own| own.len() >= 2 * settings.min_fixes)
            .collect();
        let mut cuts_s = Vec::new();
        for own in &residuals {
            find_cuts(own, model, settings, &mut cuts_s);
        }
        cuts_s.sort_by(f64::total_cmp);
        cuts_s.dedup_by(|next, before| *next - *before < 2.0);
        cuts_s.truncate(MAX_CUTS);
        let mut first = 0;
        for cut_s in cuts_s {
            let end = tracklet.points.partition_point(|point| point.time_s < cut_s);
            if end > first {
                pieces.push(Piece { tracklet: index, first, end });
                first = end;
            }
        }
        pieces.push(Piece { tracklet: index, first, end: tracklet.points.len() });
    }
    pieces
}

/// Adds the instants at which the residuals of one receiver change, by bisection.
fn find_cuts(residuals: &[Residual], model: &EvidenceModel, settings: &ChainSettings, cuts_s: &mut Vec<f64>) {
    let least = settings.min_fixes;
    if residuals.len() < 2 * least {
        return;
    }
    let prefix: Vec<f64> = prefix_ratios(residuals, model);
    let whole = prefix.last().copied().unwrap_or(0.0);
    let best = (least..=residuals.len() - least)
        .map(|at| {
            let rest = LikelihoodRatio::new().extended(&residuals[at..], model).log_ratio();
            // The better part is the receiver's, the other one somebody else's.
            (at, prefix[at - 1].max(rest))
        })
        .max_by(|one, other| one.1.total_cmp(&other.1));
    let Some((at, part)) = best else { return };
    if part > MIN_PART && part - whole.max(0.0) > MIN_GAIN {
        cuts_s.push(0.5 * (residuals[at - 1].fix.time_s + residuals[at].fix.time_s));
        find_cuts(&residuals[..at], model, settings, cuts_s);
        find_cuts(&residuals[at..], model, settings, cuts_s);
    }
}

fn prefix_ratios(residuals: &[Residual], model: &EvidenceModel) -> Vec<f64> {
    let mut ratio = LikelihoodRatio::new();
    residuals
        .iter()
        .map(|residual| {
            ratio.step(residual, model);
            ratio.log_ratio()
        })
        .collect()
}
