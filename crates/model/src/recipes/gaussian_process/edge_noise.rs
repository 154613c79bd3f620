//! The detector's noise: covariance of a box's four edges from second differences.

use nalgebra::{Matrix4, Vector4};

use super::noise::Epoch;
use super::projective_mean::Box4;
use crate::statistics::median;

/// Standard deviation of an edge where rows are too far apart in time to tell, px.
const UNKNOWN_EDGE_PX: f64 = 1.5;
/// Rows further apart do not follow each other, s.
const MAX_STEP_S: f64 = 2.5;
const MIN_DIFFERENCES: usize = 20;
/// Squared Mahalanobis length (4 degrees of freedom, 95 %) beyond which a difference is motion or a
/// wrong box, and the factor that makes up for what the cut removes from a normal distribution.
const CREDIBLE: f64 = 9.49;
const TRUNCATION: f64 = 1.0 / 0.86;
const ROUNDS: usize = 6;
/// Rounding to whole pixels, px2.
const MIN_EDGE_PX2: f64 = 0.08;

/// Left, top, right, bottom.
pub(crate) fn edges_px(sides: &Box4) -> Vector4<f64> {
    let [u, v, width, height] = *sides;
    Vector4::new(u - 0.5 * width, v - height, u + 0.5 * width, v)
}

/// Derivatives by left, top, right and bottom from those by foot u, foot v, width and height.
#[inline]
pub(crate) fn by_edge([u, v, width, height]: [f64; 4]) -> [f64; 4] {
    [0.5 * u - width, -height, 0.5 * u + width, v + height]
}

/// J E J^T: covariance (east, cross, north) of a position by that of the edges, m2.
#[inline]
pub(crate) fn position_noise_m2(by_edge: &[[f64; 4]; 2], edge_px2: &[f64; 16]) -> [f64; 3] {
    let product = |one: usize, other: usize| {
        let mut sum = 0.0;
        for row in 0..4 {
            for column in 0..4 {
                sum += by_edge[one][row] * edge_px2[row * 4 + column] * by_edge[other][column];
            }
        }
        sum
    };
    [product(0, 0), product(0, 1), product(1, 1)]
}

/// Covariance of left, top, right and bottom, px2.
pub(crate) fn edge_covariance_px2(epochs: &[Epoch], boxes: &[Box4]) -> [f64; 16] {
    let covariance = robust_covariance_px2(epochs, boxes);
    std::array::from_fn(|at| covariance.as_slice()[at])
}

fn robust_covariance_px2(epochs: &[Epoch], boxes: &[Box4]) -> Matrix4<f64> {
    let differences: Vec<Vector4<f64>> = (1..epochs.len().saturating_sub(1))
        .filter(|at| {
            let (first_s, second_s) =
                (epochs[*at].time_s - epochs[at - 1].time_s, epochs[at + 1].time_s - epochs[*at].time_s);
            let same = epochs[at - 1].sequence == epochs[at + 1].sequence;
            same && first_s > 0.0 && first_s < MAX_STEP_S && (first_s - second_s).abs() < 0.1 * first_s
        })
        .map(|at| {
            let [before, own, after] = [at - 1, at, at + 1].map(|row| edges_px(&boxes[row]));
            // White noise of unit variance has second differences of variance 6.
            (before - 2.0 * own + after) / 6.0_f64.sqrt()
        })
        .collect();
    if differences.len() < MIN_DIFFERENCES {
        return Matrix4::identity() * (UNKNOWN_EDGE_PX * UNKNOWN_EDGE_PX);
    }
    let mut covariance = Matrix4::from_diagonal(&Vector4::from_fn(|edge, _| {
        let sigma = 1.4826 * median(differences.iter().map(|difference| difference[edge].abs()).collect());
        (sigma * sigma).max(MIN_EDGE_PX2)
    }));
    for _ in 0..ROUNDS {
        let Some(factor) = covariance.cholesky() else { break };
        let (mut sum, mut count) = (Matrix4::zeros(), 0.0);
        for difference in &differences {
            if difference.dot(&factor.solve(difference)) <= CREDIBLE {
                sum += difference * difference.transpose();
                count += 1.0;
            }
        }
        if count < MIN_DIFFERENCES as f64 {
            break;
        }
        covariance = sum * (TRUNCATION / count) + Matrix4::identity() * MIN_EDGE_PX2;
    }
    covariance
}
