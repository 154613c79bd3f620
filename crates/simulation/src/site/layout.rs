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
    pub(super) const fn image_size(&self) -> ImageSize {
        self.camera.image_size
    }

    pub(super) fn size_px(&self) -> (f64, f64) {
        self.camera.size_px()
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
    let camera = |index: usize| {
        // The two cameras of a pair look towards each other.
        let towards_deg = if index.is_multiple_of(2) { 12.0 } else { -12.0 };
        let camera = PinholeCamera {
            image_size: ImageSize::new(1280, 720).expect("constants above 0"),
            height_m: random.random_range(6.5..8.0),
            focal_px: random.random_range(1000.0..1120.0),
            pan_deg: towards_deg + random.random_range(-3.0..3.0),
            tilt_deg: random.random_range(12.0..15.0),
            lens_distortion: -0.01,
        };
        SiteCamera { camera, east_m: east_m(index) }
    };
    (0..options.cameras.max(1)).map(camera).collect()
}

/// Length of the street from the first to the last camera, m.
pub(super) fn street_length_m(cameras: usize) -> f64 {
    east_m(cameras.max(1) - 1)
}

fn east_m(index: usize) -> f64 {
    (index / 2) as f64 * (OVERLAP_M + GAP_M) + (index % 2) as f64 * OVERLAP_M
}
