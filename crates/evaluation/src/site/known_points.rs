//! Known points of a recorded site: places that an operator would read off each camera's picture and off a map.

use super::recording::{LabelledBox, SiteRecording};
use crate::domain::{BoundingBox, KnownPoint};
use crate::geo::EastNorth;
use crate::model::SiteKnownPoint;
use crate::simulation::{standard_normal, stream};

/// Ways to the corners of an image, right and down.
const CORNERS: [[f64; 2]; 4] = [[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]];
/// Stream of a seed: apart from those of carriers, cameras and receivers.
const STREAM: u64 = 900;

/// Indices of the feet that are nearest to the corners of an image, opposite corners first; all 0 without feet.
#[must_use]
pub fn nearest_to_corners(feet_px: &[[f64; 2]]) -> [usize; 4] {
    CORNERS.map(|[right, down]| {
        let along = |at: &usize| right * feet_px[*at][0] + down * feet_px[*at][1];
        (0..feet_px.len()).max_by(|one, other| along(one).total_cmp(&along(other))).unwrap_or_default()
    })
}

impl SiteRecording {
    /// The same with some known points per camera, at most four: the true places of the feet that are nearest to the corners
    /// of the image, with errors of [`KnownPoint::DEFAULT_SIGMA_M`] per axis that are drawn from a seed.
    #[must_use]
    pub fn with_known_points(self, count: usize, seed: u64) -> Self {
        let mut random = stream(seed, STREAM);
        let mut known_points = Vec::new();
        for (camera, own) in self.cameras.iter().enumerate() {
            let true_feet: Vec<(BoundingBox, EastNorth)> = own
                .boxes
                .iter()
                .filter_map(|labelled| Some((labelled.bounding_box, self.truth_of(labelled)?)))
                .collect();
            let feet_px: Vec<[f64; 2]> = true_feet.iter().map(|(own, _)| own.foot_px()).collect();
            for at in nearest_to_corners(&feet_px).into_iter().take(count) {
                let Some((bounding_box, truth)) = true_feet.get(at) else { continue };
                let mut error_m = || KnownPoint::DEFAULT_SIGMA_M * standard_normal(&mut random);
                known_points.push(SiteKnownPoint {
                    camera,
                    image_px: bounding_box.foot_px(),
                    position: EastNorth {
                        east_m: truth.east_m + error_m(),
                        north_m: truth.north_m + error_m(),
                    },
                    variance_m2: KnownPoint::DEFAULT_SIGMA_M.powi(2),
                });
            }
        }
        Self { known_points, ..self }
    }

    fn truth_of(&self, labelled: &LabelledBox) -> Option<EastNorth> {
        self.truth.get(&(labelled.time, labelled.target?)).copied()
    }
}
