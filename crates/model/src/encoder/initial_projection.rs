//! A robust initial homography of the foot points: RANSAC over direct linear transforms.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::projection::Projection;
use crate::samples::rows::TrainingRow;
use crate::statistics::median;

/// Random subsets that are tried.
const TRIALS: usize = 300;
/// Most rows on which a trial is scored.
const SCORED_ROWS: usize = 400;
/// Rows of a small and of a large random subset, in turn.
const SUBSET_SIZES: [usize; 2] = [5, 20];
/// A trial replaces the fit of all rows only if its median residual is below this share of that fit's.
const ADVANTAGE: f64 = 0.95;
/// Seed of the subsets: the same in every fit, so that no model depends on the run's seed through them.
const SEED: u64 = 1;

/// Coefficients of the homography in [`Projection::coefficients`]: a, b and c of 1, foot x, foot y.
const HOMOGRAPHY: [usize; 8] = [0, 1, 2, 5, 6, 7, 10, 11];

/// The random generator of the subsets.
pub(crate) fn subset_rng() -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(SEED)
}

/// The direct linear transform of the random subset, or of all rows, with the least median residual.
pub(crate) fn initial_projection(rows: &[TrainingRow], rng: &mut ChaCha8Rng) -> Projection {
    let scaled = Projection::scaled_to(rows);
    let scored: Vec<usize> = (0..rows.len()).step_by(rows.len().div_ceil(SCORED_ROWS)).collect();
    let all: Vec<usize> = (0..rows.len()).collect();
    let mut best = direct_linear_transform(&scaled, rows, &all);
    let mut least =
        best.as_ref().map_or(f64::INFINITY, |map| ADVANTAGE * median_residual(map, rows, &scored));
    for trial in 0..TRIALS {
        let count = if trial % 2 == 0 { SUBSET_SIZES[0] } else { SUBSET_SIZES[1].min(rows.len()) };
        let subset: Vec<usize> = (0..count).map(|_| rng.random_range(0..rows.len())).collect();
        let Some(map) = direct_linear_transform(&scaled, rows, &subset) else { continue };
        let residual = median_residual(&map, rows, &scored);
        if residual < least {
            (least, best) = (residual, Some(map));
        }
    }
    best.unwrap_or(scaled)
}

/// The normalised direct linear transform (Hartley and Zisserman, 2nd ed., 4.4) of the foot points of
/// some rows; `None` where they do not determine it, or a row would lie above the horizon.
fn direct_linear_transform(
    scaled: &Projection,
    rows: &[TrainingRow],
    subset: &[usize],
) -> Option<Projection> {
    let mut normal = DMatrix::<f64>::identity(8, 8) * 1e-6;
    let mut right = DVector::<f64>::zeros(8);
    for at in subset {
        let terms = scaled.at(&rows[*at].bounding_box).terms;
        for (axis, target) in scaled.in_units(rows[*at].label).into_iter().enumerate() {
            let mut equation = [0.0; 8];
            equation[3 * axis..3 * axis + 3].copy_from_slice(&terms[..3]);
            (equation[6], equation[7]) = (-target * terms[1], -target * terms[2]);
            for row in 0..8 {
                right[row] += equation[row] * target;
                for column in 0..8 {
                    normal[(row, column)] += equation[row] * equation[column];
                }
            }
        }
    }
    let solution = normal.cholesky()?.solve(&right);
    let mut map = scaled.clone();
    for (coefficient, value) in HOMOGRAPHY.into_iter().zip(solution.iter()) {
        map.coefficients[coefficient] = *value;
    }
    let below_horizon = subset.iter().all(|at| map.is_below_horizon(&rows[*at].bounding_box));
    below_horizon.then_some(map)
}

/// Median distance of some rows' labels from their projections, in units of position.
fn median_residual(map: &Projection, rows: &[TrainingRow], subset: &[usize]) -> f64 {
    let distances = subset.iter().map(|at| {
        let [east, north] = map.at(&rows[*at].bounding_box).position;
        let target = map.in_units(rows[*at].label);
        (east - target[0]).hypot(north - target[1])
    });
    median(distances.collect())
}
