//! The figures and log lines of a fit.

use super::held_out::HeldOutResiduals;
use crate::artifact::ModelParts;
use crate::domain::{GaussMarkovNoise, HeldOutError, NoiseCorrelation};
use crate::progress::{FitError, FitRun};
use crate::recipes::{Candidate, FitContext};
use crate::regressor::Regressor;
use crate::samples::rows::TrainingRows;
use crate::samples::whitening::effective_sample_size;
use crate::statistics::R95_PER_SIGMA;

/// Logs the samples and the noise of their fixes.
pub(super) fn note_samples(
    rows: &TrainingRows,
    context: &FitContext<'_>,
    run: &mut FitRun<'_>,
) -> Result<(), FitError> {
    let GaussMarkovNoise { variance_m2, correlation } = context.noise;
    let NoiseCorrelation { white_share, time_constant_s } = correlation;
    run.note(&format!(
        "{} samples of {} targets in {} passes; the receiver's sigma is {:.2} m per axis",
        rows.rows.len(),
        rows.targets,
        rows.traverses,
        context.e_gnss_m2.sqrt()
    ))?;
    let over_time = if white_share < 1.0 {
        let coloured = 100.0 * (1.0 - white_share);
        format!("{coloured:.0} % of the variance has a correlation time of about {time_constant_s:.0} s")
    } else {
        "independent from fix to fix".to_owned()
    };
    run.note(&format!(
        "about the geometric map the fixes scatter by {:.2} m per axis, {over_time}; the effective sample \
         size is {:.0}",
        variance_m2.sqrt(),
        effective_sample_size(&rows.rows, &correlation)
    ))
}

/// Logs which candidate was chosen and by how much.
pub(super) fn note_choice(
    candidates: &[&Candidate],
    chosen: usize,
    scores: &[f64],
    run: &mut FitRun<'_>,
) -> Result<(), FitError> {
    if candidates.len() == 1 {
        return Ok(());
    }
    let gain = |other: usize| 100.0 * (1.0 - scores[chosen] / scores[other]);
    let last = candidates.len() - 1;
    run.note(&format!(
        "chose {}: its mean squared held-out residual, with outliers bounded, is {:.1} % below that of {} and \
         {:.1} % below that of {}",
        candidates[chosen].name,
        gain(0),
        candidates[0].name,
        gain(last),
        candidates[last].name
    ))
}

/// Logs the error variances of a model.
pub(super) fn note_errors(
    held_out: &HeldOutError,
    parts: &ModelParts,
    run: &mut FitRun<'_>,
) -> Result<(), FitError> {
    run.note(&format!(
        "the regressed position's own error is {:.2} m per axis, the receiver's {:.2} m",
        held_out.e_regression_m2.sqrt(),
        parts.e_gnss_m2.sqrt()
    ))
}

/// The error of a candidate on its held-out rows.
pub(super) fn held_out_error(
    HeldOutResiduals { residuals, predicted_m2 }: &HeldOutResiduals,
    groups: u32,
    e_gnss_m2: f64,
) -> HeldOutError {
    let count = residuals.len() as f64;
    let (mut distance_m, mut square_m2, mut inside) = (0.0, 0.0, 0.0);
    for ([east, north], predicted_m2) in residuals.iter().zip(predicted_m2) {
        let residual_m = east.hypot(*north);
        distance_m += residual_m;
        square_m2 += 0.5 * residual_m * residual_m;
        inside += f64::from(u8::from(residual_m <= R95_PER_SIGMA * (predicted_m2 + e_gnss_m2).sqrt()));
    }
    let error_to_fix_m2 = square_m2 / count;
    HeldOutError {
        blocks: groups,
        samples: residuals.len() as u32,
        mean_to_fix_m: distance_m / count,
        error_to_fix_m2,
        e_regression_m2: (error_to_fix_m2 - e_gnss_m2).max(0.01 * error_to_fix_m2),
        coverage95_of_fixes: inside / count,
    }
}

/// Mean error variance per axis that a model states at the training boxes, m2.
pub(super) fn mean_variance_m2(parts: &ModelParts, rows: &TrainingRows) -> Result<f64, FitError> {
    let regressor = Regressor::build(parts.clone()).map_err(FitError::fault)?;
    let variances = rows.rows.iter().map(|row| regressor.regress(&row.bounding_box, None).e_regression_m2);
    Ok(variances.sum::<f64>() / rows.rows.len() as f64)
}

/// Share of held-out fixes within the 95 % radius of the calibrated error and the receiver's together.
pub(super) fn coverage_of_fixes(
    parts: &ModelParts,
    rows: &TrainingRows,
    residuals: &[[f64; 2]],
) -> Result<f64, FitError> {
    let regressor = Regressor::build(parts.clone()).map_err(FitError::fault)?;
    let inside = rows.rows.iter().zip(residuals).filter(|(row, [east, north])| {
        let regression = regressor.regress(&row.bounding_box, None);
        let regression_m = regression.r95_scale * regression.e_regression_m2.sqrt();
        east.hypot(*north) <= regression_m.hypot(R95_PER_SIGMA * regressor.e_gnss_m2().sqrt())
    });
    Ok(inside.count() as f64 / residuals.len() as f64)
}
