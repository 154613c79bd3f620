//! The features of a box, and what an encoder makes of them.

use crate::domain::BoundingBox;
use crate::geo::EastNorth;

/// Number of features of a box.
pub(crate) const FEATURE_COUNT: usize = 4;

/// Names of the features in a model's metadata.
pub(crate) const FEATURES: [&str; FEATURE_COUNT] = ["foot_x_px", "foot_y_px", "width_px", "height_px"];

/// Foot point x and y, width and height of a box, px.
#[inline]
pub(crate) fn features_of(bounding_box: &BoundingBox) -> [f64; FEATURE_COUNT] {
    let [foot_x, foot_y] = bounding_box.foot_px();
    [foot_x, foot_y, bounding_box.width_px(), bounding_box.height_px()]
}

/// eX of (2) in squared box heights: the mean square of the decoder's error in foot x, foot y, width and
/// height, divided by the squared height.
#[inline]
pub(crate) fn reconstruction_error(bounding_box: &BoundingBox, encoded: &Encoded) -> f64 {
    let features = features_of(bounding_box);
    let squares =
        features.iter().zip(&encoded.reconstruction_px).map(|(one, other)| (one - other) * (one - other));
    squares.sum::<f64>() / (FEATURE_COUNT as f64 * bounding_box.height_px() * bounding_box.height_px())
}

/// The position that an encoder gives to a box, and the box that its decoder gives to the position.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Encoded {
    /// Position in the model's plane.
    pub(crate) position: EastNorth,
    /// The decoder's [`features_of`] the box, px; those of the box itself where the recipe has no decoder
    /// of these features.
    pub(crate) reconstruction_px: [f64; FEATURE_COUNT],
}
