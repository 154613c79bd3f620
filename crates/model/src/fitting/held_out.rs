//! Cross-validation of the candidates on held-out targets or blocks of time, and the choice between them.
//!
//! The errors of neighbouring rows are correlated, so whole targets or contiguous blocks are held out, never
//! random rows. A
//! more complex candidate is chosen only where its error is smaller by more than two standard errors. Neither
//! test rows nor true positions are read.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::progress::{FitError, FitRun, Phase};
use crate::recipes::{Candidate, FitContext};
use crate::regressor::Regressor;
use crate::samples::rows::{TrainingRows, traverses};
use crate::statistics::median;

/// A more complex candidate must be better by this many standard errors: with one, chance prefers one of six now and then.
const MARGIN: f64 = 2.0;
/// A squared residual counts at most this many times the median of the simplest candidate's.
const LARGEST_SQUARE_RATIO: f64 = 10.0;

/// Predictions of every row by a fit without the row's group.
pub(super) struct HeldOutResiduals {
    /// Regressed position less fix, east and north, m.
    pub(super) residuals: Vec<[f64; 2]>,
    /// Error variance per axis that the fit stated, m2.
    pub(super) predicted_m2: Vec<f64>,
}

/// Fits a candidate once per group of rows (given by its index per row, and the number of groups), without
/// that group, and predicts the group's rows.
pub(super) fn cross_validate(
    candidate: &Candidate,
    rows: &TrainingRows,
    (groups, count): (&[u32], u32),
    context: &FitContext<'_>,
    run: &mut FitRun<'_>,
) -> Result<HeldOutResiduals, FitError> {
    let mut residuals = vec![[0.0; 2]; rows.rows.len()];
    let mut predicted_m2 = vec![0.0; rows.rows.len()];
    for group in 0..count {
        let train = rows.filtered(|at| groups[at] != group);
        let mut rng = ChaCha8Rng::seed_from_u64(context.seed);
        rng.set_stream(u64::from(group) + 1);
        let name = format!("{}: held-out group {} of {count}", candidate.name, group + 1);
        let loss_weights = context.loss_weights;
        let mut phase = Phase { run, name, rng, is_final: false, loss_weights };
        let fitted = candidate.fit(&train, context, &mut phase)?;
        let regressor = Regressor::build(fitted.parts).map_err(FitError::fault)?;
        for (at, row) in rows.rows.iter().enumerate().filter(|(at, _)| groups[*at] == group) {
            let fix = regressor.plane().to_plane(row.position);
            // From the box alone: a network with the fix among its inputs would only reproduce it.
            let regression = regressor.regress(&row.bounding_box, None);
            let point = regression.regressed;
            residuals[at] = [point.east_m - fix.east_m, point.north_m - fix.north_m];
            predicted_m2[at] = regression.e_regression_m2;
        }
    }
    Ok(HeldOutResiduals { residuals, predicted_m2 })
}

/// Index of the candidate to use, and the score of each: the mean squared residual per axis, m2, with every
/// square bounded. A candidate replaces a simpler one if its score is smaller by more than two standard errors
/// of the difference, in which the rows of one traverse are taken as fully correlated.
pub(super) fn choose(rows: &TrainingRows, residuals: &[&[[f64; 2]]]) -> (usize, Vec<f64>) {
    let Some(simplest) = residuals.first() else { return (0, Vec::new()) };
    let square = |[east, north]: &[f64; 2]| 0.5 * (east * east + north * north);
    let bound_m2 = LARGEST_SQUARE_RATIO * median(simplest.iter().map(square).collect());
    let mut chosen = 0;
    for at in 1..residuals.len() {
        let gains: Vec<f64> = residuals[chosen]
            .iter()
            .zip(residuals[at])
            .map(|(one, other)| square(one).min(bound_m2) - square(other).min(bound_m2))
            .collect();
        let count = gains.len() as f64;
        let gain = gains.iter().sum::<f64>() / count;
        let mut variance = 0.0;
        let mut from = 0;
        for traverse in traverses(&rows.rows) {
            let sum: f64 = gains[from..from + traverse.len()].iter().map(|own| own - gain).sum();
            variance += (sum / count).powi(2);
            from += traverse.len();
        }
        if gain > MARGIN * variance.sqrt() {
            chosen = at;
        }
    }
    let score = |residuals: &&[[f64; 2]]| {
        residuals.iter().map(|residual| square(residual).min(bound_m2)).sum::<f64>() / residuals.len() as f64
    };
    (chosen, residuals.iter().map(score).collect())
}
