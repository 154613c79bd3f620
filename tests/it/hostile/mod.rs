//! Hostile input: numbers at the edges of what is valid, and mutations of valid files and messages.
//!
//! `FUZZ_ITERATIONS=100000 cargo test --test it hostile::` mutates for longer; `fuzz/` has the same targets for
//! cargo-fuzz, which is guided by coverage.

#[path = "../../../fuzz/src/lib.rs"]
#[expect(unreachable_pub, reason = "it is the library of the fuzz targets")]
mod targets;

mod messages;
mod mutations;
mod numbers;
