//! The geometric map that all recipes are compared with, and the covariance of its parameters.

use super::initial_projection::subset_rng;
use super::projection_fit::{self, Form, ParameterCovariance, ProjectionFit};
use crate::domain::BoundingBox;
use crate::network::Net;
use crate::samples::rows::TrainingRows;

/// Hidden units of a network on the residuals of a geometric map.
pub(crate) const RESIDUAL_UNITS: usize = 16;

/// The geometric map with all features, for the noise of the fixes about it and for the covariance of its
/// parameters.
pub(crate) fn fit_geometry(rows: &TrainingRows) -> ProjectionFit {
    projection_fit::fit(&rows.rows, Form { uses_size: true, extra_sigma: 1.0 }, &[], &mut subset_rng())
}

/// The covariance of a fitted geometric map, with the network whose hidden units are its extra columns.
#[derive(Debug, Clone)]
pub(crate) struct GeometricCovariance {
    parameters: ParameterCovariance,
    network: Option<Net>,
}

impl GeometricCovariance {
    /// The covariance of a geometric map, and the network of its extra columns if it has some.
    pub(crate) const fn new(parameters: ParameterCovariance, network: Option<Net>) -> Self {
        Self { parameters, network }
    }

    /// Error variance per axis at a box due to the noise of the training fixes, m2.
    pub(crate) fn variance_m2(&self, bounding_box: &BoundingBox) -> f64 {
        let Some(network) = &self.network else {
            return self.parameters.variance_m2(bounding_box, &[]);
        };
        let inputs = self.parameters.projection().standardised(bounding_box);
        let hidden: [f32; RESIDUAL_UNITS] = network.first_hidden(&inputs);
        self.parameters.variance_m2(bounding_box, &hidden.map(f64::from))
    }
}
