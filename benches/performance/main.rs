//! The tables of docs/explanation/performance.md. Every row is a ratio of two things measured in turn in this
//! one run, since machines differ and are shared.
//!
//! `cargo bench` runs all parts; `cargo bench -- fuse http` some of them. The tables are also written to
//! `target/bench.json`; `benches/compare.py` compares two such files.

mod attacks;
mod beside;
mod connections;
mod database;
mod fuse;
mod guarded;
mod import;
mod load;
mod ratio;
mod served;
mod streams;
mod tables;
mod train;
mod transports;
mod world;

/// As in the binary itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() {
    // cargo passes flags of its own, such as --bench.
    let wanted: Vec<String> = std::env::args().skip(1).filter(|part| !part.starts_with('-')).collect();
    let parts: [(&str, fn()); 12] = [
        ("fuse", fuse::run),
        ("http", transports::http),
        ("grpc", transports::grpc),
        ("streams", streams::run),
        ("import", import::run),
        ("train", train::run),
        ("world", world::run),
        ("beside", beside::run),
        ("attacks", attacks::run),
        ("guarded", guarded::run),
        ("database", database::run),
        ("connections", connections::run),
    ];
    for (name, part) in parts {
        if wanted.is_empty() || wanted.iter().any(|wish| wish == name) {
            part();
        }
    }
    tables::write();
}
