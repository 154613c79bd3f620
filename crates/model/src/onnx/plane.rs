//! The conversions of `geo::LocalPlane`, and the covariance with a stated 95 % radius.

use super::expression::Expr;
use crate::geo::{ECCENTRICITY_SQUARED, EQUATORIAL_RADIUS_M, LocalPlane, R95_BY_RATIO};

/// Terms of the series of the arc tangent of a sixteenth of an angle, which is at most 0.199: the first term that is
/// left out is below 1e-17.
const ARC_TANGENT_TERMS: i32 = 11;

/// Longitude and latitude (degrees) of points east and north of the origin, m: `LocalPlane::to_position`.
pub(crate) fn to_position<'g>(plane: &LocalPlane, [east_m, north_m]: [Expr<'g>; 2]) -> [Expr<'g>; 2] {
    let constants = plane.constants();
    let polar_squared = 1.0 - ECCENTRICITY_SQUARED;
    let outward =
        |up_m: Expr<'g>| constants.axis_m + up_m * constants.cos_latitude - north_m * constants.sin_latitude;
    let upward = |up_m: Expr<'g>| {
        constants.equator_m + up_m * constants.sin_latitude + north_m * constants.cos_latitude
    };
    let mut up_m =
        (east_m.square() / constants.prime_vertical_m + north_m.square() / constants.meridian_m) * -0.5;
    for _ in 0..2 {
        let (outward_m, upward_m) = (outward(up_m), upward(up_m));
        let excess = east_m.square() + outward_m.square() + upward_m.square() / polar_squared
            - EQUATORIAL_RADIUS_M * EQUATORIAL_RADIUS_M;
        let derivative =
            (outward_m * constants.cos_latitude + upward_m * (constants.sin_latitude / polar_squared)) * 2.0;
        up_m = up_m - excess / derivative;
    }
    let (outward_m, upward_m) = (outward(up_m), upward(up_m));
    let axis_m = (east_m.square() + outward_m.square()).sqrt();
    let longitude_deg = arc_tangent_deg(east_m, outward_m) + plane.origin().longitude_deg();
    [longitude_deg, arc_tangent_deg(upward_m, axis_m * polar_squared)]
}

/// East and north of the origin, m, of longitudes given from the origin and latitudes, degrees: `LocalPlane::to_plane`.
pub(crate) fn to_plane<'g>(plane: &LocalPlane, east_deg: Expr<'g>, latitude_deg: Expr<'g>) -> [Expr<'g>; 2] {
    let constants = plane.constants();
    let radians = |degrees: Expr<'g>| degrees * 1.0_f64.to_radians();
    let (sin_latitude, cos_latitude) = (radians(latitude_deg).sin(), radians(latitude_deg).cos());
    let prime_vertical_m = EQUATORIAL_RADIUS_M / (1.0 - sin_latitude.square() * ECCENTRICITY_SQUARED).sqrt();
    let axis_m = prime_vertical_m * cos_latitude;
    let equator_m = prime_vertical_m * sin_latitude * (1.0 - ECCENTRICITY_SQUARED);
    let outward_m = axis_m * radians(east_deg).cos() - constants.axis_m;
    let upward_m = equator_m - constants.equator_m;
    [axis_m * radians(east_deg).sin(), upward_m * constants.cos_latitude - outward_m * constants.sin_latitude]
}

/// Longitudes wrapped into -180 to 180 degrees.
pub(crate) fn wrapped(longitude_deg: Expr<'_>) -> Expr<'_> {
    let lower = longitude_deg.exceeds(180.0).choose(longitude_deg - 360.0, longitude_deg);
    (-180.0 - lower).exceeds(0.0).choose(lower + 360.0, lower)
}

/// The angle of (x, y) against the x axis, degrees. Not all runtimes have an arc tangent of float64, so the angle is
/// halved four times and its series summed.
fn arc_tangent_deg<'g>(y: Expr<'g>, x: Expr<'g>) -> Expr<'g> {
    let half = |tangent: Expr<'g>| tangent / ((tangent.square() + 1.0).sqrt() + 1.0);
    let tangent = y / ((x.square() + y.square()).sqrt() + x);
    let tangent = half(half(half(tangent)));
    let square = tangent.square();
    let coefficient = |term: i32| (if term % 2 == 0 { 1.0 } else { -1.0 }) / f64::from(2 * term + 1);
    let last = square * coefficient(ARC_TANGENT_TERMS - 1);
    let series = (0..ARC_TANGENT_TERMS - 1).rev().fold(last, |sum, term| {
        let sum = sum + coefficient(term);
        if term == 0 { sum } else { sum * square }
    });
    tangent * series * (16.0_f64).to_degrees()
}

/// `PlaneCovariance::r95_m` of east, cross and north, m2.
pub(crate) fn r95_m<'g>([east_m2, cross_m2, north_m2]: [Expr<'g>; 3]) -> Expr<'g> {
    let mean_m2 = (east_m2 + north_m2) * 0.5;
    let half_difference = (((east_m2 - north_m2) * 0.5).square() + cross_m2.square()).sqrt();
    let major_m2 = mean_m2 + half_difference;
    let ratio = ((mean_m2 - half_difference).positive() / major_m2).sqrt();
    piecewise_linear(ratio * (R95_BY_RATIO.len() - 1) as f64, &R95_BY_RATIO) * major_m2.sqrt()
}

/// The values at the knots 0, 1, 2 ..., linear between them.
pub(crate) fn piecewise_linear<'g>(at: Expr<'g>, values: &[f64]) -> Expr<'g> {
    let slope = |knot: usize| values[knot + 1] - values[knot];
    (1..values.len() - 1).fold(at * slope(0) + values[0], |sum, knot| {
        sum + (at - knot as f64).positive() * (slope(knot) - slope(knot - 1))
    })
}
