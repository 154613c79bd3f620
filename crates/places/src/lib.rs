//! Places on the ground, and what tracks do there: events with their time, its uncertainty and a probability, and counts.
//!
//! | module | contents |
//! |---|---|
//! | [`settings`] | a place as JSON: geometry, confidence, rules |
//! | `region` | geometry in metres: the probability that a target is inside, and where a track crosses a border |
//! | [`Engine`] | the tracks of one scope through its places |
//! | [`event`] | events, with ids that a replay repeats |
//! | [`statistics`] | counts per interval, and the figures computed from them |
//!
//! The crate does no input or output and reads no clock: time is that of the measurements.

#![warn(missing_docs)]
// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod engine;
pub mod event;
mod geometry;
mod index;
mod normal;
mod passage;
mod region;
pub mod settings;
pub mod statistics;

use sightfix_domain::{domain, geo};

pub use engine::{Engine, Measurement, Outcome};
pub use index::{Place, PlaceIndex};

#[cfg(test)]
mod tests;
