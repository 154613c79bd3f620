//! What the training fixes say of the receiver's error.
//!
//! What never happens here: a look at the truth.

use nalgebra::{DMatrix, DVector};

use super::rows::{Rows, spread};

/// Terms of the quadratic surface.
const TERMS: usize = 15;

/// Variance per axis of the fixes about a quadratic surface over the boxes, m2: the receiver's own
/// variance, and a little of what the surface misses.
pub(super) fn scatter_m2(rows: &Rows) -> f64 {
    let boxes: Vec<[f64; 4]> = rows
        .rows
        .iter()
        .map(|row| {
            let [foot_x, foot_y] = row.bounding_box.foot_px();
            [foot_x, foot_y, row.bounding_box.width_px(), row.bounding_box.height_px()]
        })
        .collect();
    let count = boxes.len();
    let scales: [(f64, f64); 4] = std::array::from_fn(|at| {
        let mean = boxes.iter().map(|sides| sides[at]).sum::<f64>() / count as f64;
        (mean, spread(boxes.iter().map(|sides| sides[at])).max(1.0))
    });
    let design = DMatrix::from_fn(count, TERMS, |row, term| {
        let side = |at: usize| (boxes[row][at] - scales[at].0) / scales[at].1;
        match term {
            0 => 1.0,
            1..=4 => side(term - 1),
            _ => {
                let pairs = [(0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3)];
                let (one, other) = pairs[term - 5];
                side(one) * side(other)
            }
        }
    });
    let normal = design.tr_mul(&design) + DMatrix::identity(TERMS, TERMS) * (1e-6 * count as f64);
    let Some(factor) = normal.cholesky() else { return 1.0 };
    let mut sum = 0.0;
    for axis in 0..2 {
        let labels = DVector::from_iterator(
            count,
            rows.rows.iter().map(|row| if axis == 0 { row.label.east_m } else { row.label.north_m }),
        );
        let solution = factor.solve(&design.tr_mul(&labels));
        sum += (&design * solution - labels).norm_squared();
    }
    (sum / (2.0 * count.saturating_sub(TERMS).max(1) as f64)).max(1e-4)
}
