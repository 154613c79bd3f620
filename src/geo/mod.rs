//! WGS 84 positions, the local east-north plane of a camera, and geodesic distance.
//!
//! What never happens here: nothing above this floor is known, no I/O, no f32.
//! Degrees live in [`Position`], metres in [`EastNorth`]; the only way between them is a
//! [`LocalPlane`].

mod plane;
mod position;

pub use plane::{EastNorth, LocalPlane, PLANE_RANGE_M};
pub use position::{Position, PositionError, distance_m};
