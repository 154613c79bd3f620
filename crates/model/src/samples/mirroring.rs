//! Test for a mirror image: boxes and fixes show the ground either as a camera sees it, or mirrored.
//!
//! A camera above the ground maps it to the image by a homography whose determinant has one sign below the horizon. So
//! points that run anticlockwise on the ground, seen from above, run anticlockwise in the image, too. Swapped latitudes
//! and longitudes reflect the ground, a mirrored picture reflects the image: then they run the other way, while a
//! homography fits as well as before.
//!
//! The sign is that of the determinant of the cross-covariance of foot points and positions. Divided by the roots of the
//! determinants of both covariances it is the product of their canonical correlations (Hotelling 1936), up to its sign.

use nalgebra::{Matrix2, Matrix4, Vector4};

use crate::geo::{LocalPlane, Position};
use crate::statistics::median;

/// A foot point in the image, px (x to the right, y down), and the position of the same instant.
pub type FootPosition = ([f64; 2], Position);

/// Fewer points are of one walk, whose fixes have a common error.
const FEWEST_POINTS: usize = 200;
/// Least standard deviation of the foot points along their shorter principal axis, px: below it they are on a line.
const LEAST_SPREAD_PX: f64 = 8.0;
/// Product of the canonical correlations from which on its sign is believed.
const LEAST_CORRELATION: f64 = 0.15;
/// The same in standard deviations of the correlation of as many independent points.
const LEAST_SIGMAS: f64 = 3.0;
/// Positions farther from the median than this number of robust standard deviations are gross errors.
const GROSS_SIGMAS: f64 = 5.0;
/// Normal standard deviations in a median absolute deviation.
const SIGMAS_PER_MAD: f64 = 1.4826;

/// True if the image shows a mirror image of the positions; false where the points are too few, or too close to a line,
/// to tell.
#[must_use]
pub fn is_mirrored(points: &[FootPosition]) -> bool {
    let rows = in_metres(points);
    if rows.len() < FEWEST_POINTS {
        return false;
    }
    let count = rows.len() as f64;
    let mean = rows.iter().sum::<Vector4<f64>>() / count;
    let covariance =
        rows.iter().map(|row| (row - mean) * (row - mean).transpose()).sum::<Matrix4<f64>>() / count;
    let block = |row, column| -> Matrix2<f64> { covariance.fixed_view::<2, 2>(row, column).into_owned() };
    let (image, ground) = (block(0, 0), block(2, 2));
    let correlation = block(0, 2).determinant() / (image.determinant() * ground.determinant()).sqrt();
    image.symmetric_eigenvalues().min().sqrt() >= LEAST_SPREAD_PX
        && -correlation >= LEAST_CORRELATION.max(LEAST_SIGMAS / count.sqrt())
}

/// Foot points with y up, px, and positions, m east and north of their median, without gross errors.
fn in_metres(points: &[FootPosition]) -> Vec<Vector4<f64>> {
    let Some(centre) = median_position(points.iter().map(|(_, position)| *position)) else {
        return Vec::new();
    };
    let plane = LocalPlane::new(centre);
    let row = |([x, y], position): &FootPosition| {
        let ground = plane.to_plane_within_range(*position)?;
        Some(Vector4::new(*x, -y, ground.east_m, ground.north_m))
    };
    let mut rows: Vec<Vector4<f64>> = points.iter().filter_map(row).collect();
    for axis in [2, 3] {
        let deviation = median(rows.iter().map(|row| row[axis].abs()).collect());
        let most_m = GROSS_SIGMAS * (SIGMAS_PER_MAD * deviation).max(1.0);
        rows.retain(|row| row[axis].abs() <= most_m);
    }
    rows
}

/// The median of longitudes and of latitudes; `None` for no position.
#[must_use]
pub fn median_position(positions: impl Iterator<Item = Position> + Clone) -> Option<Position> {
    positions.clone().next()?;
    let longitude_deg = median(positions.clone().map(Position::longitude_deg).collect());
    let latitude_deg = median(positions.map(Position::latitude_deg).collect());
    Position::new(longitude_deg, latitude_deg).ok()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use proptest::prelude::*;

    use super::*;
    use crate::geo::EastNorth;

    /// A pinhole camera 4 to 20 m above the ground, tilted down, and points that it sees.
    fn seen(height_m: f64, tilt: f64, pan: f64, places: &[(f64, f64)]) -> Vec<FootPosition> {
        let plane = LocalPlane::new(Position::new(11.57, 48.14).expect("in range"));
        let seen = places.iter().map(|(right_m, forward_m)| {
            let depth_m = forward_m * tilt.cos() + height_m * tilt.sin();
            let down_m = height_m * tilt.cos() - forward_m * tilt.sin();
            let foot = [960.0 + 1_000.0 * right_m / depth_m, 540.0 + 1_000.0 * down_m / depth_m];
            let east_m = right_m * pan.cos() + forward_m * pan.sin();
            let north_m = forward_m * pan.cos() - right_m * pan.sin();
            (foot, plane.to_position(EastNorth { east_m, north_m }))
        });
        seen.collect()
    }

    fn swapped(points: &[FootPosition]) -> Vec<FootPosition> {
        let swap = |(foot, position): &FootPosition| (*foot, position.swapped().expect("in Europe"));
        points.iter().map(swap).collect()
    }

    proptest! {
        #[test]
        fn a_camera_sees_no_mirror_image_and_swapped_positions_are_one(
            height_m in 4.0..20.0_f64, tilt in 0.2..1.2_f64, pan in 0.0..TAU,
            places in proptest::collection::vec((-25.0..25.0_f64, 5.0..60.0_f64), 200..300),
        ) {
            let points = seen(height_m, tilt, pan, &places);
            prop_assert!(!is_mirrored(&points));
            prop_assert!(is_mirrored(&swapped(&points)));
        }

        #[test]
        fn a_line_is_not_taken_for_a_mirror_image(
            pan in 0.0..TAU, noise in proptest::collection::vec((-3.0..3.0_f64, -3.0..3.0_f64), 200..300),
        ) {
            let places: Vec<(f64, f64)> =
                noise.iter().enumerate().map(|(at, _)| (at as f64 * 0.1 - 15.0, 20.0)).collect();
            let mut points = seen(6.0, 0.5, pan, &places);
            let plane = LocalPlane::new(points[0].1);
            for (point, (east_m, north_m)) in points.iter_mut().zip(noise) {
                let moved = plane.to_plane(point.1).plus(EastNorth { east_m, north_m });
                point.1 = plane.to_position(moved);
            }
            prop_assert!(!is_mirrored(&points));
            prop_assert!(!is_mirrored(&swapped(&points)));
        }
    }
}
