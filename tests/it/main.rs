//! The one integration test binary: everything from the outside, through real ports and files.

mod bad_input;
mod connections;
mod cross_site;
mod evaluations;
mod grpc;
mod harness;
mod layering;
mod openapi;
mod overload;
mod pairing;
mod parity;
mod replay;
mod story;
mod stream;
