//! Leave-group-out validation: the weight of each candidate, and a check of the stated error.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::Exp1;

use super::candidate::MapCandidate;
use super::groups::Grouping;
use super::map_rows::MapRows;
use super::noise::{Epoch, ReceiverNoise};
use super::sessions::weighted_mean;

const BOOTSTRAP_DRAWS: usize = 500;
/// A squared miss counts at most this number of variances of the receiver.
const BOUND: f64 = 10.0;
/// 95 % point of chi-square with two degrees of freedom.
const CHI_SQUARE_95: f64 = 5.991;
/// Standard errors by which mean squares may exceed what is stated: chance.
const ACCEPTED_ERRORS: f64 = 0.7;
const MAX_WIDENING: f64 = 25.0;

/// A row by maps that had not seen its group, mixed by the candidates' weights.
struct LeftOutRow {
    row: usize,
    residual_m: [f64; 2],
    /// Mean variance per axis of the map, m2.
    map_m2: f64,
}

/// The calibration of the mixture on left-out rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LeftOutCalibration {
    /// Factor on the map's variance, at least 1.
    pub(crate) widening: f64,
    /// Mean squared miss per axis to the fixes, bounded, m2.
    pub(crate) miss_m2: f64,
    /// Share of the fixes inside the radius that map and receiver state together.
    pub(crate) coverage: f64,
}

/// Squared miss per axis, bounded, m2.
pub(crate) fn bounded_m2([east_m, north_m]: [f64; 2], receiver_m2: f64) -> f64 {
    (0.5 * (east_m * east_m + north_m * north_m)).min(BOUND * receiver_m2)
}

/// Left-out sequences of rows: those of one target within one group.
fn sequences(grouping: &Grouping, epochs: &[Epoch]) -> Vec<(usize, Vec<usize>)> {
    let members = grouping.members();
    let of_group = |(group, rows): (usize, &Vec<usize>)| {
        rows.chunk_by(|one, next| epochs[*one].sequence == epochs[*next].sequence)
            .map(|rows| (group, rows.to_vec()))
            .collect::<Vec<_>>()
    };
    members.iter().enumerate().flat_map(of_group).collect()
}

/// Share of the draws of a Bayesian bootstrap (Rubin 1981) over left-out sequences in which each
/// candidate has the smallest mean squared miss, and these means over all rows, m2.
pub(crate) fn weigh(
    candidates: &[MapCandidate],
    grouping: &Grouping,
    rows: &MapRows,
    noise: &ReceiverNoise,
    seed: u64,
) -> (Vec<f64>, Vec<f64>) {
    let receiver_m2 = noise.variance_m2();
    let sequences = sequences(grouping, &rows.epochs);
    let misses: Vec<Vec<f64>> = candidates
        .iter()
        .map(|candidate| {
            let sum = |(group, rows): &(usize, Vec<usize>)| {
                let square = |row: &usize| {
                    bounded_m2(candidate.residual(&candidate.without[*group], *row).0, receiver_m2)
                };
                rows.iter().map(square).sum::<f64>()
            };
            sequences.iter().map(sum).collect()
        })
        .collect();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut wins = vec![0.0; candidates.len()];
    for _ in 0..BOOTSTRAP_DRAWS {
        // Exponential weights, normalised, are a draw of the Dirichlet distribution.
        let weights: Vec<f64> = sequences.iter().map(|_| rng.sample(Exp1)).collect();
        let score =
            |own: &Vec<f64>| own.iter().zip(&weights).map(|(miss, weight)| miss * weight).sum::<f64>();
        let scores: Vec<f64> = misses.iter().map(score).collect();
        let best =
            (0..scores.len()).min_by(|one, other| scores[*one].total_cmp(&scores[*other])).unwrap_or(0);
        wins[best] += 1.0 / BOOTSTRAP_DRAWS as f64;
    }
    let count = rows.boxes.len() as f64;
    (wins, misses.iter().map(|own| own.iter().sum::<f64>() / count).collect())
}

/// Holds the stated error of the mixture against left-out rows. `extra_m2` is what the model states
/// beside the posterior at a row (the jackknife), mean per axis.
pub(crate) fn calibrate(
    candidates: &[MapCandidate],
    weights: &[f64],
    grouping: &Grouping,
    rows: &MapRows,
    noise: &ReceiverNoise,
    extra_m2: &dyn Fn(usize) -> f64,
) -> LeftOutCalibration {
    let receiver_m2 = noise.variance_m2();
    let (mut miss_m2, mut inside, mut count) = (0.0, 0.0, 0.0_f64);
    let mut means = Vec::new();
    for (group, members) in sequences(grouping, &rows.epochs) {
        let own: Vec<LeftOutRow> =
            members.iter().map(|row| mixed(candidates, weights, group, *row)).collect();
        let mut map_m2 = 0.0;
        for left_out in &own {
            let stated_m2 = left_out.map_m2 + extra_m2(left_out.row);
            let square_m2 = 0.5 * (left_out.residual_m[0].powi(2) + left_out.residual_m[1].powi(2));
            miss_m2 += bounded_m2(left_out.residual_m, receiver_m2);
            inside += f64::from(u8::from(2.0 * square_m2 <= CHI_SQUARE_95 * (stated_m2 + receiver_m2)));
            map_m2 += stated_m2 / own.len() as f64;
            count += 1.0;
        }
        let epochs: Vec<Epoch> = members.iter().map(|row| rows.epochs[*row]).collect();
        let residuals_m: Vec<[f64; 2]> = own.iter().map(|left_out| left_out.residual_m).collect();
        let (mean_m, noise_m2) = weighted_mean(&epochs, noise, &residuals_m);
        let square_m2 = 0.5 * (mean_m[0].powi(2) + mean_m[1].powi(2));
        means.push(SequenceMean { square_m2, noise_m2, map_m2 });
    }
    let count = count.max(1.0);
    LeftOutCalibration { widening: widening(&means), miss_m2: miss_m2 / count, coverage: inside / count }
}

fn mixed(candidates: &[MapCandidate], weights: &[f64], group: usize, row: usize) -> LeftOutRow {
    let of: Vec<([f64; 2], [f64; 3])> =
        candidates.iter().map(|candidate| candidate.residual(&candidate.without[group], row)).collect();
    let residual_m =
        [0, 1].map(|axis| of.iter().zip(weights).map(|((own, _), weight)| weight * own[axis]).sum::<f64>());
    let variance = |(own, covariance): &([f64; 2], [f64; 3])| {
        let apart_m2 = (own[0] - residual_m[0]).powi(2) + (own[1] - residual_m[1]).powi(2);
        0.5 * (covariance[0] + covariance[2] + apart_m2)
    };
    let map_m2 = of.iter().zip(weights).map(|(own, weight)| weight * variance(own)).sum();
    LeftOutRow { row, residual_m, map_m2 }
}

/// The mean residual of one left-out sequence.
pub(crate) struct SequenceMean {
    /// Its square per axis, m2.
    pub(crate) square_m2: f64,
    /// Its variance by the receiver's noise, m2.
    pub(crate) noise_m2: f64,
    /// Its variance by the map, taken for fully correlated along the sequence, m2.
    pub(crate) map_m2: f64,
}

/// The factor, at least 1, at which the sequences' mean squares agree with what is stated.
pub(crate) fn widening(means: &[SequenceMean]) -> f64 {
    let ratio = |factor: f64| {
        let own = |mean: &SequenceMean| mean.square_m2 / (mean.noise_m2 + factor * mean.map_m2);
        means.iter().map(own).sum::<f64>() / means.len() as f64
    };
    let accepted = 1.0 + ACCEPTED_ERRORS / (means.len() as f64).sqrt();
    if means.len() < 2 || ratio(1.0) <= accepted {
        return 1.0;
    }
    let (mut low, mut high) = (1.0, MAX_WIDENING);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if ratio(middle) > accepted { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}
