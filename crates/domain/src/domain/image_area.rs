//! Areas of an image.

use super::bounding_box::{BoundingBox, MAX_IMAGE_PX};
use super::error::{Error, Result};

/// A polygon in the image, valid by construction: 3 to 64 corners, finite, within 131,072 px.
///
/// The last corner is joined to the first. Where edges cross, what is surrounded an even number of times is outside.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageArea {
    corners_px: Vec<[f64; 2]>,
}

impl ImageArea {
    /// Most corners of an area.
    pub const MAX_CORNERS: usize = 64;

    /// From its corners, each x and y in px from the upper left corner of the image.
    ///
    /// # Errors
    /// `InvalidArgument` naming `area` for fewer than 3 or more than 64 corners, or one that is not finite or beyond
    /// 131,072 px.
    pub fn new(corners_px: Vec<[f64; 2]>) -> Result<Self> {
        if !(3..=Self::MAX_CORNERS).contains(&corners_px.len()) {
            return Err(Error::invalid("area", format!("must have 3 to {} corners", Self::MAX_CORNERS)));
        }
        let limit = f64::from(MAX_IMAGE_PX);
        if corners_px.iter().flatten().any(|side| !(-limit..=limit).contains(side)) {
            return Err(Error::invalid("area", format!("must have finite corners within {limit} px")));
        }
        Ok(Self { corners_px })
    }

    /// True if the foot of a box, the middle of its lower edge, is inside.
    #[must_use]
    pub fn contains_foot_of(&self, bounding_box: &BoundingBox) -> bool {
        let x_px = bounding_box.left_px() + 0.5 * bounding_box.width_px();
        let y_px = bounding_box.top_px() + bounding_box.height_px();
        let nexts = self.corners_px.iter().cycle().skip(1);
        // Counts the edges that a ray to the right crosses.
        let crossed = self.corners_px.iter().zip(nexts).filter(|([x0, y0], [x1, y1])| {
            (*y0 > y_px) != (*y1 > y_px) && x_px < x0 + (y_px - y0) / (y1 - y0) * (x1 - x0)
        });
        crossed.count() % 2 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_foot(x_px: f64, y_px: f64) -> BoundingBox {
        BoundingBox::new(x_px - 5.0, y_px - 30.0, 10.0, 30.0).expect("a box")
    }

    #[test]
    fn the_foot_of_a_box_is_inside_or_outside() {
        // An L: its upper right quarter is missing.
        let corners = [[0.0, 0.0], [50.0, 0.0], [50.0, 50.0], [100.0, 50.0], [100.0, 100.0], [0.0, 100.0]];
        for corners in [corners.to_vec(), corners.iter().rev().copied().collect()] {
            let area = ImageArea::new(corners).expect("an area");
            for (x_px, y_px) in [(25.0, 25.0), (25.0, 75.0), (75.0, 75.0), (99.0, 51.0)] {
                assert!(area.contains_foot_of(&with_foot(x_px, y_px)), "{x_px}, {y_px}");
            }
            for (x_px, y_px) in [(75.0, 25.0), (-1.0, 50.0), (101.0, 75.0), (50.0, 101.0)] {
                assert!(!area.contains_foot_of(&with_foot(x_px, y_px)), "{x_px}, {y_px}");
            }
        }
    }

    #[test]
    fn what_is_no_area_is_refused() {
        let corner = |at: usize| [at as f64, (at * at) as f64];
        assert!(ImageArea::new((0..64).map(corner).collect()).is_ok());
        for corners in [vec![], vec![[0.0, 0.0], [1.0, 1.0]], (0..65).map(corner).collect()] {
            assert!(ImageArea::new(corners).is_err());
        }
        for side in [f64::NAN, f64::INFINITY, -131_073.0] {
            assert!(ImageArea::new(vec![[0.0, 0.0], [1.0, side], [1.0, 0.0]]).is_err(), "{side}");
        }
    }
}
