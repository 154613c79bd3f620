//! Points of the ground that an operator knows: where they are in the image and on the earth.

use super::bounding_box::ImageSize;
use super::error::{Error, Result};
use super::gnss_error::SigmaM;
use crate::geo::Position;

/// A point of the ground whose place in a camera's image and on the earth is known, such as the corner of a kerb.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownPoint {
    /// From the left and from the top of the image, px.
    pub image_px: [f64; 2],
    /// Where it is.
    pub position: Position,
    /// Standard deviation per axis of that position.
    pub sigma_m: SigmaM,
}

impl KnownPoint {
    /// Points of a camera at most.
    pub const MOST: usize = 100;
    /// Standard deviation per axis where none is stated, m: a step, for the lower edge of a box is not exactly where its
    /// target stands.
    pub const DEFAULT_SIGMA_M: f64 = 0.5;
    /// Largest coordinate in an image whose size is unknown, px.
    const LARGEST_PX: f64 = 1e5;

    /// Checks the points of a camera.
    ///
    /// # Errors
    /// Names the field of the first one that is outside of the image, or says that there are too many.
    pub(super) fn check_all(points: &[Self], image_size: Option<ImageSize>) -> Result<()> {
        if points.len() > Self::MOST {
            return Err(Error::invalid("known_points", format!("must be at most {}", Self::MOST)));
        }
        let limits_px = image_size
            .map_or([Self::LARGEST_PX; 2], |size| [f64::from(size.width_px()), f64::from(size.height_px())]);
        for (at, point) in points.iter().enumerate() {
            for ((name, px), limit_px) in ["x_px", "y_px"].into_iter().zip(point.image_px).zip(limits_px) {
                if !(0.0..=limit_px).contains(&px) {
                    return Err(Error::invalid(
                        format!("known_points[{at}].{name}"),
                        format!("must be within the image, from 0 to {limit_px} px"),
                    ));
                }
            }
        }
        Ok(())
    }
}
