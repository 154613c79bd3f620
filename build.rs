//! Compiles `proto/` in pure Rust (protox), so that no `protoc` is needed.

use std::error::Error;
use std::path::PathBuf;
use std::{env, fs};

use protox::prost::Message as _;

const FOLDER: &str = "proto";
const FILES: [&str; 8] = [
    "sightfix/v1/values.proto",
    "sightfix/v1/camera_service.proto",
    "sightfix/v1/sample_service.proto",
    "sightfix/v1/training_service.proto",
    "sightfix/v1/model_service.proto",
    "sightfix/v1/fusion_service.proto",
    "sightfix/v1/key_service.proto",
    "sightfix/v1/audit_service.proto",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed={FOLDER}");
    // `sqlx::migrate!` does not notice new files by itself.
    println!("cargo::rerun-if-changed=migrations");
    let descriptors = protox::compile(FILES, [FOLDER])?;
    let folder = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(folder.join("sightfix_descriptor.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        .bytes(".sightfix.v1")
        // Half a kilobyte that would be moved a dozen times on its way out.
        .boxed(".sightfix.v1.StreamResponse.kind.answer")
        .compile_fds(descriptors)?;
    Ok(())
}
