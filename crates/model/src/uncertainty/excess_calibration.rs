//! The calibration of the excess variance of atypical boxes on their held-out residuals.

use super::error_model::{EXCESS_PARAMETERS, ErrorModel, TruncationClass};
use super::jacobian::Encode;
use super::variance_components::robust_variance_m2;
use crate::artifact::ModelParts;
use crate::domain::Result;
use crate::samples::rows::TrainingRow;

/// A squared residual counts at most this many times its expected value.
const LARGEST_SQUARE_RATIO: f64 = 6.0;
/// Quantile of the computed excess variance up to which the calibration applies.
const LIMIT_QUANTILE: f64 = 0.95;
/// Prior variance of the factor about 1.
const PRIOR_VARIANCE: f64 = 4.0;
/// Range of the factor.
const FACTOR_RANGE: [f64; 2] = [0.01, 2.0];

/// Sets factor and limit of both truncation classes in the parts of a model whose error is otherwise
/// calibrated.
///
/// `residuals` are the held-out residuals of the rows, `effective_size` is their effective sample size.
///
/// # Errors
/// If the parts are not those of a model.
pub(super) fn calibrate_excess(
    parts: &mut ModelParts,
    rows: &[TrainingRow],
    residuals: &[[f64; 2]],
    effective_size: f64,
    encode: &Encode<'_>,
) -> Result<()> {
    let model = ErrorModel::build(&mut parts.clone(), false)?;
    let excesses: Vec<(TruncationClass, f64)> = rows
        .iter()
        .map(|row| {
            let excess_m2 = model.excess_of(&row.bounding_box, &encode(&row.bounding_box));
            (model.truncation_class(&row.bounding_box), excess_m2)
        })
        .collect();
    for (class, [limit_name, factor_name]) in EXCESS_PARAMETERS.into_iter().enumerate() {
        if let Some((factor, limit_m2)) = factor_of(class, rows, &excesses, residuals, effective_size) {
            parts.set(factor_name, factor);
            parts.set(limit_name, limit_m2);
        }
    }
    Ok(())
}

/// Factor and limit (m2) of the boxes of one truncation class; `None` if none of them is atypical.
///
/// The estimate is the excess of the mean square residual of atypical boxes over that of nominal boxes,
/// divided by the mean computed excess. It is combined with the prior 1 by inverse variances; its own
/// variance is that of a mean of as many independent squares as the boxes contain.
fn factor_of(
    class: TruncationClass,
    rows: &[TrainingRow],
    excesses: &[(TruncationClass, f64)],
    residuals: &[[f64; 2]],
    effective_size: f64,
) -> Option<(f64, f64)> {
    let (mut nominal, mut atypical) = (Mean::default(), Mean::default());
    let (mut computed_m2, mut traverses, mut last) = (Vec::new(), 0.0, None);
    let typical_m2 = robust_variance_m2(residuals);
    for ((row, [east, north]), (class_of_row, excess_m2)) in rows.iter().zip(residuals).zip(excesses) {
        let largest_m2 = LARGEST_SQUARE_RATIO * (typical_m2 + excess_m2);
        let square_m2 = (0.5 * (east * east + north * north)).min(largest_m2);
        if *excess_m2 <= 0.0 {
            nominal.add(square_m2);
        } else if *class_of_row == class {
            atypical.add(square_m2);
            computed_m2.push(*excess_m2);
            traverses += f64::from(u8::from(last.replace(row.traverse) != Some(row.traverse)));
        }
    }
    if computed_m2.is_empty() || nominal.count < 1.0 {
        return None;
    }
    computed_m2.sort_by(f64::total_cmp);
    let mean_computed_m2 = computed_m2.iter().sum::<f64>() / computed_m2.len() as f64;
    let estimate = (atypical.value() - nominal.value()) / mean_computed_m2;
    // The fixes of one traverse are correlated, but traverses are independent.
    let independent = (atypical.count * effective_size / rows.len() as f64).max(traverses);
    let variance = (nominal.value() / mean_computed_m2).powi(2) / independent;
    let factor = (estimate * PRIOR_VARIANCE + variance) / (PRIOR_VARIANCE + variance);
    let limit_m2 = computed_m2[((computed_m2.len() - 1) as f64 * LIMIT_QUANTILE) as usize];
    Some((factor.clamp(FACTOR_RANGE[0], FACTOR_RANGE[1]), limit_m2))
}

#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn value(self) -> f64 {
        self.sum / self.count
    }
}
