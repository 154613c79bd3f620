//! Check of the error that a recipe states, on the targets that its fits had not seen.

use crate::artifact::ModelParts;
use crate::domain::GaussMarkovNoise;
use crate::progress::FitError;
use crate::recipes::gaussian_process::{Epoch, ReceiverNoise, SequenceMean, weighted_mean, widening};
use crate::regressor::Regressor;
use crate::samples::rows::{TrainingRow, TrainingRows};

/// Widens the stated radius of a calibrated model by its [`held_out_widening`].
///
/// # Errors
/// [`FitError::Fault`] if the model cannot be used.
pub(super) fn widen_radius(
    parts: &mut ModelParts,
    rows: &TrainingRows,
    groups: &[u32],
    residuals_m: &[[f64; 2]],
    noise: &GaussMarkovNoise,
) -> Result<(), FitError> {
    let factor = held_out_widening(parts, rows, groups, residuals_m, noise)?;
    let r95_scale = parts.positive_parameter("r95_scale").map_err(FitError::fault)?;
    parts.set("r95_scale", factor.sqrt() * r95_scale);
    parts.set("held_out_widening", factor);
    Ok(())
}

/// The factor of the stated variance, at least 1, at which the mean residuals of the left-out sequences (the rows of one
/// target within one group) are as large as receiver and map state together, beyond chance.
///
/// # Errors
/// [`FitError::Fault`] if the model cannot be used.
pub(super) fn held_out_widening(
    parts: &ModelParts,
    rows: &TrainingRows,
    groups: &[u32],
    residuals_m: &[[f64; 2]],
    noise: &GaussMarkovNoise,
) -> Result<f64, FitError> {
    let regressor = Regressor::build(parts.clone()).map_err(FitError::fault)?;
    let receiver = ReceiverNoise::of_gauss_markov(noise);
    let mut means = Vec::new();
    for group in 0..=groups.iter().copied().max().unwrap_or(0) {
        let members: Vec<usize> = (0..groups.len()).filter(|row| groups[*row] == group).collect();
        for own in members.chunk_by(|one, next| rows.rows[*one].target == rows.rows[*next].target) {
            let of = |row: &usize| -> &TrainingRow { &rows.rows[*row] };
            let epochs: Vec<Epoch> =
                own.iter().map(|row| Epoch { time_s: of(row).time_s, sequence: of(row).target }).collect();
            let residuals_m: Vec<[f64; 2]> = own.iter().map(|row| residuals_m[*row]).collect();
            let (mean_m, noise_m2) = weighted_mean(&epochs, &receiver, &residuals_m);
            let stated_m2 = |row: &usize| regressor.regress(&of(row).bounding_box, None).variance_m2();
            let map_m2 = own.iter().map(stated_m2).sum::<f64>() / own.len() as f64;
            means.push(SequenceMean {
                square_m2: 0.5 * (mean_m[0].powi(2) + mean_m[1].powi(2)),
                noise_m2,
                map_m2,
            });
        }
    }
    Ok(widening(&means))
}
