//! The robust homography of the foot point: the common practice for a camera above a plane.
//!
//! A normalised direct linear transform (Hartley and Zisserman, 2nd ed., 4.4), selected among random
//! minimal sets by the median residual, then refined in metres under a robust loss. Width and height
//! of the box and the time of the samples are not used.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::domain::BoundingBox;
use crate::geo::EastNorth;
use crate::model::{Projection, fit_foot_points};

/// A map from the foot point of a box to the plane.
#[derive(Debug, Clone)]
pub struct Homography(Projection);

/// Fits boxes to positions in one plane (m); `None` for fewer than 8 pairs, or pairs that are all
/// at one position.
#[must_use]
pub fn fit(pairs: &[(BoundingBox, EastNorth)], seed: u64) -> Option<Homography> {
    fit_foot_points(pairs, &mut ChaCha8Rng::seed_from_u64(seed)).map(Homography)
}

impl Homography {
    /// Ground position of a box's foot point, m; `None` at or above the horizon.
    #[must_use]
    pub fn project(&self, bounding_box: &BoundingBox) -> Option<EastNorth> {
        self.0.is_below_horizon(bounding_box).then(|| self.0.project(bounding_box, [0.0; 2]))
    }
}
