//! The one integration test binary: everything from the outside, through real ports and files.

mod bad_input;
mod connections;
mod evaluations;
mod gaussian_process;
mod grpc;
mod harness;
mod job_leases;
mod layering;
mod model_integrity;
mod openapi;
mod pairing;
mod power_cut;
mod promotion;
mod replay;
mod storage;
mod story;
mod stream;
