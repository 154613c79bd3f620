//! The gRPC transport through a real port, by its own generated clients.

mod cameras;
mod fusions;
mod imports;
<<<<<<< HEAD
mod models;
=======
>>>>>>> main
mod server;
