//! sightfix tells where a target is on the earth from what a fixed camera that nobody calibrated
//! sees and what a GNSS receiver says. `docs/architecture.md` is the map of this crate.

pub mod admission;
pub mod app;
pub mod cli;
pub mod clock;
pub mod config;
pub mod domain;
pub mod evaluation;
pub mod exchange;
pub mod filters;
pub mod fusion;
pub mod geo;
pub mod grpc;
pub mod http;
pub mod model;
pub mod replay;
pub mod server;
pub mod shutdown;
pub mod simulation;
pub mod status;
pub mod store;
pub mod telemetry;
pub mod worker;
