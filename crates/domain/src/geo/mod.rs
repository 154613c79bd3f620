//! WGS 84 positions, the local east-north plane of a camera, and geodesic distance.
//!
//! Degrees are in [`Position`], metres in [`EastNorth`]; only a [`LocalPlane`] converts between them.
//! What never happens here: imports from other modules, I/O, f32.

// What clients send reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod plane;
mod plane_covariance;
mod position;

pub(crate) use plane::{ECCENTRICITY_SQUARED, EQUATORIAL_RADIUS_M};
pub use plane::{EastNorth, LocalPlane, PLANE_RANGE_M};
pub use plane_covariance::PlaneCovariance;
pub(crate) use plane_covariance::R95_BY_RATIO;
pub use position::{Position, PositionError, distance_m};
