//! The recipe `projective`: the map of `encoder/projection.rs` with its residual network, and the inverse camera.

use super::ProjectiveEncoder;
use crate::encoder::inverse_camera::{self, InverseCamera};
use crate::encoder::projection::{self, Projection, TERMS};
use crate::onnx::boxes::Boxes;
use crate::onnx::expression::Expr;
use crate::onnx::network::first_hidden;

/// Position (east and north, m) and reconstructed features, px.
pub(super) fn encode<'g>(encoder: &ProjectiveEncoder, boxes: Boxes<'g>) -> (Expr<'g>, Expr<'g>) {
    let graph = boxes.sides.graph();
    let map = &encoder.map;
    let Projection { scales, centre, unit_m, coefficients } = &map.projection;
    let standardised: [Expr<'g>; 4] = {
        let features = boxes.features();
        std::array::from_fn(|at| (features[at] - scales[at][0]) / scales[at][1])
    };
    let [foot_x, foot_y, width, height] = standardised;
    let bounded = |size: Expr<'g>| size.clamp(-projection::LARGEST_SIZE, projection::LARGEST_SIZE);
    let terms = [foot_x, foot_y, bounded(width), bounded(height)];
    let linear = |constant: f64, slopes: &[f64]| {
        graph.columns(&terms).matrix_product(terms.len(), 1, slopes) + constant
    };
    let denominator = linear(1.0, &coefficients[2 * TERMS..]).max(projection::LEAST_DENOMINATOR);
    let hidden = map
        .residual
        .as_ref()
        .map(|residual| (first_hidden(&residual.net, graph.columns(&standardised)), residual));
    let units: [Expr<'g>; 2] = std::array::from_fn(|axis| {
        let own = &coefficients[axis * TERMS..(axis + 1) * TERMS];
        let ratio = linear(own[0], &own[1..]) / denominator;
        let [low, high] = map.bounds[axis];
        let position = hidden.map_or(ratio, |(hidden, residual)| {
            let weights = &residual.weights[axis];
            ratio + hidden.matrix_product(weights.len(), 1, weights)
        });
        position.clamp(low, high)
    });
    let position_m = graph.columns(&units) * *unit_m + graph.row(&[centre.east_m, centre.north_m]);
    let offsets = graph.row(&scales.map(|[offset, _]| offset));
    let reconstruction_px =
        features_at(&encoder.decoder, units) * graph.row(&scales.map(|[_, unit]| unit)) + offsets;
    (position_m, reconstruction_px)
}

/// The standardised features of the box at a position in units.
fn features_at<'g>(camera: &InverseCamera, units: [Expr<'g>; 2]) -> Expr<'g> {
    let [east, north] = units;
    let (features, slopes) = camera.0.split_at(inverse_camera::COEFFICIENTS - 2);
    let denominator = (east * slopes[0] + north * slopes[1] + 1.0).max(inverse_camera::LEAST_DENOMINATOR);
    let (rows, _) = features.as_chunks::<3>();
    let of = |[constant, by_east, by_north]: &[f64; 3]| east * *by_east + north * *by_north + *constant;
    let numerators: Vec<Expr<'g>> = rows.iter().map(of).collect();
    east.graph().columns(&numerators) / denominator
}
