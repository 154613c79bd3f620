//! Tracklets of people who walk together share their receivers.
//!
//! The fixes of a carrier hardly tell it from a companion: a receiver's bias is larger than the distance between them. But the log
//! weights of their chains differ by far more than the fixes tell, for they compare other fixes (the tracklet that is seen
//! longer has more fixes that agree with it, although they agreed as well if the carrier were beside it, beyond the border or
//! under another id), and the noise of boxes differs. So the posterior probabilities of companions are shared by the odds
//! of hypotheses about the same fixes: the carrier is X, or it is Y.
//!
//! ```text
//! ln O(X) = ln(u_Y exp L + (1 - u_Y) exp L_X)
//! ```
//!
//! `L` is the log-likelihood ratio of all fixes during X or Y, compared with X where X is seen and else with Y; `L_X` is that
//! of the fixes during X; `u_Y` is the probability that X is unseen beside Y while Y is seen alone.

use super::companions::{ENTERING_S, MISSED};
use super::evidence::{EvidenceModel, LikelihoodRatio};
use super::tracklet::{MAX_OVERLAP_S, Residual, TimedFix, Tracklet};

/// Largest mean distance of companions while both are seen, m.
const APART_M: f64 = 1.5;
/// Companions are both seen for at least this time, s, and for this share of the shorter tracklet.
const LEAST_TOGETHER_S: f64 = 2.0;
const LEAST_TOGETHER_SHARE: f64 = 0.5;
/// Differences of companions' positions are means over the time so long before and after a fix, s.
const SMOOTHED_S: f64 = 3.0;
/// A receiver's posterior probability below which a tracklet has nothing to share.
const LEAST_PROBABILITY: f64 = 0.01;

/// Who walks with whom.
pub(super) struct Company<'a> {
    tracks: &'a [Tracklet],
    /// By tracklet, its companions.
    companions: Vec<Vec<usize>>,
    /// By tracklet, the time for which it is seen without company, s.
    alone_s: Vec<f64>,
    /// Largest gap between two points of a tracklet to interpolate over, s.
    max_gap_s: f64,
}

impl<'a> Company<'a> {
    pub(super) fn new(tracks: &'a [Tracklet], max_gap_s: f64) -> Self {
        let companions = companions(tracks, max_gap_s);
        let alone_s = tracks.iter().zip(&companions).map(|(own, companions)| {
            let [from_s, to_s] = own.span_s();
            let spans_s = companions.iter().map(|other| tracks[*other].span_s()).collect();
            to_s - from_s - covered_s([from_s, to_s], spans_s)
        });
        Self { tracks, alone_s: alone_s.collect(), companions, max_gap_s }
    }

    /// The probabilities that the carrier of one receiver is the target of each tracklet, shared by companions.
    pub(super) fn shared(
        &self,
        probabilities: &[f64],
        (fixes, offset_s): (&[TimedFix], f64),
        model: &EvidenceModel,
    ) -> Vec<f64> {
        let is_shared = |at: usize| {
            let mut all = self.companions[at].iter().chain([&at]);
            !self.companions[at].is_empty() && all.any(|own| probabilities[*own] >= LEAST_PROBABILITY)
        };
        let residuals = |at: usize| match is_shared(at) {
            true => self.tracks[at].residuals(fixes, offset_s, self.max_gap_s),
            false => Vec::new(),
        };
        let residuals: Vec<Vec<Residual>> = (0..self.tracks.len()).map(residuals).collect();
        let own = |at: usize| self.share(at, probabilities, &residuals, model);
        (0..probabilities.len()).map(own).collect()
    }

    /// The probability that companions have together while a tracklet is seen, and its part of it.
    fn share(
        &self,
        at: usize,
        probabilities: &[f64],
        residuals: &[Vec<Residual>],
        model: &EvidenceModel,
    ) -> f64 {
        let [from_s, to_s] = self.tracks[at].span_s();
        let (mut all, mut weights, mut sum_s) = (probabilities[at], 0.0, 0.0);
        for other in &self.companions[at] {
            let both_s = together_s(&self.tracks[at], &self.tracks[*other]);
            all += probabilities[*other] * both_s / (to_s - from_s);
            if probabilities[at].max(probabilities[*other]) >= LEAST_PROBABILITY {
                weights += both_s * self.log_odds(*other, at, residuals, model).exp();
            }
            sum_s += both_s;
        }
        if sum_s == 0.0 {
            return probabilities[at];
        }
        // Those who are seen one after another, such as a target under two ids, are one alternative.
        let covered_s = to_s - from_s - self.alone_s[at];
        all.min(1.0) / (1.0 + weights / covered_s)
    }

    /// `ln O(one) - ln O(other)`.
    fn log_odds(&self, one: usize, other: usize, residuals: &[Vec<Residual>], model: &EvidenceModel) -> f64 {
        let merged = merged(&residuals[one], &residuals[other]);
        let log_odds = |carrier: usize, companion: usize, alone: Seen| {
            let unseen = self.unseen([one, other][carrier], companion);
            let with = log_ratio(merged.iter().map(|own| own.carried[carrier]), model);
            let own = merged.iter().filter(|own| own.seen != alone);
            let without = log_ratio(own.map(|own| own.carried[carrier]), model);
            let most = with.max(without);
            most + (unseen * (with - most).exp() + (1.0 - unseen) * (without - most).exp()).ln()
        };
        log_odds(0, other, Seen::Other) - log_odds(1, one, Seen::One)
    }

    /// Probability that a target is unseen beside a companion while that is seen. Another companion's tracklet that is not seen
    /// at the same time as the target's may be the target under another id.
    fn unseen(&self, at: usize, companion: usize) -> f64 {
        let may_be_it = |other: &&usize| together_s(&self.tracks[at], &self.tracks[**other]) <= MAX_OVERLAP_S;
        let others = self.companions[companion].iter().filter(may_be_it);
        let seen_s = others.chain([&at]).map(|other| self.tracks[*other].span_s()).collect();
        let span_s = self.tracks[companion].span_s();
        let unseen_s = span_s[1] - span_s[0] - covered_s(span_s, seen_s);
        MISSED + (1.0 - MISSED) * (-unseen_s / ENTERING_S).exp()
    }
}

fn log_ratio(residuals: impl Iterator<Item = Residual>, model: &EvidenceModel) -> f64 {
    let mut ratio = LikelihoodRatio::new();
    residuals.for_each(|own| ratio.step(&own, model));
    ratio.log_ratio()
}

/// Which of two tracklets are seen at a fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Seen {
    One,
    Other,
    Both,
}

/// A fix during one of two tracklets.
#[derive(Debug, Clone, Copy)]
struct Merged {
    seen: Seen,
    /// The residual if the target of the first, or of the second, carries the receiver.
    carried: [Residual; 2],
}

/// The residuals of two tracklets in order of time. Where both are seen the difference of their positions is the mean over some
/// seconds: that of single boxes is noise, which would tell the carrier from a companion by chance.
fn merged(one: &[Residual], other: &[Residual]) -> Vec<Merged> {
    let (mut merged, mut others) = (Vec::with_capacity(one.len() + other.len()), other.iter().peekable());
    for own in one {
        while let Some(before) = others.next_if(|other| other.fix.time_s < own.fix.time_s) {
            merged.push(Merged { seen: Seen::Other, carried: [*before; 2] });
        }
        let both = others.next_if(|other| other.fix.time_s == own.fix.time_s);
        merged.push(match both {
            Some(other) => Merged { seen: Seen::Both, carried: [*own, *other] },
            None => Merged { seen: Seen::One, carried: [*own; 2] },
        });
    }
    merged.extend(others.map(|own| Merged { seen: Seen::Other, carried: [*own; 2] }));
    (0..merged.len()).map(|at| smoothed(&merged, at)).collect()
}

/// A fix with half of the mean difference on each side of the mean of both residuals.
fn smoothed(merged: &[Merged], at: usize) -> Merged {
    let own = merged[at];
    if own.seen != Seen::Both {
        return own;
    }
    let time_s = |at: &Merged| at.carried[0].fix.time_s;
    let first = merged.partition_point(|near| time_s(near) < time_s(&own) - SMOOTHED_S);
    let after = merged.partition_point(|near| time_s(near) <= time_s(&own) + SMOOTHED_S);
    let near: Vec<&Merged> = merged[first..after].iter().filter(|near| near.seen == Seen::Both).collect();
    let side = |sign: f64, base: Residual| {
        let difference_m = [0, 1].map(|axis| {
            let of = |fix: &Merged, at: usize| fix.carried[at].difference_m[axis];
            let apart_m = near.iter().map(|fix| of(fix, 0) - of(fix, 1)).sum::<f64>() / near.len() as f64;
            0.5 * (of(&own, 0) + of(&own, 1) + sign * apart_m)
        });
        Residual { difference_m, ..base }
    };
    Merged { carried: [side(1.0, own.carried[0]), side(-1.0, own.carried[1])], ..own }
}

/// Time of an interval that some others cover, s.
fn covered_s([from_s, to_s]: [f64; 2], mut others: Vec<[f64; 2]>) -> f64 {
    others.sort_by(|one, other| one[0].total_cmp(&other[0]));
    let (mut covered_s, mut until_s) = (0.0, from_s);
    for [first_s, last_s] in others {
        let last_s = last_s.min(to_s);
        covered_s += (last_s - first_s.max(until_s)).max(0.0);
        until_s = until_s.max(last_s);
    }
    covered_s
}

/// Companions of each tracklet.
fn companions(tracks: &[Tracklet], max_gap_s: f64) -> Vec<Vec<usize>> {
    let mut companions = vec![Vec::new(); tracks.len()];
    for (one, track) in tracks.iter().enumerate() {
        for other in (one + 1..tracks.len()).filter(|other| walk_together(track, &tracks[*other], max_gap_s))
        {
            companions[one].push(other);
            companions[other].push(one);
        }
    }
    companions
}

/// Time for which both are seen, s; negative if they are not.
fn together_s(one: &Tracklet, other: &Tracklet) -> f64 {
    let ([from_s, to_s], [other_from_s, other_to_s]) = (one.span_s(), other.span_s());
    to_s.min(other_to_s) - from_s.max(other_from_s)
}

fn walk_together(one: &Tracklet, other: &Tracklet, max_gap_s: f64) -> bool {
    let length_s = |own: &Tracklet| own.span_s()[1] - own.span_s()[0];
    let shorter_s = length_s(one).min(length_s(other));
    if together_s(one, other) < LEAST_TOGETHER_S.max(LEAST_TOGETHER_SHARE * shorter_s) {
        return false;
    }
    let distances = one
        .points
        .iter()
        .filter_map(|own| Some(own.position.distance_m(other.at(own.time_s, max_gap_s)?.position)));
    let (sum_m, count) = distances.fold((0.0, 0.0), |(sum, count), own| (sum + own, count + 1.0));
    count > 0.0 && sum_m <= APART_M * count
}
