//! The error variance of a box and whether it is outside of training: `uncertainty/error_model.rs`.

use super::boxes::{Boxes, reconstruction_error};
use super::expression::{Condition, Expr};
use crate::uncertainty::coverage::{CoverageTable, SOFTENING};
use crate::uncertainty::error_model::{ErrorModel, NOMINAL_RATIO};
use crate::uncertainty::local_boxes::{ISOTROPIC_SHARE, LocalBoxModel, Region};

/// Numbers of a region in a table: mean 4, precision 16, noise gain 8, isotropic variance 1, limit 1.
const REGION_NUMBERS: usize = 30;
/// Limit of a centre without a region, which no distance exceeds.
const NO_LIMIT: f32 = 1e30;

/// The position of boxes relative to the training boxes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CoverageLookup<'g> {
    /// Squared distances from all centres, in squared units.
    squared_distances: Expr<'g>,
    pub(crate) extrapolation_ratio: Expr<'g>,
    nominal_m2: Expr<'g>,
}

pub(crate) fn look_up<'g>(table: &CoverageTable, boxes: Boxes<'g>) -> CoverageLookup<'g> {
    let graph = boxes.sides.graph();
    let centres: Vec<([f32; 4], f32)> = table.centres().collect();
    let [foot_x, foot_y, width, height] = boxes.features();
    let coordinates = [foot_x, foot_y, width.ln(), height.ln()];
    let square = |axis: usize| {
        let own: Vec<f64> = centres.iter().map(|(centre, _)| f64::from(centre[axis])).collect();
        (coordinates[axis] / f64::from(table.units[axis]) - graph.row(&own)).square()
    };
    let squared_distances = (1..4).fold(square(0), |sum, axis| sum + square(axis));
    let radius = f64::from(table.radius);
    let closeness = 1.0 / (squared_distances + f64::from(SOFTENING) * radius * radius);
    let weights = closeness.square();
    let errors_m2: Vec<f64> = centres.iter().map(|(_, error_m2)| f64::from(*error_m2)).collect();
    let weight = weights.sum();
    let interpolated_m2 = weights.matrix_product(errors_m2.len(), 1, &errors_m2) / weight;
    CoverageLookup {
        squared_distances,
        extrapolation_ratio: squared_distances.least().sqrt() / radius,
        // As in single precision, whose weights underflow far from all centres.
        nominal_m2: weight.exceeds(1e-30).choose(interpolated_m2, f64::from(table.largest_m2)),
    }
}

/// Where boxes are unlike those of training.
pub(crate) fn is_outside_training<'g>(
    model: &ErrorModel,
    lookup: &CoverageLookup<'g>,
    reconstruction_error: Expr<'g>,
) -> [Condition<'g>; 2] {
    let limit = model.nominal_reconstruction_error;
    // Without a limit no reconstruction error exceeds it.
    let limit = if limit > 0.0 { limit } else { f64::MAX };
    [lookup.extrapolation_ratio.exceeds(NOMINAL_RATIO), reconstruction_error.exceeds(limit)]
}

/// Reconstruction error and error variance per axis, m2.
pub(crate) fn error_of<'g>(
    model: &ErrorModel,
    boxes: Boxes<'g>,
    lookup: &CoverageLookup<'g>,
    reconstruction_px: Expr<'g>,
) -> (Expr<'g>, Expr<'g>) {
    let reconstruction_error = reconstruction_error(boxes.features(), reconstruction_px);
    let extrapolation = (lookup.extrapolation_ratio - NOMINAL_RATIO).positive();
    let displacement = extrapolation * model.coverage.radius_px() / boxes.height;
    let excess = (reconstruction_error - model.nominal_reconstruction_error).positive();
    let excess_m2 = inconsistent_variance_m2(&model.local_boxes, boxes, lookup)
        + (excess + displacement.square()) * model.error_scale;
    let is_truncated = boxes.beyond_border_px(model.image_size).exceeds(0.0);
    let [inside, truncated] = model.excess;
    let calibrated_m2 = excess_m2.min(is_truncated.choose(truncated.limit_m2, inside.limit_m2));
    let variance_m2 =
        lookup.nominal_m2 * is_truncated.choose(model.border_factor, 1.0) * (extrapolation.square() + 1.0)
            + calibrated_m2 * is_truncated.choose(truncated.factor, inside.factor)
            + (excess_m2 - calibrated_m2);
    (reconstruction_error, variance_m2)
}

/// The additional error variance per axis of boxes whose edges are not consistent, m2.
fn inconsistent_variance_m2<'g>(
    model: &LocalBoxModel,
    boxes: Boxes<'g>,
    lookup: &CoverageLookup<'g>,
) -> Expr<'g> {
    let graph = boxes.sides.graph();
    if model.regions.is_empty() {
        return graph.row(&[0.0]);
    }
    let numbers = |region: &u8| match model.regions.get(usize::from(*region)) {
        Some(region) => numbers_of(region),
        None => numbers_of(&Region { nominal_limit: NO_LIMIT, ..Region::default() }),
    };
    let table: Vec<f64> = model.of_centre.iter().flat_map(numbers).collect();
    let own: [Expr<'g>; REGION_NUMBERS] =
        lookup.squared_distances.row_of_least(REGION_NUMBERS, &table).split();
    let edges = boxes.edges();
    let deviation: [Expr<'g>; 4] = std::array::from_fn(|edge| edges[edge] - own[edge]);
    let dot = |row: usize| {
        (1..4).fold(own[row] * deviation[0], |sum, edge| sum + own[row + edge] * deviation[edge])
    };
    let distance = (1..4).fold(dot(4) * deviation[0], |sum, edge| sum + dot(4 + 4 * edge) * deviation[edge]);
    let displacement_m2 = (dot(20).square() + dot(24).square()) * 0.5;
    let (isotropic_m2, limit) = (own[28], own[29]);
    // 0 up to the limit.
    let share = (1.0 - limit / distance.max(limit)).positive();
    share * (displacement_m2 + isotropic_m2 * distance * ISOTROPIC_SHARE)
}

fn numbers_of(region: &Region) -> [f64; REGION_NUMBERS] {
    let mut numbers =
        region.mean.iter().chain(region.precision.as_flattened()).chain(region.noise_gain.as_flattened());
    std::array::from_fn(|at| match at {
        28 => f64::from(region.isotropic_m2),
        29 => f64::from(region.nominal_limit),
        _ => numbers.next().map_or(0.0, |number| f64::from(*number)),
    })
}
