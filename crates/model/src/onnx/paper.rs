//! The recipe `paper`: its network without the fix among the inputs, in standardised degrees.

use super::boxes::Boxes;
use super::expression::Expr;
use super::network::{decode, encode};
use crate::geo::Position;
use crate::recipes::paper::{PaperEncoder, UNITS_PER_DEGREE};

/// The answer of the paper's method.
#[derive(Debug, Clone, Copy)]
pub(super) struct PaperEstimate<'g> {
    /// Degrees east and north of the origin.
    pub(super) offset_deg: [Expr<'g>; 2],
    /// Longitude (not wrapped) and latitude.
    pub(super) position_deg: [Expr<'g>; 2],
    /// eX of (2), mixed units.
    pub(super) reconstruction_error: Expr<'g>,
    /// Es eX, the mean variance per axis, m2.
    pub(super) variance_m2: Expr<'g>,
}

pub(super) fn estimate<'g>(encoder: &PaperEncoder, origin: Position, boxes: Boxes<'g>) -> PaperEstimate<'g> {
    let bottleneck = encode(&encoder.denied, boxes.sides);
    let misses = boxes.sides - decode(&encoder.denied, bottleneck);
    let reconstruction_error = misses.square().sum() / 4.0;
    let offset_deg: [Expr<'g>; 2] = (bottleneck / UNITS_PER_DEGREE).split();
    PaperEstimate {
        offset_deg,
        position_deg: [offset_deg[0] + origin.longitude_deg(), offset_deg[1] + origin.latitude_deg()],
        reconstruction_error,
        variance_m2: reconstruction_error * (encoder.error_scales[1] * encoder.unit_m2),
    }
}
