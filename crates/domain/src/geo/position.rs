//! Positions on the WGS 84 ellipsoid, and geodesic distance.

use std::sync::LazyLock;

use geographiclib_rs::{Geodesic, InverseGeodesic};

/// A position on the WGS 84 ellipsoid at height 0, valid by construction: longitude in -180..=180 and
/// latitude in -90..=90, both finite, in degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Position {
    longitude_deg: f64,
    latitude_deg: f64,
}

/// Why two numbers do not form a [`Position`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PositionError {
    /// The longitude is not a finite number of degrees within -180..=180.
    #[error("longitude must be a finite number of degrees from -180 to 180")]
    Longitude,
    /// The latitude is not a finite number of degrees within -90..=90.
    #[error("latitude must be a finite number of degrees from -90 to 90")]
    Latitude,
}

impl Position {
    /// A position from degrees.
    ///
    /// # Errors
    /// Names the coordinate that is not finite or out of range. Longitude 181 and latitude 91, the codes
    /// of AIS for "not available", are therefore refused.
    pub fn new(longitude_deg: f64, latitude_deg: f64) -> Result<Self, PositionError> {
        if !(-180.0..=180.0).contains(&longitude_deg) {
            return Err(PositionError::Longitude);
        }
        if !(-90.0..=90.0).contains(&latitude_deg) {
            return Err(PositionError::Latitude);
        }
        Ok(Self { longitude_deg, latitude_deg })
    }

    /// A computed position: longitude wrapped into -180..=180, latitude clamped to the poles.
    pub(super) fn wrapped(longitude_deg: f64, latitude_deg: f64) -> Self {
        Self { longitude_deg: wrap_degrees(longitude_deg), latitude_deg: latitude_deg.clamp(-90.0, 90.0) }
    }

    /// Degrees east of Greenwich, -180 to 180.
    #[must_use]
    pub const fn longitude_deg(self) -> f64 {
        self.longitude_deg
    }

    /// Degrees north of the equator, -90 to 90.
    #[must_use]
    pub const fn latitude_deg(self) -> f64 {
        self.latitude_deg
    }

    /// The position with longitude and latitude swapped; `None` where that is none.
    #[must_use]
    pub fn swapped(self) -> Option<Self> {
        Self::new(self.latitude_deg, self.longitude_deg).ok()
    }

    /// True if the position is near a place only when it is swapped; near is within half a degree of both, which is
    /// farther than a camera sees.
    #[must_use]
    pub fn is_swapped_at(self, place: Self) -> bool {
        const NEAR_DEG: f64 = 0.5;
        let is_near = |position: Self| {
            (position.latitude_deg - place.latitude_deg).abs() <= NEAR_DEG
                && wrap_degrees(position.longitude_deg - place.longitude_deg).abs() <= NEAR_DEG
        };
        !is_near(self) && self.swapped().is_some_and(is_near)
    }
}

/// Wraps degrees into -180..=180, so that differences are correct across the antimeridian.
pub(super) fn wrap_degrees(degrees: f64) -> f64 {
    if (-180.0..=180.0).contains(&degrees) { degrees } else { (degrees + 180.0).rem_euclid(360.0) - 180.0 }
}

/// Length of the geodesic between two positions on WGS 84, m (Karney 2013).
#[must_use]
pub fn distance_m(from: Position, to: Position) -> f64 {
    static WGS84: LazyLock<Geodesic> = LazyLock::new(Geodesic::wgs84);
    WGS84.inverse(from.latitude_deg, from.longitude_deg, to.latitude_deg, to.longitude_deg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_for_unavailable_positions_are_refused() {
        assert_eq!(Position::new(181.0, 0.0), Err(PositionError::Longitude));
        assert_eq!(Position::new(0.0, 91.0), Err(PositionError::Latitude));
        assert_eq!(Position::new(f64::NAN, 0.0), Err(PositionError::Longitude));
        assert_eq!(Position::new(0.0, f64::INFINITY), Err(PositionError::Latitude));
    }

    #[test]
    fn distance_across_the_antimeridian_is_the_short_one() {
        let west = Position::new(-179.9995, 10.0).expect("valid");
        let east = Position::new(179.9995, 10.0).expect("valid");
        let metres = distance_m(west, east);
        assert!((metres - 109.64).abs() < 0.05, "{metres}");
    }
}
