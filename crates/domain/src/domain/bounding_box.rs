//! Bounding boxes and image sizes.

use super::error::{Error, Result};

/// Larger images are refused; within this f32 resolves pixels to 1/64.
pub(super) const MAX_IMAGE_PX: u32 = 131_072;

/// Size of a camera's image in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    width_px: u32,
    height_px: u32,
}

impl ImageSize {
    /// # Errors
    /// Names the side that is 0 or beyond 131,072 px.
    pub fn new(width_px: u32, height_px: u32) -> Result<Self> {
        for (field, side_px) in [("width_px", width_px), ("height_px", height_px)] {
            if side_px == 0 || side_px > MAX_IMAGE_PX {
                return Err(Error::invalid(field, format!("must be from 1 to {MAX_IMAGE_PX} pixels")));
            }
        }
        Ok(Self { width_px, height_px })
    }

    /// Width, px.
    #[must_use]
    pub const fn width_px(self) -> u32 {
        self.width_px
    }

    /// Height, px.
    #[must_use]
    pub const fn height_px(self) -> u32 {
        self.height_px
    }
}

/// A rectangle in the image, valid by construction: finite, of positive area, within 131,072 px.
///
/// `left_px` and `top_px` are relative to the image's upper left corner; they may be negative where a
/// detector extrapolates beyond the border.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    left_px: f64,
    top_px: f64,
    width_px: f64,
    height_px: f64,
}

impl BoundingBox {
    /// # Errors
    /// Names the side that is not finite, not positive, or larger than 131,072 px.
    pub fn new(left_px: f64, top_px: f64, width_px: f64, height_px: f64) -> Result<Self> {
        let limit = f64::from(MAX_IMAGE_PX);
        for (field, value) in [("left_px", left_px), ("top_px", top_px)] {
            if !(-limit..=limit).contains(&value) {
                return Err(Error::invalid(
                    field,
                    format!("must be a finite number of pixels within {limit}"),
                ));
            }
        }
        for (field, value) in [("width_px", width_px), ("height_px", height_px)] {
            if !(value > 0.0 && value <= limit) {
                return Err(Error::invalid(
                    field,
                    format!("must be a finite number of pixels above 0 and at most {limit}"),
                ));
            }
        }
        Ok(Self { left_px, top_px, width_px, height_px })
    }

    /// The same box, if it overlaps an image of that size.
    ///
    /// # Errors
    /// Refuses a box outside of the image, or beyond its border by more than a tenth of the image: it
    /// belongs to another image size, or its sides are swapped.
    pub fn within(self, image_size: ImageSize) -> Result<Self> {
        let (width_px, height_px) = (f64::from(image_size.width_px), f64::from(image_size.height_px));
        let sides = [
            ("left_px", self.left_px, self.left_px + self.width_px, width_px),
            ("top_px", self.top_px, self.top_px + self.height_px, height_px),
        ];
        for (field, low_px, high_px, size_px) in sides {
            let margin_px = 0.1 * size_px;
            if high_px <= 0.0 || low_px >= size_px || low_px < -margin_px || high_px > size_px + margin_px {
                return Err(Error::invalid(
                    field,
                    format!(
                        "the box extends from {low_px} to {high_px} px, outside of the image of {} x {} px; \
                         check the order of the sides and the camera's image_size",
                        image_size.width_px, image_size.height_px
                    ),
                ));
            }
        }
        Ok(self)
    }

    /// Left edge, px from the image's left border.
    #[must_use]
    pub const fn left_px(self) -> f64 {
        self.left_px
    }

    /// Upper edge, px from the image's upper border.
    #[must_use]
    pub const fn top_px(self) -> f64 {
        self.top_px
    }

    /// Width in px.
    #[must_use]
    pub const fn width_px(self) -> f64 {
        self.width_px
    }

    /// Height in px.
    #[must_use]
    pub const fn height_px(self) -> f64 {
        self.height_px
    }

    /// (left, top, width, height), the order of the paper's B.
    #[must_use]
    pub const fn sides_px(self) -> [f64; 4] {
        [self.left_px, self.top_px, self.width_px, self.height_px]
    }

    /// The box with its left and top edges moved outwards, as by an inaccurate detector.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn grown_to_upper_left(self, by_px: f64) -> Result<Self> {
        Self::new(self.left_px - by_px, self.top_px - by_px, self.width_px + by_px, self.height_px + by_px)
    }

    /// The foot point (x, y), px: the centre of the lower edge, where the target touches the ground.
    #[must_use]
    pub fn foot_px(self) -> [f64; 2] {
        [self.left_px + 0.5 * self.width_px, self.top_px + self.height_px]
    }

    /// True if the image border truncates the box, to within one pixel. Without an image size only the
    /// upper and left borders are checked.
    #[must_use]
    pub fn touches_border(self, image_size: Option<ImageSize>) -> bool {
        let near_px = 1.0;
        self.left_px < near_px
            || self.top_px < near_px
            || image_size.is_some_and(|size| {
                self.left_px + self.width_px > f64::from(size.width_px) - near_px
                    || self.top_px + self.height_px > f64::from(size.height_px) - near_px
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_without_area_or_not_finite_are_refused() {
        for sides in [
            [0.0, 0.0, 0.0, 5.0],
            [0.0, 0.0, 5.0, -1.0],
            [f64::NAN, 0.0, 5.0, 5.0],
            [0.0, f64::INFINITY, 5.0, 5.0],
            [0.0, 0.0, 1e39, 5.0],
        ] {
            let [left, top, width, height] = sides;
            assert!(BoundingBox::new(left, top, width, height).is_err(), "{sides:?}");
        }
    }

    #[test]
    fn a_box_outside_of_the_image_is_refused() {
        let size = ImageSize::new(640, 480).expect("valid");
        assert!(BoundingBox::new(600.0, 10.0, 60.0, 50.0).expect("valid").within(size).is_ok());
        assert!(BoundingBox::new(900.0, 10.0, 60.0, 50.0).expect("valid").within(size).is_err());
        assert!(BoundingBox::new(10.0, 470.0, 60.0, 200.0).expect("valid").within(size).is_err());
    }

    #[test]
    fn truncation_by_the_border_is_detected() {
        let size = ImageSize::new(640, 480).expect("valid");
        let inside = BoundingBox::new(10.0, 10.0, 60.0, 50.0).expect("valid");
        let truncated = BoundingBox::new(10.0, 430.0, 60.0, 50.0).expect("valid");
        assert!(!inside.touches_border(Some(size)));
        assert!(truncated.touches_border(Some(size)));
        assert!(!truncated.touches_border(None));
        assert!(BoundingBox::new(10.0, 0.0, 60.0, 50.0).expect("valid").touches_border(None));
    }
}
