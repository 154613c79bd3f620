//! Sets of tracklets that do not overlap in time: what one receiver may own.
//!
//! With a weight for each tracklet, its odds of being the carrier's, the evidence of a receiver is the sum over all such
//! sets of the products of their weights, the empty set included. Ordered by their last instants, with `b(j)` tracklets
//! that end before `j` begins, the sums over the first tracklets are `Z(j + 1) = Z(j) + w(j) Z(b(j))` and `Z(0) = 1`, as in
//! weighted interval scheduling (Kleinberg and Tardos 2006, 6.1); the same recursion backwards gives the
//! probability of each tracklet. All sums are logarithms.

use super::tracklet::MAX_OVERLAP_S;

/// A term that is smaller than another one by this logarithm adds nothing to it.
const NEGLIGIBLE: f64 = -30.0;

/// For spans in the order of their last instants, the number of those that end before each begins.
pub(super) fn ended_before(spans_s: &[[f64; 2]]) -> Vec<usize> {
    // A span shorter than the tolerated overlap does not come before itself.
    let ended = |(at, [from_s, _]): (usize, &[f64; 2])| {
        spans_s[..at].partition_point(|[_, to_s]| *to_s <= from_s + MAX_OVERLAP_S)
    };
    spans_s.iter().enumerate().map(ended).collect()
}

/// Logarithms of the sums over the sets among the first tracklets: of none, of the first, of the first two and so on.
pub(super) fn log_sums(weights: impl Iterator<Item = (f64, usize)>) -> Vec<f64> {
    let mut sums = vec![0.0];
    for (log_weight, before) in weights {
        let without = sums[sums.len() - 1];
        sums.push(log_sum(without, log_weight + sums[before]));
    }
    sums
}

/// Probability of each tracklet, from log weights and the numbers of those that end before.
pub(super) fn probabilities(weights: &[(f64, usize)]) -> Vec<f64> {
    let sums = log_sums(weights.iter().copied());
    let all = sums[weights.len()];
    let mut after = vec![f64::NEG_INFINITY; weights.len() + 1];
    after[weights.len()] = 0.0;
    let mut probabilities = vec![0.0; weights.len()];
    for (at, (log_weight, before)) in weights.iter().enumerate().rev() {
        let with = log_weight + after[at + 1];
        probabilities[at] = (with + sums[*before] - all).exp();
        after[at] = log_sum(after[at], after[at + 1]);
        after[*before] = log_sum(after[*before], with);
    }
    probabilities
}

/// `ln(exp(one) + exp(other))`.
fn log_sum(one: f64, other: f64) -> f64 {
    let (less, more) = if one < other { (one, other) } else { (other, one) };
    if less < more + NEGLIGIBLE { more } else { more + (less - more).exp().ln_1p() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_and_probabilities_are_those_of_all_sets_written_out() {
        let spans_s = [[0.0, 10.0], [2.0, 12.0], [10.2, 20.0], [12.0, 24.0], [30.0, 30.2]];
        let log_weights: [f64; 5] = [0.7, -0.4, 1.3, 0.2, -1.0];
        let is_disjoint = |one: usize, other: usize| {
            spans_s[one][1] <= spans_s[other][0] + MAX_OVERLAP_S
                || spans_s[other][1] <= spans_s[one][0] + MAX_OVERLAP_S
        };
        let (mut all, mut with) = (0.0, [0.0; 5]);
        for set in 0..1_u32 << 5 {
            let own: Vec<usize> = (0..5).filter(|at| set >> at & 1 == 1).collect();
            let pairs = own.iter().flat_map(|one| own.iter().map(move |other| (*one, *other)));
            if pairs.filter(|(one, other)| one < other).all(|(one, other)| is_disjoint(one, other)) {
                let weight: f64 = own.iter().map(|at| log_weights[*at].exp()).product();
                all += weight;
                own.iter().for_each(|at| with[*at] += weight);
            }
        }
        let weights: Vec<(f64, usize)> = log_weights.into_iter().zip(ended_before(&spans_s)).collect();
        assert!((log_sums(weights.iter().copied())[5] - f64::ln(all)).abs() < 1e-9);
        for (found, with) in probabilities(&weights).into_iter().zip(with) {
            assert!((found - with / all).abs() < 1e-9, "{found} {}", with / all);
        }
    }
}
