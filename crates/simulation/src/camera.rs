//! A calibrated pinhole camera with radial distortion. No estimation method uses it.
//!
//! Does not add noise.

use crate::domain::ImageSize;
use crate::geo::EastNorth;

/// A point in space: m east, north and up of the foot of the camera's mast.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    pub(super) ground: EastNorth,
    pub(super) up_m: f64,
}

/// A camera on a mast at the origin of the plane.
#[derive(Debug, Clone, Copy)]
pub(super) struct PinholeCamera {
    pub(super) image_size: ImageSize,
    pub(super) height_m: f64,
    pub(super) focal_px: f64,
    /// Azimuth of the optical axis, clockwise from north.
    pub(super) pan_deg: f64,
    /// Depression of the optical axis below the horizon.
    pub(super) tilt_deg: f64,
    /// Radial displacement at the image's corner divided by its distance from the centre; negative for
    /// barrel distortion.
    pub(super) lens_distortion: f64,
}

impl PinholeCamera {
    /// Distance of a point of the plane to the right of the optical axis, m.
    pub(super) fn right_m(&self, EastNorth { east_m, north_m }: EastNorth) -> f64 {
        let (sin_pan, cos_pan) = self.pan_deg.to_radians().sin_cos();
        cos_pan * east_m - sin_pan * north_m
    }

    /// Column and row of a point, px; `None` behind the camera.
    pub(super) fn project(&self, point: Point) -> Option<[f64; 2]> {
        let (sin_pan, cos_pan) = self.pan_deg.to_radians().sin_cos();
        let (sin_tilt, cos_tilt) = self.tilt_deg.to_radians().sin_cos();
        let EastNorth { east_m, north_m } = point.ground;
        let down_m = self.height_m - point.up_m;
        let ahead_m = sin_pan * east_m + cos_pan * north_m;
        let right_m = self.right_m(point.ground);
        let depth_m = cos_tilt * ahead_m + sin_tilt * down_m;
        if depth_m < 0.1 {
            return None;
        }
        let below_m = cos_tilt * down_m - sin_tilt * ahead_m;
        let (column, row) = (self.focal_px * right_m / depth_m, self.focal_px * below_m / depth_m);
        let (width_px, height_px) = self.size_px();
        let factor = self.distortion(column.hypot(row) / (0.5 * width_px.hypot(height_px)));
        Some([0.5 * width_px + factor * column, 0.5 * height_px + factor * row])
    }

    /// The point of the ground that is seen in a column and row, px, without the lens's distortion; `None` above the
    /// horizon.
    pub(super) fn ground_at(&self, column_px: f64, row_px: f64) -> Option<EastNorth> {
        let (sin_pan, cos_pan) = self.pan_deg.to_radians().sin_cos();
        let (sin_tilt, cos_tilt) = self.tilt_deg.to_radians().sin_cos();
        let (width_px, height_px) = self.size_px();
        let right = (column_px - 0.5 * width_px) / self.focal_px;
        let below = (row_px - 0.5 * height_px) / self.focal_px;
        let (ahead, down) = (cos_tilt - below * sin_tilt, sin_tilt + below * cos_tilt);
        if down <= 0.0 {
            return None;
        }
        let distance = self.height_m / down;
        let (ahead_m, right_m) = (distance * ahead, distance * right);
        Some(EastNorth {
            east_m: sin_pan * ahead_m + cos_pan * right_m,
            north_m: cos_pan * ahead_m - sin_pan * right_m,
        })
    }

    /// Factor `1 + k r^2` on the distance from the centre, with r in half diagonals. Beyond the radius
    /// where strong barrel distortion would fold points back into the image it stays constant.
    fn distortion(&self, radius: f64) -> f64 {
        let max_radius =
            if self.lens_distortion < 0.0 { (-1.0 / (3.0 * self.lens_distortion)).sqrt() } else { 2.0 };
        let inner = radius.min(max_radius);
        1.0 + self.lens_distortion * inner * inner
    }

    /// Width and height of the image, px.
    pub(super) fn size_px(&self) -> (f64, f64) {
        (f64::from(self.image_size.width_px()), f64::from(self.image_size.height_px()))
    }

    /// (left, top, right, bottom) of the bounding rectangle of some points, px, not truncated by the
    /// border; `None` if any point is behind the camera.
    pub(super) fn extents(&self, body: &[Point]) -> Option<[f64; 4]> {
        let mut extents = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        for &point in body {
            let [column, row] = self.project(point)?;
            extents =
                [extents[0].min(column), extents[1].min(row), extents[2].max(column), extents[3].max(row)];
        }
        Some(extents)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens_distortion: f64) -> PinholeCamera {
        PinholeCamera {
            image_size: ImageSize::new(1280, 720).expect("valid"),
            height_m: 10.0,
            focal_px: 1000.0,
            pan_deg: 90.0,
            tilt_deg: 45.0,
            lens_distortion,
        }
    }

    fn at(east_m: f64, north_m: f64, up_m: f64) -> Point {
        Point { ground: EastNorth { east_m, north_m }, up_m }
    }

    #[test]
    fn the_optical_axis_meets_the_centre_and_up_is_up() {
        let [column, row] = camera(0.0).project(at(10.0, 0.0, 0.0)).expect("in front");
        assert!((column - 640.0).abs() < 1e-9 && (row - 360.0).abs() < 1e-9, "{column} {row}");
        let [_, higher] = camera(0.0).project(at(10.0, 0.0, 1.0)).expect("in front");
        assert!(higher < row);
        // Looking east, south is to the right.
        let [right, _] = camera(0.0).project(at(10.0, -1.0, 0.0)).expect("in front");
        assert!((right - 640.0 - 1000.0 / (10.0 * 2.0f64.sqrt())).abs() < 1e-9, "{right}");
        assert!(camera(0.0).project(at(-30.0, 0.0, 0.0)).is_none());
    }

    #[test]
    fn a_pixel_shows_the_ground_that_is_projected_there() {
        let camera = camera(0.0);
        let [column, row] = camera.project(at(14.0, -3.0, 0.0)).expect("in front");
        let ground = camera.ground_at(column, row).expect("below the horizon");
        assert!(ground.distance_m(EastNorth { east_m: 14.0, north_m: -3.0 }) < 1e-9, "{ground:?}");
        assert!(camera.ground_at(640.0, -700.0).is_none());
    }

    #[test]
    fn barrel_distortion_moves_points_towards_the_centre() {
        let point = at(10.0, -5.0, 0.0);
        let [straight, _] = camera(0.0).project(point).expect("in front");
        let [distorted, _] = camera(-0.1).project(point).expect("in front");
        assert!(distorted < straight && distorted > 640.0, "{distorted} {straight}");
    }
}
