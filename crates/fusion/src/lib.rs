//! Positions from boxes and GNSS fixes: pure functions and values.
//!
//! | module | contents |
//! |---|---|
//! | [`observed`] | a box that went through the model once, and a fix, as measured positions |
//! | [`two_step`] | confidences (6) (7) and the fusion of one box with one fix (8) |
//! | [`pairing`] | which fix belongs to which box, by the times of both |
//! | [`clock_offset`] | the offset between a receiver's clock and the camera's |
//! | [`clock_estimate`] | how late a clock is, and from where on that is no chance |
//! | [`association`] | which box shows the carrier of which receiver, where boxes have only the ids of a tracker |
//! | [`track`], [`target_track`] | the filtered path of one target in one camera |
//! | [`smoother`] | the paths of finished tracks |
//! | [`frame_assembler`], [`world`] | frames of several cameras, and the tracks of a site through all of them |
//! | [`drift_detector`] | alarms when a camera was moved |
//!
//! `examples/train_and_fuse.rs` trains a model and fuses a box without a server.
//!
//! Nothing here does input or output, reads a clock, or takes memory that an outside client decides. Randomness is
//! handed in.

#![warn(missing_docs)]
// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

pub mod association;
pub mod clock_drift;
pub mod clock_estimate;
pub mod clock_offset;
pub mod drift_detector;
pub mod frame_assembler;
pub mod observed;
pub mod pairing;
pub mod smoother;
pub mod target_track;
pub mod track;
pub mod two_step;
pub mod world;

use sightfix_domain::{domain, geo, statistics};
use sightfix_model as model;
#[cfg(test)]
use sightfix_simulation as simulation;
