//! Where the cameras of a site stand and look.

use rand::RngExt;

use super::options::SiteOptions;
use crate::camera::{PinholeCamera, Point};
use crate::domain::ImageSize;
use crate::geo::EastNorth;
use crate::noise::stream;

/// Distance along the street between two cameras whose views overlap, and across a gap, m.
const OVERLAP_M: f64 = 22.0;
const GAP_M: f64 = 52.0;
/// The pavement and the lanes, north of the cameras, m.
pub(super) const PAVEMENT_M: [f64; 2] = [13.0, 34.0];
pub(super) const LANES_M: [f64; 2] = [38.0, 42.0];
/// How far the street goes on beyond the outer cameras, m.
pub(super) const STREET_END_M: f64 = 25.0;

/// A camera on a mast somewhere along the street.
#[derive(Debug, Clone, Copy)]
pub(super) struct SiteCamera {
    camera: PinholeCamera,
    east_m: f64,
}

impl SiteCamera {
    /// The camera rotated to the right.
    pub(super) fn panned(self, by_deg: f64) -> Self {
        let pan_deg = self.camera.pan_deg + by_deg;
        Self { camera: PinholeCamera { pan_deg, ..self.camera }, ..self }
    }

    /// The point of the ground that is seen in a column and row, px, in the site's plane; `None` above the horizon.
    pub(super) fn ground_at(&self, column_px: f64, row_px: f64) -> Option<EastNorth> {
        let ground = self.camera.ground_at(column_px, row_px)?;
        Some(EastNorth { east_m: ground.east_m + self.east_m, ..ground })
    }

    pub(super) const fn image_size(&self) -> ImageSize {
        self.camera.image_size
    }

    pub(super) fn size_px(&self) -> (f64, f64) {
        self.camera.size_px()
    }

    /// Distance of a point of the site's plane from the foot of the mast, m.
    pub(super) fn distance_m(&self, point: EastNorth) -> f64 {
        point.distance_m(EastNorth { east_m: self.east_m, north_m: 0.0 })
    }

    /// The rectangle around a body in the site's plane, px.
    pub(super) fn extents(&self, body: &[Point]) -> Option<[f64; 4]> {
        let moved = |point: &Point| Point {
            ground: EastNorth { east_m: point.ground.east_m - self.east_m, ..point.ground },
            ..*point
        };
        self.camera.extents(&body.iter().map(moved).collect::<Vec<Point>>())
    }
}

/// The cameras in the order of the street.
pub(super) fn cameras(options: &SiteOptions) -> Vec<SiteCamera> {
    let mut random = stream(options.camera_seed, 1 << 41);
    let group = options.cameras_per_group.max(1);
    let camera = |index: usize| {
        // The outer cameras of a group look towards each other.
        let (place, last) = (index % group, (group - 1).max(1));
        let towards_deg = 12.0 - 24.0 * place as f64 / last as f64;
        let camera = PinholeCamera {
            image_size: ImageSize::new(1280, 720).expect("constants above 0"),
            height_m: random.random_range(6.5..8.0),
            focal_px: random.random_range(1000.0..1120.0),
            pan_deg: towards_deg + random.random_range(-3.0..3.0),
            tilt_deg: random.random_range(12.0..15.0),
            lens_distortion: -0.01,
        };
        SiteCamera { camera, east_m: east_m(index, group) }
    };
    (0..options.cameras.max(1)).map(camera).collect()
}

/// Length of the street from the first to the last camera, m.
pub(super) fn street_length_m(options: &SiteOptions) -> f64 {
    east_m(options.cameras.max(1) - 1, options.cameras_per_group.max(1))
}

fn east_m(index: usize, group: usize) -> f64 {
    let group_m = (group - 1) as f64 * OVERLAP_M + GAP_M;
    (index / group) as f64 * group_m + (index % group) as f64 * OVERLAP_M
}
