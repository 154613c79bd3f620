//! The local east-north plane in which models are trained and positions are fused.

use super::position::{Position, wrap_degrees};

/// Semi-major axis of WGS 84 in metres.
pub const EQUATORIAL_RADIUS_M: f64 = 6_378_137.0;
/// First eccentricity of WGS 84, squared.
pub const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_141_316e-3;

/// Largest distance from the origin, m, at which a [`LocalPlane`] is used. Up to here the plane is exact
/// to 1 mm in both directions; beyond it nothing that a ground camera sees is measured.
pub const PLANE_RANGE_M: f64 = 20_000.0;

/// Metres east and north of the origin of a [`LocalPlane`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EastNorth {
    /// Metres east of the origin.
    pub east_m: f64,
    /// Metres north of the origin.
    pub north_m: f64,
}

impl EastNorth {
    /// The sum, m.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self { east_m: self.east_m + other.east_m, north_m: self.north_m + other.north_m }
    }

    /// This less another one, m.
    #[must_use]
    pub fn minus(self, other: Self) -> Self {
        Self { east_m: self.east_m - other.east_m, north_m: self.north_m - other.north_m }
    }

    /// Euclidean distance, m.
    #[must_use]
    pub fn distance_m(self, other: Self) -> f64 {
        // Squared, here and below: `hypot` guards against overflow that cannot matter here, and an answer takes several.
        let (east_m, north_m) = (self.east_m - other.east_m, self.north_m - other.north_m);
        (east_m * east_m + north_m * north_m).sqrt()
    }

    /// True if the point lies within [`PLANE_RANGE_M`] of the origin; false if it is not finite.
    #[must_use]
    pub fn is_within_range(self) -> bool {
        self.east_m * self.east_m + self.north_m * self.north_m <= PLANE_RANGE_M * PLANE_RANGE_M
    }

    /// Half the squared distance, m2: the mean squared error over the two axes, as in (2).
    #[must_use]
    pub fn error_per_axis_m2(self, other: Self) -> f64 {
        let (east, north) = (self.east_m - other.east_m, self.north_m - other.north_m);
        0.5 * (east * east + north * north)
    }
}

/// The tangent plane of the ellipsoid at an origin, axes east and north (m) of the topocentric (ENU)
/// frame.
///
/// Positions are on the ellipsoid (height 0). The round trip is exact to better than 1 mm within 20 km;
/// farther away it still works, but distances in the plane are shorter than on the ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalPlane {
    origin: Position,
    constants: PlaneConstants,
}

/// The constants of a [`LocalPlane`], for those who write its conversions in another language.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneConstants {
    /// Sine of the origin's latitude.
    pub sin_latitude: f64,
    /// Cosine of the origin's latitude.
    pub cos_latitude: f64,
    /// Distance of the origin from the polar axis, m.
    pub axis_m: f64,
    /// Distance of the origin from the equatorial plane, m, negative in the south.
    pub equator_m: f64,
    /// Radius of curvature in the prime vertical at the origin, m.
    pub prime_vertical_m: f64,
    /// Radius of curvature in the meridian at the origin, m.
    pub meridian_m: f64,
}

impl LocalPlane {
    /// The plane with that origin.
    #[must_use]
    pub fn new(origin: Position) -> Self {
        let (sin_latitude, cos_latitude) = origin.latitude_deg().to_radians().sin_cos();
        let w2 = 1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude;
        let prime_vertical_m = EQUATORIAL_RADIUS_M / w2.sqrt();
        let constants = PlaneConstants {
            sin_latitude,
            cos_latitude,
            axis_m: prime_vertical_m * cos_latitude,
            equator_m: prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) * sin_latitude,
            prime_vertical_m,
            meridian_m: prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) / w2,
        };
        Self { origin, constants }
    }

    /// The point of tangency.
    #[must_use]
    pub const fn origin(&self) -> Position {
        self.origin
    }

    /// Returns the constants of the conversions.
    #[must_use]
    pub const fn constants(&self) -> &PlaneConstants {
        &self.constants
    }

    /// Metres east and north of the origin.
    #[must_use]
    pub fn to_plane(&self, position: Position) -> EastNorth {
        self.topocentric(position).0
    }

    /// Metres east and north of the origin; `None` for a position beyond [`PLANE_RANGE_M`] of it, by the
    /// chord through the earth. Beyond a quarter of the earth [`Self::to_plane`] folds back towards the
    /// origin, so its distance in the plane does not tell.
    #[must_use]
    pub fn to_plane_within_range(&self, position: Position) -> Option<EastNorth> {
        let (point, up_m) = self.topocentric(position);
        let chord_m2 = point.east_m * point.east_m + point.north_m * point.north_m + up_m * up_m;
        (chord_m2 <= PLANE_RANGE_M * PLANE_RANGE_M).then_some(point)
    }

    /// East and north, and up along the normal at the origin, of a position on the ellipsoid, m.
    fn topocentric(&self, position: Position) -> (EastNorth, f64) {
        let (sin_latitude, cos_latitude) = position.latitude_deg().to_radians().sin_cos();
        let prime_vertical_m =
            EQUATORIAL_RADIUS_M / (1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude).sqrt();
        let axis_m = prime_vertical_m * cos_latitude;
        let equator_m = prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) * sin_latitude;
        let origin = &self.constants;
        let longitude_rad = wrap_degrees(position.longitude_deg() - self.origin.longitude_deg()).to_radians();
        let (sin_longitude, cos_longitude) = longitude_rad.sin_cos();
        // Earth-centred difference, rotated about the polar axis to the origin's meridian, then by latitude.
        let outward_m = axis_m * cos_longitude - origin.axis_m;
        let upward_m = equator_m - origin.equator_m;
        let point = EastNorth {
            east_m: axis_m * sin_longitude,
            north_m: origin.cos_latitude * upward_m - origin.sin_latitude * outward_m,
        };
        (point, origin.cos_latitude * outward_m + origin.sin_latitude * upward_m)
    }

    /// The position on the ellipsoid vertically below a point of the plane.
    #[must_use]
    pub fn to_position(&self, point: EastNorth) -> Position {
        // The third coordinate is the distance of the ellipsoid from the plane: two Newton steps on the
        // ellipsoid's equation, starting from the osculating paraboloid.
        let EastNorth { east_m, north_m } = point;
        let origin = &self.constants;
        let mut up_m =
            -0.5 * (east_m * east_m / origin.prime_vertical_m + north_m * north_m / origin.meridian_m);
        let polar_squared = 1.0 - ECCENTRICITY_SQUARED;
        let (mut outward_m, mut upward_m) = (0.0, 0.0);
        for _ in 0..2 {
            outward_m = origin.axis_m + origin.cos_latitude * up_m - origin.sin_latitude * north_m;
            upward_m = origin.equator_m + origin.sin_latitude * up_m + origin.cos_latitude * north_m;
            let excess = east_m * east_m + outward_m * outward_m + upward_m * upward_m / polar_squared
                - EQUATORIAL_RADIUS_M * EQUATORIAL_RADIUS_M;
            let derivative =
                2.0 * (outward_m * origin.cos_latitude + upward_m * origin.sin_latitude / polar_squared);
            up_m -= excess / derivative;
            outward_m = origin.axis_m + origin.cos_latitude * up_m - origin.sin_latitude * north_m;
            upward_m = origin.equator_m + origin.sin_latitude * up_m + origin.cos_latitude * north_m;
        }
        let axis_m = (east_m * east_m + outward_m * outward_m).sqrt();
        // At height zero tan(latitude) = upward / (axis (1 - e2)), without iteration; turned by the origin's latitude, so that
        // the angle is small.
        let (sine, cosine) = (upward_m, axis_m * polar_squared);
        let turned_sine = sine * origin.cos_latitude - cosine * origin.sin_latitude;
        let turned_cosine = cosine * origin.cos_latitude + sine * origin.sin_latitude;
        Position::wrapped(
            self.origin.longitude_deg() + small_angle(east_m, outward_m).to_degrees(),
            self.origin.latitude_deg() + small_angle(turned_sine, turned_cosine).to_degrees(),
        )
    }
}

/// `atan2(sine, cosine)`, rad, which is small for all points near a plane's origin: there by the series up to the seventh
/// power, exact to the last place and in a fraction of the time.
#[inline]
fn small_angle(sine: f64, cosine: f64) -> f64 {
    let tangent = sine / cosine;
    if cosine > 0.0 && tangent.abs() < 0.01 {
        let square = tangent * tangent;
        tangent * (1.0 - square * (1.0 / 3.0 - square * (1.0 / 5.0 - square / 7.0)))
    } else {
        sine.atan2(cosine)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::distance_m;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_round_trip_is_exact_to_a_millimetre(
            longitude in -180.0..180.0f64, latitude in -89.0..89.0f64,
            east_m in -20_000.0..20_000.0f64, north_m in -20_000.0..20_000.0f64,
        ) {
            let plane = LocalPlane::new(Position::new(longitude, latitude).expect("valid"));
            let point = EastNorth { east_m, north_m };
            let back = plane.to_plane(plane.to_position(point));
            prop_assert!(back.distance_m(point) < 1e-3, "{back:?} {point:?}");
        }

        #[test]
        fn the_plane_agrees_with_the_geodesic(
            longitude in -180.0..180.0f64, latitude in -85.0..85.0f64,
            east_m in -2_000.0..2_000.0f64, north_m in -2_000.0..2_000.0f64,
        ) {
            let origin = Position::new(longitude, latitude).expect("valid");
            let plane = LocalPlane::new(origin);
            let point = EastNorth { east_m, north_m };
            let straight_m = east_m.hypot(north_m);
            let geodesic_m = distance_m(origin, plane.to_position(point));
            prop_assert!((geodesic_m - straight_m).abs() < 1e-3 + 1e-6 * straight_m,
                "{geodesic_m} {straight_m}");
        }
    }

    #[test]
    fn positions_beyond_the_range_are_not_projected() {
        let plane = LocalPlane::new(Position::new(103.9, 30.6).expect("valid"));
        let at = |longitude, latitude| {
            plane.to_plane_within_range(Position::new(longitude, latitude).expect("valid"))
        };
        assert!(at(103.9, 30.77).is_some_and(|point| (point.north_m - 18_848.0).abs() < 20.0));
        // Null island, the hemisphere across, the antipode (which projects onto the origin), a pole,
        // swapped signs.
        for (longitude, latitude) in
            [(0.0, 0.0), (103.9, -30.6), (-76.1, -30.6), (0.0, 90.0), (-103.9, 30.6), (103.9, 30.79)]
        {
            assert_eq!(at(longitude, latitude), None, "{longitude} {latitude}");
        }
        assert!(!EastNorth { east_m: f64::NAN, north_m: 0.0 }.is_within_range());
        assert!(!EastNorth { east_m: f64::INFINITY, north_m: 0.0 }.is_within_range());
    }

    #[test]
    fn the_plane_crosses_the_antimeridian() {
        let plane = LocalPlane::new(Position::new(179.9995, 0.0).expect("valid"));
        let point = plane.to_plane(Position::new(-179.9995, 0.0).expect("valid"));
        assert!((point.east_m - 111.32).abs() < 0.01, "{point:?}");
    }
}
