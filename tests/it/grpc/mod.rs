//! The gRPC transport through a real port, by its own generated clients.

mod cameras;
mod fusions;
mod imports;
mod models;
mod server;
