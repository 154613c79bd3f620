//! What the recipes share: from a box to a position, and back to the box that belongs to it.

pub(crate) mod auto_encoder;
pub(crate) mod features;
pub(crate) mod geometry;
pub(crate) mod initial_projection;
pub(crate) mod inverse_camera;
pub(crate) mod projection;
pub(crate) mod projection_fit;
pub(crate) mod stored_network;

use self::geometry::GeometricCovariance;
use super::artifact::ModelParts;

/// A recipe's fit: the encoder's part of a model, and the covariance of its parameters where the recipe
/// has one.
#[derive(Debug, Clone)]
pub(crate) struct FittedEncoder {
    pub(crate) parts: ModelParts,
    pub(crate) covariance: Option<GeometricCovariance>,
}
