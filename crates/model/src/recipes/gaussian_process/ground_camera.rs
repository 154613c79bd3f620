//! Cameras that boxes alone determine, for a search of their place and direction: whose boxes show whose
//! receiver is not known yet.

use super::upright_camera::{Parameters, UprightCamera};
use crate::domain::{BoundingBox, ImageSize, TargetClass};
use crate::encoder::features::features_of;

/// Standard deviation of the foot of a box, px.
const FOOT_NOISE_PX: f64 = 3.0;
/// Ground points beyond this multiple of the camera's height are left out: their distance is not determined.
const MAX_DISTANCE_HEIGHTS: f64 = 40.0;

/// An upright pinhole camera above flat ground, without place and direction.
#[derive(Debug, Clone)]
pub struct GroundCamera {
    camera: UprightCamera,
    parameters: Parameters,
}

/// Where a box's foot touches the ground, in metres beside and before the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundPoint {
    /// To the right of the camera's optical axis, m.
    pub right_m: f64,
    /// Ahead of the camera, m.
    pub forward_m: f64,
    /// Variance per axis by the noise of the foot, m2.
    pub box_variance_m2: f64,
}

impl GroundCamera {
    /// Cameras that fit the boxes of these targets (in the order of targets), one for each of some focal
    /// lengths, which boxes do not determine. None for too few whole boxes.
    ///
    /// Their scale is that of targets of usual height: of a car by its class, otherwise of a person.
    #[must_use]
    pub fn of_boxes(
        boxes: &[(u32, BoundingBox)],
        image_size: ImageSize,
        class: Option<&TargetClass>,
    ) -> Vec<Self> {
        let sides: Vec<(u32, [f64; 4])> =
            boxes.iter().map(|(target, bounding_box)| (*target, features_of(bounding_box))).collect();
        let size_px = (f64::from(image_size.width_px()), f64::from(image_size.height_px()));
        let height_m = super::target_height_m(std::iter::once(class));
        let Some(camera) = UprightCamera::new(&sides, size_px, height_m) else { return Vec::new() };
        let starts = camera.starts();
        starts.into_iter().map(|parameters| Self { camera: camera.clone(), parameters }).collect()
    }

    /// True if targets of that class are about equally tall, so that their boxes tell the scale.
    #[must_use]
    pub fn knows_height_of(class: &TargetClass) -> bool {
        super::target_height_m(std::iter::once(Some(class))).1 < 0.5
    }

    /// Log density of its focal length a priori, but for a constant: boxes do not determine it.
    #[must_use]
    pub fn log_prior(&self) -> f64 {
        self.camera.log_focal_prior(&self.parameters)
    }

    /// Where the box's target stands; `None` beyond the horizon or too far away.
    #[must_use]
    pub fn ground_point(&self, bounding_box: &BoundingBox) -> Option<GroundPoint> {
        let [u, v, ..] = features_of(bounding_box);
        let at = |u, v| self.camera.ground_m(&self.parameters, u, v);
        let [right_m, forward_m] = at(u, v)?;
        let camera_m = self.parameters[4].exp();
        if right_m.hypot(forward_m) > MAX_DISTANCE_HEIGHTS * camera_m {
            return None;
        }
        let squared = |point: Option<[f64; 2]>| {
            point.map_or(f64::INFINITY, |[right, forward]| {
                (right - right_m).powi(2) + (forward - forward_m).powi(2)
            })
        };
        let slopes_m2 = squared(at(u + 1.0, v)) + squared(at(u, v + 1.0));
        let box_variance_m2 = 0.5 * FOOT_NOISE_PX * FOOT_NOISE_PX * slopes_m2;
        box_variance_m2.is_finite().then_some(GroundPoint { right_m, forward_m, box_variance_m2 })
    }
}
