//! sightfix estimates the positions of targets from the bounding boxes of an uncalibrated fixed camera
//! and from GNSS fixes.
//!
//! This crate has the transports, the use cases, the connections and the command line; what they work with is in the
//! crates below `crates/`, which are re-exported here as modules. `docs/explanation/architecture.md` describes both.

// They panic where the output is closed or its device is full.
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod admission;
pub mod app;
pub mod backoff;
pub mod cli;
pub mod clock;
pub mod config;
pub mod connect;
pub mod doctor;
pub mod grpc;
pub mod http;
pub mod openid;
pub mod operations;
pub mod replay;
pub mod request;
pub mod server;
pub mod shutdown;
pub mod status;
pub mod telemetry;
pub mod tls_client;
pub mod worker;

pub use sightfix_archive as archive;
pub use sightfix_domain::{domain, geo, statistics};
pub use sightfix_evaluation::{self as evaluation, paper_experiments};
pub use sightfix_exchange as exchange;
pub use sightfix_fusion as fusion;
pub use sightfix_model::{self as model, filters};
pub use sightfix_places as places;
pub use sightfix_simulation as simulation;
pub use sightfix_store as store;
