//! Measured positions, confidences, two-step fusion, association, pairing, tracks and drift detection: pure functions and
//! values.
//!
//! What never happens here: I/O, clocks, randomness, allocation that an outside client decides.

pub mod association;
pub mod clock_offset;
pub mod drift_detector;
pub mod observed;
pub mod pairing;
pub mod target_track;
pub mod track;
pub mod two_step;
