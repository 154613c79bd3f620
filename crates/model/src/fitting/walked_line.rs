//! Test for a training whose walks were all on one line: positions beside it then rest on the geometry's prior.

use nalgebra::{Matrix2, Matrix4, SymmetricEigen, Vector2, Vector4};

use crate::samples::rows::TrainingRows;
use crate::statistics::median;

/// Standard deviation of the feet about one curve, in widths of a box, below which they are on a line.
const NARROW_WIDTHS: f64 = 0.25;

/// True if the feet of the boxes lie on one smooth curve of the image: a cubic about their principal axis.
pub(super) fn is_one_line(rows: &TrainingRows) -> bool {
    let feet: Vec<Vector2<f64>> = rows.rows.iter().map(|row| row.bounding_box.foot_px().into()).collect();
    let width_px = median(rows.rows.iter().map(|row| row.bounding_box.width_px()).collect());
    across_px(&feet).is_some_and(|across_px| across_px < NARROW_WIDTHS * width_px)
}

/// Standard deviation of points about their curve, px; `None` for points that determine none.
fn across_px(feet: &[Vector2<f64>]) -> Option<f64> {
    let count = feet.len() as f64;
    let centre = feet.iter().sum::<Vector2<f64>>() / count;
    let spread = feet.iter().map(|foot| (foot - centre) * (foot - centre).transpose()).sum::<Matrix2<f64>>();
    let eigen = SymmetricEigen::new(spread / count);
    let major = eigen.eigenvalues.imax();
    let axis = eigen.eigenvectors.column(major);
    let length_px = eigen.eigenvalues[major].max(0.0).sqrt();
    let of = |foot: &Vector2<f64>| {
        let moved = foot - centre;
        let along = moved.dot(&axis) / length_px;
        (Vector4::new(1.0, along, along.powi(2), along.powi(3)), axis[0] * moved[1] - axis[1] * moved[0])
    };
    let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for (terms, across_px) in feet.iter().map(of) {
        normal += terms * terms.transpose();
        right += terms * across_px;
    }
    let curve = normal.cholesky()?.solve(&right);
    let squares = feet.iter().map(of).map(|(terms, across_px)| (across_px - curve.dot(&terms)).powi(2));
    Some((squares.sum::<f64>() / count).sqrt())
}
