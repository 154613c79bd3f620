//! `sightfix replay`: faults of connection and server, and that no acknowledged item is lost.

mod fake;
mod rules;
mod server;
