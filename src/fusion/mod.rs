//! Measured positions, confidences, two-step fusion, pairing and tracks: pure functions and values.
//!
//! What never happens here: I/O, clocks, randomness, allocation that an outside client decides.

pub mod clock_offset;
pub mod observed;
pub mod pairing;
mod plane_covariance;
pub mod target_track;
pub mod track;
pub mod two_step;
pub mod watch;

pub use plane_covariance::PlaneCovariance;
