//! Confidences, two-step fusion, pairing and tracks: pure functions and values.
//!
//! What never happens here: I/O, clocks, randomness, allocation that an outside client decides.

pub mod two_step;
