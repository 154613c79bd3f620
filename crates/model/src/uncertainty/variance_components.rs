//! Components of the regression's error variance, from residuals (regressed position less fix).
//!
//! The obvious estimate, the mean square of held-out residuals less the receiver's variance (METHOD 2.4),
//! is the difference of two large numbers and mostly noise. Errors that are common to several traverses,
//! blocks of time or sessions can be separated from the receiver's, which are independent between them
//! (analysis of variance with random effects).

use super::coverage::Coverage;
use crate::domain::GaussMarkovNoise;
use crate::samples::rows::{HELD_OUT_BLOCKS, TrainingRow, traverses};
use crate::samples::whitening::effective_sample_size;
use crate::statistics::median;

/// East and north, m.
type Residual = [f64; 2];

/// Patches of the image, within which the error of a map is taken as constant.
const PATCHES: usize = 64;
/// Fewest traverses through a patch, and fewest such patches.
const FEWEST_TRAVERSES: usize = 3;
const FEWEST_PATCHES: usize = 6;
/// Least share of the rows in such patches.
const LEAST_COVERED_SHARE: f64 = 0.5;
/// Residuals beyond this many standard deviations are outliers.
const OUTLIER_SIGMAS: f64 = 3.0;
/// The variance between traverses is increased by this many standard errors.
const CONFIDENCE_MARGIN: f64 = 0.5;
/// A gap longer than this ends a session, s.
const SESSION_GAP_S: f64 = 1_800.0;
/// Least effective sample size of a session.
const LEAST_SESSION_SIZE: f64 = 4.0;

/// Variance per axis of residuals, m2, from the median of their squared lengths, which are exponentially
/// distributed with the median `2 ln 2` times the variance.
pub(crate) fn robust_variance_m2(residuals: &[Residual]) -> f64 {
    let squares = residuals.iter().map(|[east, north]| 0.5 * (east * east + north * north));
    median(squares.collect()) / std::f64::consts::LN_2
}

/// Squared length beyond which a residual is an outlier, m2.
fn outlier_square_m2(residuals: &[Residual]) -> f64 {
    2.0 * OUTLIER_SIGMAS * OUTLIER_SIGMAS * robust_variance_m2(residuals)
}

/// Variance per axis of errors that are constant within a block of time, m2.
///
/// With `K` blocks, such an error of variance `B` adds `B` to the held-out residuals of its block, and
/// `B / (K - 1)` through the map that the other blocks determine. The parameters' covariance, of variance
/// `P` for a map of all blocks, adds `P K / (K - 1)` for the map of the others and `P` because the residuals
/// about the own map are too small by that. Hence
/// `B = (held_out - own - P (K / (K - 1) + 1)) (K - 1) / K`, at least 0.
pub(super) fn between_block_m2(held_out: &[Residual], own: &[Residual], parameter_m2: f64) -> f64 {
    let others = f64::from(HELD_OUT_BLOCKS - 1);
    let of_parameters_m2 = parameter_m2 * (f64::from(HELD_OUT_BLOCKS) / others + 1.0);
    let excess_m2 = robust_variance_m2(held_out) - robust_variance_m2(own) - of_parameters_m2;
    excess_m2.max(0.0) * others / (others + 1.0)
}

/// Error variance per axis of a map due to errors that are constant within a session, m2; a gap of half an
/// hour ends a session.
///
/// The mean residuals of `S` sessions about one map have the variance `B + N`, where `B` is the variance of
/// the sessions' common errors and `N` is what the noise of the fixes leaves in a mean (its variance divided
/// by the effective sample size, averaged over the sessions). The map has the mean of the common errors, whose
/// variance is `B / S`. 0 for a single session, from which `B` cannot be determined.
pub(super) fn between_session_m2(rows: &[TrainingRow], own: &[Residual], noise: &GaussMarkovNoise) -> f64 {
    let outlier_m2 = outlier_square_m2(own);
    let mut order: Vec<usize> = (0..rows.len())
        .filter(|index| own[*index][0].powi(2) + own[*index][1].powi(2) <= outlier_m2)
        .collect();
    order.sort_by(|one, other| rows[*one].time_s.total_cmp(&rows[*other].time_s));
    let (mut means, mut noise_sum_m2) = (Vec::new(), 0.0);
    for session in order.chunk_by(|one, next| rows[*next].time_s - rows[*one].time_s <= SESSION_GAP_S) {
        let mut session = session.to_vec();
        // The rows of a traverse are adjacent again.
        session.sort_unstable();
        let session_rows: Vec<TrainingRow> = session.iter().map(|index| rows[*index]).collect();
        let size = effective_sample_size(&session_rows, &noise.correlation);
        if size < LEAST_SESSION_SIZE {
            continue;
        }
        let count = session.len() as f64;
        means.push([0, 1].map(|axis| session.iter().map(|index| own[*index][axis]).sum::<f64>() / count));
        noise_sum_m2 += noise.variance_m2 / size;
    }
    let count = means.len() as f64;
    if means.len() < 2 {
        return 0.0;
    }
    let centre = [0, 1].map(|axis| means.iter().map(|mean| mean[axis]).sum::<f64>() / count);
    let squares = means.iter().map(|mean| (mean[0] - centre[0]).powi(2) + (mean[1] - centre[1]).powi(2));
    let between_m2 = squares.sum::<f64>() / (2.0 * (count - 1.0));
    (between_m2 - noise_sum_m2 / count).max(0.0) / count
}

/// Mean residual of a traverse within a patch, with the number of its rows.
type TraverseMean = (f64, Residual);

/// Variance per axis of the error that traverses have in common, m2: within one patch of the image the
/// receiver's errors of different traverses are independent, so the square of the mean over traverses, less
/// the variance of that mean, is an unbiased estimate of the squared error of the map. The mean over patches,
/// weighted by their rows, is increased by half of its standard error. `None` if too few patches have three
/// traverses.
pub(super) fn between_traverse_m2(
    rows: &[TrainingRow],
    coverage: &Coverage,
    residuals: &[Residual],
) -> Option<f64> {
    let (mut sum, mut squares, mut weights, mut squared_weights) = (0.0, 0.0, 0.0, 0.0);
    let mut used = 0;
    for patch in traverse_means(rows, coverage, residuals).iter().filter(|it| it.len() >= FEWEST_TRAVERSES) {
        let weight: f64 = patch.iter().map(|(rows, _)| rows).sum();
        let square_m2 = squared_common_error_m2(patch);
        used += 1;
        sum += weight * square_m2;
        squares += weight * weight * square_m2 * square_m2;
        weights += weight;
        squared_weights += weight * weight;
    }
    if used < FEWEST_PATCHES || weights < LEAST_COVERED_SHARE * rows.len() as f64 {
        return None;
    }
    let mean = sum / weights;
    let standard_error =
        (squares / (weights * weights) - mean * mean * squared_weights / (weights * weights)).max(0.0).sqrt();
    Some(mean + CONFIDENCE_MARGIN * standard_error)
}

/// Per patch: the mean residual of each traverse through it, without outliers.
fn traverse_means(
    rows: &[TrainingRow],
    coverage: &Coverage,
    residuals: &[Residual],
) -> Vec<Vec<TraverseMean>> {
    let patches = coverage.truncated_to(PATCHES);
    let outlier_m2 = outlier_square_m2(residuals);
    let nominal = |[east, north]: &Residual| east * east + north * north <= outlier_m2;
    let mut means: Vec<Vec<TraverseMean>> = vec![Vec::new(); PATCHES];
    let mut at = 0;
    for traverse in traverses(rows) {
        let mut sums = vec![(0.0, [0.0; 2]); PATCHES];
        for (row, residual) in traverse.iter().zip(&residuals[at..]).filter(|(_, residual)| nominal(residual))
        {
            let (count, sum) = &mut sums[patches.nearest(&row.bounding_box)];
            *count += 1.0;
            (sum[0], sum[1]) = (sum[0] + residual[0], sum[1] + residual[1]);
        }
        at += traverse.len();
        for (patch, (count, sum)) in means.iter_mut().zip(sums).filter(|(_, sum)| sum.0 > 0.0) {
            patch.push((count, sum.map(|sum| sum / count)));
        }
    }
    means
}

/// Unbiased estimate of the squared common error per axis of one patch, m2; it may be negative.
fn squared_common_error_m2(patch: &[TraverseMean]) -> f64 {
    let count = patch.len() as f64;
    let mut square_m2 = 0.0;
    for axis in 0..2 {
        // Winsorised at three robust standard deviations, which limits the influence of one bad traverse.
        let centre = median(patch.iter().map(|(_, mean)| mean[axis]).collect());
        let sigma = 1.48 * median(patch.iter().map(|(_, mean)| (mean[axis] - centre).abs()).collect());
        let bound = 3.0 * sigma + 1e-9;
        let bounded = |mean: &Residual| mean[axis].clamp(centre - bound, centre + bound);
        let mean = patch.iter().map(|(_, mean)| bounded(mean)).sum::<f64>() / count;
        let scatter = patch.iter().map(|(_, at)| (bounded(at) - mean).powi(2)).sum::<f64>();
        square_m2 += 0.5 * (mean * mean - scatter / (count * (count - 1.0)));
    }
    square_m2
}
