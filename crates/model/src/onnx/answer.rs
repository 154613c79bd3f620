//! The answer of an encoder as expressions of a graph, and the parts of a model that they may use.

use super::boxes::Boxes;
use super::error_model::{self, CoverageLookup};
use super::expression::{Expr, Graph};
use super::plane;
use crate::geo::LocalPlane;
use crate::uncertainty::error_model::ErrorModel;

/// The position of boxes and its error, before the limits of [`Regressor::regress`](crate::Regressor::regress).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Answer<'g> {
    /// East and north of the origin, m.
    pub(crate) position_m: [Expr<'g>; 2],
    /// Longitude (not wrapped) and latitude.
    pub(crate) position_deg: [Expr<'g>; 2],
    /// East, cross, north, m2.
    pub(crate) covariance_m2: [Expr<'g>; 3],
    pub(crate) r95_scale: Expr<'g>,
    pub(crate) reconstruction_error: Expr<'g>,
}

/// The parts of a model that the expressions of its encoder may use, and the boxes of a graph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GraphContext<'m, 'g> {
    pub(crate) plane: &'m LocalPlane,
    pub(crate) error_model: &'m ErrorModel,
    pub(crate) r95_scale: f64,
    pub(crate) boxes: Boxes<'g>,
    pub(crate) lookup: CoverageLookup<'g>,
}

impl<'g> GraphContext<'_, 'g> {
    pub(crate) fn graph(&self) -> &'g Graph {
        self.boxes.sides.graph()
    }

    /// The answer of an encoder whose error comes from the calibrated error model: from its position (east and north,
    /// m) and its reconstructed features, px.
    pub(crate) fn calibrated(&self, (position_m, reconstruction_px): (Expr<'g>, Expr<'g>)) -> Answer<'g> {
        let (reconstruction_error, variance_m2) =
            error_model::error_of(self.error_model, self.boxes, &self.lookup, reconstruction_px);
        let position_m: [Expr<'g>; 2] = position_m.split();
        Answer {
            position_m,
            position_deg: plane::to_position(self.plane, position_m),
            covariance_m2: isotropic(variance_m2),
            r95_scale: self.graph().row(&[self.r95_scale]),
            reconstruction_error,
        }
    }
}

/// The covariance (east, cross, north, m2) with a variance per axis.
pub(crate) fn isotropic(variance_m2: Expr<'_>) -> [Expr<'_>; 3] {
    [variance_m2, variance_m2 * 0.0, variance_m2]
}
