//! The one integration test binary: everything from the outside, through real ports and files.

mod grpc;
mod layering;
