//! The robust homography of the foot point: what a practitioner would use instead of a network.
//!
//! A normalised direct linear transform, chosen among many by the median miss, then refined in
//! metres under a robust loss. What never happens here: a use of the box's sides or of time.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::domain::BoundingBox;
use crate::geo::EastNorth;
use crate::model::{Projection, fit_foot_points};

/// A map from the foot point of a box to the plane.
#[derive(Debug, Clone)]
pub struct Homography(Projection);

/// Fits boxes to positions of one plane (m); `None` for fewer than 8 pairs, or pairs that are all
/// at one spot.
#[must_use]
pub fn fit(pairs: &[(BoundingBox, EastNorth)], seed: u64) -> Option<Homography> {
    fit_foot_points(pairs, &mut ChaCha8Rng::seed_from_u64(seed)).map(Homography)
}

impl Homography {
    /// Where the foot of a box stands; `None` at or above the horizon.
    #[must_use]
    pub fn project(&self, bounding_box: &BoundingBox) -> Option<EastNorth> {
        self.0.sees_ground(bounding_box).then(|| self.0.project(bounding_box, [0.0; 2]))
    }
}
