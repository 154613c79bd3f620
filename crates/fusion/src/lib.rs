//! Measured positions, confidences, two-step fusion, association, pairing, tracks, world tracks and drift detection: pure functions and
//! values.
//!
//! What never happens here: I/O, clocks, randomness, allocation that an outside client decides.

// What clients send reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

pub mod association;
pub mod clock_offset;
pub mod drift_detector;
pub mod frame_assembler;
pub mod observed;
pub mod pairing;
pub mod target_track;
pub mod track;
pub mod two_step;
pub mod world;
