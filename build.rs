//! Compiles `proto/` in pure Rust (protox), so that no `protoc` is needed, and lists the built files of the
//! operator's console for `src/http/resources/console.rs`.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs};

use protox::prost::Message as _;

const FOLDER: &str = "proto";
const FILES: [&str; 14] = [
    "sightfix/v1/values.proto",
    "sightfix/v1/camera_service.proto",
    "sightfix/v1/sample_service.proto",
    "sightfix/v1/training_service.proto",
    "sightfix/v1/model_service.proto",
    "sightfix/v1/fusion_service.proto",
    "sightfix/v1/key_service.proto",
    "sightfix/v1/audit_service.proto",
    "sightfix/v1/site_service.proto",
    "sightfix/v1/place_service.proto",
    "sightfix/v1/track_service.proto",
    "sightfix/v1/evaluation_service.proto",
    "sightfix/v1/history_service.proto",
    "inference/open_inference_grpc.proto",
];

/// Fields that are held by a pointer: what is moved a dozen times on its way out, and what not every row of a batch has.
const BOXED: [&str; 3] =
    ["sightfix.v1.StreamResponse.answer", "sightfix.v1.Sample.fix", "sightfix.v1.Sample.truth"];

/// The folder that `npm run build` in `console/` writes.
const CONSOLE: &str = "console/dist";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed={FOLDER}");
    println!("cargo::rustc-env=BOXED_FIELDS={}", BOXED.join(" "));
    let descriptors = protox::compile(FILES, [FOLDER])?;
    let folder = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(folder.join("sightfix_descriptor.bin"), descriptors.encode_to_vec())?;
    let mut prost = tonic_prost_build::Config::new();
    // A codec finds the description of a message by its name.
    prost.enable_type_names();
    let code =
        tonic_prost_build::configure().bytes(".").codec_path("crate::grpc::bounded_codec::BoundedCodec");
    // A field of a oneof is named by its path there.
    let path = |field: &&str| format!(".{}", field.replace("StreamResponse.", "StreamResponse.kind."));
    BOXED
        .iter()
        .map(path)
        .fold(code, |code, field| code.boxed(field))
        .compile_fds_with_config(descriptors, prost)?;
    fs::write(folder.join("console_assets.rs"), console_assets()?)?;
    Ok(())
}

/// Rust code: every file of the console, with its compressed forms.
fn console_assets() -> Result<String, Box<dyn Error>> {
    println!("cargo::rerun-if-changed={CONSOLE}");
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?).join(CONSOLE);
    let mut files = Vec::new();
    list_files(&root, &mut files)?;
    files.sort();
    let mut code = "static ASSETS: &[Asset] = &[\n".to_owned();
    for file in files.iter().filter(|file| !is_compressed(file)) {
        let path = file.strip_prefix(&root)?.to_string_lossy().replace('\\', "/");
        let compressed = |ending: &str| {
            let name = PathBuf::from(format!("{}.{ending}", file.display()));
            if name.exists() { format!("Some(include_bytes!({name:?}))") } else { "None".to_owned() }
        };
        code += &format!(
            "Asset {{ path: {path:?}, content: include_bytes!({file:?}), gzip: {}, brotli: {} }},\n",
            compressed("gz"),
            compressed("br")
        );
    }
    Ok(code + "];\n")
}

fn list_files(folder: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() { list_files(&path, files)? } else { files.push(path) }
    }
    Ok(())
}

fn is_compressed(file: &Path) -> bool {
    file.extension().is_some_and(|ending| ending == "gz" || ending == "br")
}
