//! Derivatives of an encoder with respect to the edges of a box.

use nalgebra::{Matrix4, Vector4};

use crate::domain::BoundingBox;
use crate::encoder::features::Encoded;
use crate::geo::EastNorth;

/// An encoder as a function of the box.
pub(crate) type Encode<'a> = dyn Fn(&BoundingBox) -> Encoded + 'a;

/// Derivatives of east, then north, with respect to the edges left, top, right, bottom, m/px.
pub(crate) type Jacobian = [[f64; 4]; 2];

/// Edges left, top, right, bottom of a box, px.
pub(crate) fn edges_of(bounding_box: &BoundingBox) -> [f64; 4] {
    let [left, top, width, height] = bounding_box.sides_px();
    [left, top, left + width, top + height]
}

/// The Jacobian of an encoder at a box, and that of the reconstructed edges (rows) with respect to the
/// box's edges (columns), px/px; both by central differences of one pixel.
///
/// For a box of one pixel, which cannot shrink, the derivatives are taken as 0.
pub(crate) fn jacobian_at(encode: &Encode<'_>, bounding_box: &BoundingBox) -> (Jacobian, Matrix4<f64>) {
    let edges = edges_of(bounding_box);
    let mut jacobian = [[0.0; 4]; 2];
    let mut reconstruction = Matrix4::zeros();
    for edge in 0..4 {
        let moved = |by_px: f64| {
            let mut edges = edges;
            edges[edge] += by_px;
            let [left, top, right, bottom] = edges;
            BoundingBox::new(left, top, right - left, bottom - top).ok().map(|moved| encode(&moved))
        };
        if let (Some(more), Some(less)) = (moved(0.5), moved(-0.5)) {
            let EastNorth { east_m, north_m } = less.position;
            jacobian[0][edge] = more.position.east_m - east_m;
            jacobian[1][edge] = more.position.north_m - north_m;
            let [foot_x, foot_y, width, height]: [f64; 4] =
                std::array::from_fn(|at| more.reconstruction_px[at] - less.reconstruction_px[at]);
            let edges = [foot_x - 0.5 * width, foot_y - height, foot_x + 0.5 * width, foot_y];
            reconstruction.set_column(edge, &Vector4::from(edges));
        }
    }
    (jacobian, reconstruction)
}

/// Variance per axis due to independent noise of 1 px2 in each edge, m2.
pub(crate) fn edge_variance_m2(jacobian: &Jacobian) -> f64 {
    0.5 * jacobian.iter().flatten().map(|derivative| derivative * derivative).sum::<f64>()
}

/// Variance per axis due to independent noise of 1 px2 in each coordinate of the foot point, m2.
pub(crate) fn foot_variance_m2(jacobian: &Jacobian) -> f64 {
    let squares = jacobian.iter().map(|[left, top, right, bottom]| {
        let (horizontal, vertical) = (left + right, top + bottom);
        horizontal * horizontal + vertical * vertical
    });
    0.5 * squares.sum::<f64>()
}
