//! The local east-north plane in which everything is learnt and fused.

use super::position::{Position, wrap_degrees};

/// Semi-major axis of WGS 84 in metres.
const EQUATORIAL_RADIUS_M: f64 = 6_378_137.0;
/// First eccentricity of WGS 84, squared.
const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_141_316e-3;

/// Metres east and north of the origin of a [`LocalPlane`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EastNorth {
    /// Metres east of the origin.
    pub east_m: f64,
    /// Metres north of the origin.
    pub north_m: f64,
}

impl EastNorth {
    /// Straight distance in metres.
    #[must_use]
    pub fn distance_m(self, other: Self) -> f64 {
        (self.east_m - other.east_m).hypot(self.north_m - other.north_m)
    }

    /// Half the squared distance in m2: the error per axis, the mean over the two axes of (2).
    #[must_use]
    pub fn error_per_axis_m2(self, other: Self) -> f64 {
        let (east, north) = (self.east_m - other.east_m, self.north_m - other.north_m);
        0.5 * (east * east + north * north)
    }
}

/// The plane that touches the ellipsoid at an origin, axes east and north (metres).
///
/// East and north are those of the topocentric (ENU) frame; the ground is taken to be the
/// ellipsoid, so the plane is exact in both directions to better than 1 mm within 20 km. Beyond
/// that positions still go there and back, but a metre in the plane is shorter than on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalPlane {
    origin: Position,
    sin_latitude: f64,
    cos_latitude: f64,
    /// Distance from the polar axis, and height above the equator, of the origin (metres).
    axis_m: f64,
    equator_m: f64,
    /// Radii of curvature at the origin, along the prime vertical and the meridian (metres).
    prime_vertical_m: f64,
    meridian_m: f64,
}

impl LocalPlane {
    /// The plane about an origin.
    #[must_use]
    pub fn new(origin: Position) -> Self {
        let (sin_latitude, cos_latitude) = origin.latitude_deg().to_radians().sin_cos();
        let w2 = 1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude;
        let prime_vertical_m = EQUATORIAL_RADIUS_M / w2.sqrt();
        Self {
            origin,
            sin_latitude,
            cos_latitude,
            axis_m: prime_vertical_m * cos_latitude,
            equator_m: prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) * sin_latitude,
            prime_vertical_m,
            meridian_m: prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) / w2,
        }
    }

    /// Where the plane touches the earth.
    #[must_use]
    pub const fn origin(&self) -> Position {
        self.origin
    }

    /// Metres east and north of the origin.
    #[must_use]
    pub fn to_plane(&self, position: Position) -> EastNorth {
        let (sin_latitude, cos_latitude) = position.latitude_deg().to_radians().sin_cos();
        let prime_vertical_m =
            EQUATORIAL_RADIUS_M / (1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude).sqrt();
        let axis_m = prime_vertical_m * cos_latitude;
        let equator_m = prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) * sin_latitude;
        let turn = wrap_degrees(position.longitude_deg() - self.origin.longitude_deg()).to_radians();
        let (sin_turn, cos_turn) = turn.sin_cos();
        // Earth-centred difference in the frame turned to the origin's meridian, then tilted.
        let outward_m = axis_m * cos_turn - self.axis_m;
        let upward_m = equator_m - self.equator_m;
        EastNorth {
            east_m: axis_m * sin_turn,
            north_m: self.cos_latitude * upward_m - self.sin_latitude * outward_m,
        }
    }

    /// The position on the ellipsoid that lies over a point of the plane.
    #[must_use]
    pub fn to_position(&self, point: EastNorth) -> Position {
        // The drop of the ellipsoid below the plane closes the third coordinate: a fixed point of
        // the ellipsoid's equation, two steps of Newton from the osculating paraboloid.
        let EastNorth { east_m, north_m } = point;
        let mut up_m = -0.5 * (east_m * east_m / self.prime_vertical_m + north_m * north_m / self.meridian_m);
        let polar_squared = 1.0 - ECCENTRICITY_SQUARED;
        let (mut outward_m, mut upward_m) = (0.0, 0.0);
        for _ in 0..2 {
            outward_m = self.axis_m + self.cos_latitude * up_m - self.sin_latitude * north_m;
            upward_m = self.equator_m + self.sin_latitude * up_m + self.cos_latitude * north_m;
            let excess = east_m * east_m + outward_m * outward_m + upward_m * upward_m / polar_squared
                - EQUATORIAL_RADIUS_M * EQUATORIAL_RADIUS_M;
            let slope = 2.0 * (outward_m * self.cos_latitude + upward_m * self.sin_latitude / polar_squared);
            up_m -= excess / slope;
            outward_m = self.axis_m + self.cos_latitude * up_m - self.sin_latitude * north_m;
            upward_m = self.equator_m + self.sin_latitude * up_m + self.cos_latitude * north_m;
        }
        let axis_m = east_m.hypot(outward_m);
        let longitude_deg = self.origin.longitude_deg() + east_m.atan2(outward_m).to_degrees();
        // At height zero tan(latitude) = upward / (axis (1 - e2)), without iteration.
        let latitude_deg = upward_m.atan2(axis_m * polar_squared).to_degrees();
        Position::wrapped(longitude_deg, latitude_deg)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::distance_m;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn there_and_back_within_a_millimetre(
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
    fn the_plane_reaches_across_the_antimeridian() {
        let plane = LocalPlane::new(Position::new(179.9995, 0.0).expect("valid"));
        let point = plane.to_plane(Position::new(-179.9995, 0.0).expect("valid"));
        assert!((point.east_m - 111.32).abs() < 0.01, "{point:?}");
    }
}
