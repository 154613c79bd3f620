//! Parts that recipes share: from a box to a position with its error, and back to the box that belongs to the position.

pub(crate) mod auto_encoder;
pub(crate) mod features;
pub(crate) mod geometry;
pub(crate) mod initial_projection;
pub(crate) mod inverse_camera;
pub(crate) mod projection;
pub(crate) mod projection_fit;
pub(crate) mod stored_network;

use std::fmt;

use self::features::Encoded;
use self::geometry::GeometricCovariance;
use crate::artifact::ModelParts;
use crate::domain::BoundingBox;
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance};
use crate::onnx::answer::{Answer, GraphContext};
use crate::recipes::gaussian_process::{HiddenFoot, RecentBoxes};
use crate::uncertainty::error_model::{BoxError, ErrorModel};

/// The encoder of a loaded model.
pub(crate) trait Encoder: fmt::Debug + Send + Sync {
    /// Position and reconstruction of a box alone.
    fn encode(&self, plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded;

    /// Position of a box with its error. `recent` summarises the earlier boxes of its target and takes this one in.
    fn estimate(
        &self,
        model: &ErrorContext<'_>,
        bounding_box: &BoundingBox,
        _fix: Option<EastNorth>,
        _recent: Option<&mut RecentBoxes>,
    ) -> Estimate {
        model.calibrated(bounding_box, &self.encode(model.plane, bounding_box))
    }

    /// [`estimate`](Self::estimate) for a box alone, as expressions of an ONNX graph.
    fn express<'g>(&self, context: &GraphContext<'_, 'g>) -> Answer<'g>;

    /// True if the position depends on the fix.
    fn uses_fix(&self) -> bool {
        false
    }

    /// The error that a map and others have in common (m2), as this encoder states it: widened as the map's own, and
    /// with the bias that all receivers have in common.
    fn widened(&self, common_m2: PlaneCovariance) -> PlaneCovariance {
        common_m2
    }

    /// Covariance of the error in the distance between the positions of two boxes, m2, if the encoder states it.
    fn displacement_covariance(&self, _boxes: [&BoundingBox; 2]) -> Option<PlaneCovariance> {
        None
    }

    /// The completed boxes if something hides the lower part of a box, if the encoder knows how tall targets are.
    fn hidden_foot(
        &self,
        _bounding_box: &BoundingBox,
        _recent: Option<&mut RecentBoxes>,
    ) -> Option<HiddenFoot> {
        None
    }
}

/// Position of a box with its error, before the limits of the scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Estimate {
    pub(crate) position: EastNorth,
    /// eX of (2), in the recipe's units.
    pub(crate) reconstruction_error: f64,
    /// Covariance of the position's error, m2.
    pub(crate) covariance: PlaneCovariance,
    /// The part of it that is new with each box, m2.
    pub(crate) box_noise: PlaneCovariance,
    /// Distance of the box from those of training, in covering radii.
    pub(crate) extrapolation_ratio: f64,
    /// Radius of 95 % in standard deviations.
    pub(crate) r95_scale: f64,
}

/// The parts of a model that an estimate uses besides the encoder.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ErrorContext<'a> {
    pub(crate) plane: &'a LocalPlane,
    pub(crate) error_model: &'a ErrorModel,
    pub(crate) r95_scale: f64,
    /// White share of the error variance.
    pub(crate) white_share: f64,
}

impl ErrorContext<'_> {
    /// The estimate of an encoder whose error comes from the calibrated error model.
    #[inline]
    pub(crate) fn calibrated(&self, bounding_box: &BoundingBox, encoded: &Encoded) -> Estimate {
        let lookup = self.error_model.look_up(bounding_box);
        let error = self.error_model.error_of(bounding_box, &lookup, encoded);
        self.isotropic(encoded.position, error, lookup.extrapolation_ratio)
    }

    /// An estimate with the same error along all directions.
    #[inline]
    pub(crate) fn isotropic(
        &self,
        position: EastNorth,
        error: BoxError,
        extrapolation_ratio: f64,
    ) -> Estimate {
        let covariance = PlaneCovariance::isotropic(error.variance_m2);
        Estimate {
            position,
            reconstruction_error: error.reconstruction_error,
            covariance,
            box_noise: covariance.scaled(self.white_share),
            extrapolation_ratio,
            r95_scale: self.r95_scale,
        }
    }
}

/// A recipe's fit: the encoder's part of a model, and the covariance of its parameters where the recipe
/// has one.
#[derive(Debug, Clone)]
pub(crate) struct FittedEncoder {
    pub(crate) parts: ModelParts,
    pub(crate) covariance: Option<GeometricCovariance>,
}
