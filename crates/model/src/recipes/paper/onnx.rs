//! The recipe `paper`: its network without the fix among the inputs, in standardised degrees.

use super::{PaperEncoder, UNITS_PER_DEGREE};
use crate::onnx::answer::{Answer, GraphContext, isotropic};
use crate::onnx::expression::Expr;
use crate::onnx::network::{decode, encode};
use crate::onnx::plane;

pub(super) fn express<'g>(encoder: &PaperEncoder, context: &GraphContext<'_, 'g>) -> Answer<'g> {
    let boxes = context.boxes;
    let origin = context.plane.origin();
    let bottleneck = encode(&encoder.denied, boxes.sides);
    let misses = boxes.sides - decode(&encoder.denied, bottleneck);
    let reconstruction_error = misses.square().sum() / 4.0;
    let [east_deg, north_deg]: [Expr<'g>; 2] = (bottleneck / UNITS_PER_DEGREE).split();
    let latitude_deg = north_deg + origin.latitude_deg();
    Answer {
        position_m: plane::to_plane(context.plane, east_deg, latitude_deg),
        position_deg: [east_deg + origin.longitude_deg(), latitude_deg],
        covariance_m2: isotropic(reconstruction_error * (encoder.error_scales[1] * encoder.unit_m2)),
        r95_scale: context.graph().row(&[context.r95_scale]),
        reconstruction_error,
    }
}
