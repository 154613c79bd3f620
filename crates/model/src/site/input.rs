//! The training input of a site.

use crate::domain::{BoundingBox, ImageSize, NoiseCorrelation};
use crate::geo::EastNorth;

/// Correlation over time of the receivers' errors that a fit begins with: that of phones, in the open and near walls. The
/// time constant stays; the white share is estimated.
pub const RECEIVER_CORRELATION: NoiseCorrelation =
    NoiseCorrelation { white_share: 0.08, time_constant_s: 30.0 };

/// A fix with the boxes of its carrier at the same instant, in all cameras that see it.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteFix {
    /// Number of the receiver; errors of one receiver are correlated over time.
    pub receiver: u32,
    /// Since any fixed instant, s.
    pub time_s: f64,
    /// In the site's plane, m.
    pub position: EastNorth,
    /// Index of the camera and box; at least one.
    pub boxes: Vec<(usize, BoundingBox)>,
}

impl SiteFix {
    /// The same fix as the fit of one camera alone takes it; `None` if the camera does not see its carrier.
    #[must_use]
    pub fn seen_by(&self, camera: usize) -> Option<Self> {
        let (_, bounding_box) = self.boxes.iter().find(|(at, _)| *at == camera)?;
        Some(Self { boxes: vec![(0, *bounding_box)], ..self.clone() })
    }
}

/// One target in two cameras at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SitePair {
    /// Number of the target: that of its receiver, where it has one.
    pub target: u32,
    /// Since any fixed instant, s.
    pub time_s: f64,
    /// Indexes of the cameras.
    pub cameras: [usize; 2],
    /// The target's box in each.
    pub boxes: [BoundingBox; 2],
}

/// A point of the ground whose place is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SiteKnownPoint {
    /// Index of the camera.
    pub camera: usize,
    /// Where it is in that camera's image, px.
    pub image_px: [f64; 2],
    /// Where it is in the site's plane, m.
    pub position: EastNorth,
    /// Error variance per axis of that position, m2.
    pub variance_m2: f64,
}

/// Training rows of all cameras of a site.
#[derive(Debug, Clone)]
pub struct SiteFitInput<'a> {
    /// Size of each camera's image, where it is known: boxes that its border cuts are left out.
    pub image_sizes: &'a [Option<ImageSize>],
    /// Fixes; those of one receiver in the order of time.
    pub fixes: &'a [SiteFix],
    /// Targets in two cameras at once.
    pub pairs: &'a [SitePair],
    /// Known points of all cameras. With any, the error of each receiver has a lasting part, which they show.
    pub known_points: &'a [SiteKnownPoint],
    /// Correlation over time of the receivers' errors to begin with; their variance and white share are estimated.
    pub correlation: NoiseCorrelation,
}

/// Why there are no maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SiteFitError {
    /// A camera has neither enough fixes nor enough targets in common with a camera that has.
    #[error("camera {camera} has fewer than {FEWEST_ROWS} fixes or targets in common with the other cameras")]
    TooFewRows {
        /// Index of the camera.
        camera: usize,
    },
    /// The caller wanted it to end.
    #[error("cancelled")]
    Cancelled,
    /// The least-squares problem has no finite solution.
    #[error("the cameras' maps have no finite solution: the fixes and boxes do not fit one ground plane")]
    NoSolution,
}

/// Fewest fixes, or targets in common with cameras whose map is known, that start a camera's map.
pub(super) const FEWEST_ROWS: usize = 12;

/// Foot u, foot v, width, height of a box, px: the features of a ground map.
pub(super) fn foot_and_size(bounding_box: &BoundingBox) -> [f64; 4] {
    [
        bounding_box.left_px() + 0.5 * bounding_box.width_px(),
        bounding_box.top_px() + bounding_box.height_px(),
        bounding_box.width_px(),
        bounding_box.height_px(),
    ]
}

/// True if the border of the image hides the foot of a box or a side of it. The upper border hides the head
/// only.
pub(super) fn is_foot_cut(bounding_box: &BoundingBox, image_size: Option<ImageSize>) -> bool {
    const NEAR_PX: f64 = 1.0;
    let [right_px, bottom_px] =
        [bounding_box.left_px() + bounding_box.width_px(), bounding_box.top_px() + bounding_box.height_px()];
    bounding_box.left_px() < NEAR_PX
        || image_size.is_some_and(|size| {
            right_px > f64::from(size.width_px()) - NEAR_PX
                || bottom_px > f64::from(size.height_px()) - NEAR_PX
        })
}
