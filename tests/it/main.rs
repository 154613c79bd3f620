//! The one integration test binary: everything from the outside, through real ports and files.

mod bad_input;
mod connections;
mod evaluations;
mod grpc;
mod harness;
mod layering;
mod openapi;
mod pairing;
mod power_cut;
mod replay;
mod storage;
mod story;
mod stream;
