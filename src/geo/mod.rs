//! WGS 84 positions, the local east-north plane of a camera, and geodesic distance.
//!
//! Degrees are in [`Position`], metres in [`EastNorth`]; only a [`LocalPlane`] converts between them.
//! What never happens here: imports from other modules, I/O, f32.

// What clients send reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod plane;
mod plane_covariance;
mod position;

pub use plane::{EastNorth, LocalPlane, PLANE_RANGE_M};
pub use plane_covariance::PlaneCovariance;
pub use position::{Position, PositionError, distance_m};
