//! The robust homography of the foot point: what a practitioner would use instead of a network.
//!
//! A normalised direct linear transform, chosen among many by the median miss, then refined in
//! metres under a robust loss. What never happens here: a use of the box's sides or of time.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::projection::{self, Form, Projection};
use super::rows::Row;
use crate::domain::BoundingBox;
use crate::geo::{EastNorth, LocalPlane, Position};

/// A map from the foot point of a box to the plane.
#[derive(Debug, Clone)]
pub struct Homography(Projection);

/// Fits boxes to positions of one plane (m); `None` for fewer than 8 pairs, or pairs that are all
/// at one spot.
#[must_use]
pub fn fit(pairs: &[(BoundingBox, EastNorth)], seed: u64) -> Option<Homography> {
    let nowhere = LocalPlane::new(Position::new(0.0, 0.0).ok()?).origin();
    // Every pair is its own target, so that none is taken to err like its neighbour.
    let rows: Vec<Row> = pairs
        .iter()
        .enumerate()
        .map(|(at, (bounding_box, label))| Row {
            time_s: 0.0,
            target: at as u32,
            pass: at as u32,
            bounding_box: *bounding_box,
            position: nowhere,
            label: *label,
            own_variance_m2: None,
        })
        .collect();
    if rows.len() < 8 {
        return None;
    }
    let form = Form { sides: false, extra_sigma: 1.0 };
    let fitted = projection::fit(&rows, form, &[], &mut ChaCha8Rng::seed_from_u64(seed));
    let moves = fitted.projection.coefficients.iter().any(|coefficient| coefficient.abs() > 1e-9);
    moves.then_some(Homography(fitted.projection))
}

impl Homography {
    /// Where the foot of a box stands; `None` at or above the horizon.
    #[must_use]
    pub fn project(&self, bounding_box: &BoundingBox) -> Option<EastNorth> {
        self.0.sees_ground(bounding_box).then(|| self.0.project(bounding_box, [0.0; 2]))
    }
}
