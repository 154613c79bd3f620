//! The one integration test binary: everything from the outside, through real ports and files.

mod bad_input;
mod boxes_without_fix;
mod connections;
mod cross_site;
mod evaluations;
mod few_receivers;
mod gaussian_process;
mod grpc;
mod harness;
mod job_leases;
mod layering;
mod live_client;
mod live_faults;
mod live_saturation;
mod model_integrity;
mod openapi;
mod overload;
mod pairing;
mod parity;
mod power_cut;
mod promotion;
mod replay;
mod simulations;
mod storage;
mod story;
mod stream;
