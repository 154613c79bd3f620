//! WGS 84 positions, the local east-north plane of a camera, and geodesic distance.
//!
//! Degrees are in [`Position`], metres in [`EastNorth`]; only a [`LocalPlane`] converts between them.
//! All numbers are f64.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod outline;
mod plane;
mod plane_covariance;
mod position;

pub use outline::{Outline, is_inside};
pub use plane::{
    ECCENTRICITY_SQUARED, EQUATORIAL_RADIUS_M, EastNorth, LocalPlane, PLANE_RANGE_M, PlaneConstants,
};
pub use plane_covariance::{PlaneCovariance, R95_BY_RATIO};
pub use position::{Position, PositionError, distance_m};

/// Metres per degree at the equator, where a few tenths of a percent do not matter.
pub const METRES_PER_DEGREE: f64 = 111_320.0;
