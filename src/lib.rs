//! sightfix estimates the positions of targets from the bounding boxes of an uncalibrated fixed camera
//! and from GNSS fixes. `docs/architecture.md` describes the structure of this crate.

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
pub mod domain;
pub mod evaluation;
pub mod exchange;
pub mod filters;
pub mod fusion;
pub mod geo;
pub mod grpc;
pub mod http;
pub mod model;
pub mod openid;
pub mod paper_experiments;
pub mod replay;
pub mod server;
pub mod shutdown;
pub mod simulation;
pub mod statistics;
pub mod status;
pub mod store;
pub mod telemetry;
pub mod tls_client;
pub mod worker;
