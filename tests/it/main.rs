//! The one integration test binary: everything from the outside, through real ports and files.

mod bad_input;
mod connections;
mod evaluations;
mod grpc;
mod harness;
mod layering;
mod live_client;
mod live_faults;
mod live_saturation;
mod openapi;
mod pairing;
mod replay;
mod story;
mod stream;
