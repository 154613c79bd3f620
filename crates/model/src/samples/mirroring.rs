//! Whether boxes and fixes show the ground as a camera sees it, or its mirror image.
//!
//! A camera above the ground maps it to the image by a homography whose determinant has one sign below the horizon. So
//! three points that run anticlockwise on the ground, seen from above, run anticlockwise in the image, too. Swapped
//! latitudes and longitudes reflect the ground, a mirrored picture reflects the image: then all triples run the other
//! way, while a homography fits as well as before.

use crate::geo::{LocalPlane, Position};
use crate::statistics::median;

/// A foot point in the image, px (x to the right, y down), and the position of the same instant.
pub type FootPosition = ([f64; 2], Position);

/// Triangles whose least height is smaller say nothing: in standard deviations of a fix.
const LEAST_HEIGHT_SIGMAS: f64 = 2.0;
/// The same in the image, px.
const LEAST_HEIGHT_PX: f64 = 8.0;
/// Fewer triangles say nothing.
const FEWEST_TRIANGLES: u32 = 30;
/// A smaller share of triangles that are large enough says that all points lie on a line.
const LEAST_SHARE: f64 = 0.05;
/// Share of triangles that run the other way from which on the ground is mirrored.
const MIRRORED_SHARE: f64 = 0.8;

/// Whether the image shows a mirror image of the positions; false where the points are too few, or too close to a line
/// for the error of a fix (standard deviation per axis, m), to tell.
#[must_use]
pub fn is_mirrored(points: &[FootPosition], sigma_m: f64) -> bool {
    let Some(centre) = median_position(points.iter().map(|(_, position)| *position)) else { return false };
    let plane = LocalPlane::new(centre);
    let points: Vec<([f64; 2], [f64; 2])> = points
        .iter()
        .filter_map(|([x, y], position)| {
            let ground = plane.to_plane_within_range(*position)?;
            Some(([*x, -y], [ground.east_m, ground.north_m]))
        })
        .collect();
    let (mut all, mut large, mut mirrored) = (0_u32, 0_u32, 0_u32);
    for [a, b, c] in triples(points.len()) {
        all += 1;
        let in_image = Triangle::new([points[a].0, points[b].0, points[c].0]);
        let on_ground = Triangle::new([points[a].1, points[b].1, points[c].1]);
        if in_image.height >= LEAST_HEIGHT_PX && on_ground.height >= LEAST_HEIGHT_SIGMAS * sigma_m {
            large += 1;
            mirrored += u32::from(in_image.is_anticlockwise != on_ground.is_anticlockwise);
        }
    }
    large >= FEWEST_TRIANGLES
        && f64::from(large) >= LEAST_SHARE * f64::from(all)
        && f64::from(mirrored) >= MIRRORED_SHARE * f64::from(large)
}

/// The median of longitudes and of latitudes; `None` for no position.
#[must_use]
pub fn median_position(positions: impl Iterator<Item = Position> + Clone) -> Option<Position> {
    positions.clone().next()?;
    let longitude_deg = median(positions.clone().map(Position::longitude_deg).collect());
    let latitude_deg = median(positions.map(Position::latitude_deg).collect());
    Position::new(longitude_deg, latitude_deg).ok()
}

/// Indices of points that are far apart in the order in which they were recorded.
fn triples(count: usize) -> impl Iterator<Item = [usize; 3]> {
    let steps = [(1, 3, 2, 3), (1, 4, 1, 2), (1, 7, 3, 5), (1, 2, 8, 9)];
    let count_or_one = count.max(1);
    let steps = steps.map(|(a, of_a, b, of_b)| (count * a / of_a, count * b / of_b));
    steps.into_iter().flat_map(move |(second, third)| {
        (0..count).map(move |first| [first, (first + second) % count_or_one, (first + third) % count_or_one])
    })
}

struct Triangle {
    is_anticlockwise: bool,
    /// Height over the longest side.
    height: f64,
}

impl Triangle {
    /// Of corners with x to the right and y up.
    fn new([a, b, c]: [[f64; 2]; 3]) -> Self {
        let side = |from: [f64; 2], to: [f64; 2]| [to[0] - from[0], to[1] - from[1]];
        let length = |[x, y]: [f64; 2]| x.hypot(y);
        let ([ux, uy], [vx, vy]) = (side(a, b), side(a, c));
        let twice_area = ux * vy - uy * vx;
        let longest = length([ux, uy]).max(length([vx, vy])).max(length(side(b, c)));
        Self { is_anticlockwise: twice_area > 0.0, height: twice_area.abs() / longest.max(f64::MIN_POSITIVE) }
    }
}

#[cfg(test)]
mod tests {
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
            height_m in 4.0..20.0_f64, tilt in 0.2..1.2_f64, pan in 0.0..6.28_f64,
            places in proptest::collection::vec((-25.0..25.0_f64, 5.0..60.0_f64), 60..120),
        ) {
            let points = seen(height_m, tilt, pan, &places);
            prop_assert!(!is_mirrored(&points, 1.0));
            prop_assert!(is_mirrored(&swapped(&points), 1.0));
        }

        #[test]
        fn a_line_is_not_taken_for_a_mirror_image(
            pan in 0.0..6.28_f64, noise in proptest::collection::vec((-3.0..3.0_f64, -3.0..3.0_f64), 40..120),
        ) {
            let places: Vec<(f64, f64)> =
                noise.iter().enumerate().map(|(at, _)| (at as f64 * 0.4 - 20.0, 20.0)).collect();
            let mut points = seen(6.0, 0.5, pan, &places);
            let plane = LocalPlane::new(points[0].1);
            for (point, (east_m, north_m)) in points.iter_mut().zip(noise) {
                let moved = plane.to_plane(point.1).plus(EastNorth { east_m, north_m });
                point.1 = plane.to_position(moved);
            }
            prop_assert!(!is_mirrored(&points, 2.0));
            prop_assert!(!is_mirrored(&swapped(&points), 2.0));
        }
    }
}
