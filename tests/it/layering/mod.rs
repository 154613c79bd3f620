//! Checks on the source text what the compiler does not: the layers of the modules in `src` and their libraries, and
//! that no files of a crate import each other in a circle. The order of the crates is in their manifests.

mod imports;

use std::collections::BTreeMap;

use self::imports::{circle, files_of_all_crates, files_of_src, imports_within_crates};

/// The layer of each module in `src`, above all crates. A module imports only from modules of lower layers.
const LAYERS: &[(&str, u32)] = &[
    ("backoff", 2),
    ("clock", 2),
    ("config", 2),
    ("shutdown", 2),
    ("tls_client", 2),
    ("admission", 3),
    ("openid", 3),
    ("telemetry", 5),
    ("app", 6),
    ("worker", 7),
    ("connect", 7),
    ("operations", 7),
    ("request", 7),
    ("status", 7),
    ("http", 8),
    ("grpc", 8),
    ("server", 9),
    ("replay", 9),
    ("doctor", 9),
    ("cli", 10),
];

/// The modules in `src` that may use a library.
const LIBRARIES: &[(&str, &[&str])] = &[
    ("axum", &["http", "server"]),
    ("utoipa_axum", &["http"]),
    ("utoipa_swagger_ui", &["http"]),
    ("tonic", &["grpc"]),
    ("tonic_types", &["grpc"]),
    ("tonic_health", &["grpc"]),
    ("tonic_reflection", &["grpc"]),
    ("prost", &["grpc"]),
    ("rustls", &["connect", "openid", "server", "tls_client"]),
    ("tokio_rustls", &["connect", "openid", "server"]),
    ("rustls_native_certs", &["tls_client"]),
    ("ring", &["openid"]),
    ("rumqttc", &["connect"]),
    ("rsasl", &["connect"]),
    ("rtsp_types", &["connect"]),
    ("http_auth", &["connect"]),
    ("crc32c", &["connect"]),
    ("lz4_flex", &["connect"]),
    ("snap", &["connect"]),
    ("hmac", &["connect"]),
    ("clap", &["cli"]),
    ("clap_complete", &["cli"]),
    ("clap_mangen", &["cli"]),
    ("flate2", &["cli", "connect"]),
    ("zstd", &["cli", "connect"]),
    ("indicatif", &["cli"]),
    ("metrics_exporter_prometheus", &["telemetry"]),
];

/// True if a text uses a library by the path `library::`.
fn uses(text: &str, library: &str) -> bool {
    text.match_indices(&format!("{library}::"))
        .any(|(at, _)| !text[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':'))
}

/// Names after `crate::`, with their lines.
fn imported_modules(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().flat_map(|(number, line)| {
        line.match_indices("crate::").map(move |(at, found)| {
            let rest = &line[at + found.len()..];
            let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
            (number + 1, &rest[..end])
        })
    })
}

#[test]
fn every_module_has_a_layer_and_imports_only_from_lower_ones() {
    let layers: BTreeMap<_, _> = LAYERS.iter().copied().collect();
    let mut wrong = Vec::new();
    for file in &files_of_src() {
        let (text, module, path) = (&file.text, file.top_level(), file.path.display());
        if matches!(module, "" | "main") {
            continue;
        }
        let Some(layer) = layers.get(module) else {
            wrong.push(format!("{path}: the module has no layer"));
            continue;
        };
        for (line, name) in imported_modules(text) {
            let Some(imported) = layers.get(name) else { continue };
            if name != module && imported >= layer {
                wrong.push(format!("{path}:{line}: {module} imports {name}"));
            }
        }
        if text.contains("use crate::{") && module != "server" {
            wrong.push(format!("{path}: write one `use crate::module` a line"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_files_of_a_crate_import_each_other_without_circles() {
    let files = files_of_all_crates();
    let imports = imports_within_crates(&files);
    // The parser is of use only if it finds imports at all.
    let count: usize = imports.iter().map(|imports| imports.len()).sum();
    assert!(count > files.len(), "{count} imports of {} files", files.len());
    let circle = circle(&imports).map(|circle| {
        let names: Vec<String> =
            circle.iter().map(|index| files[*index].path.display().to_string()).collect();
        names.join(" -> ")
    });
    assert_eq!(circle, None);
}

#[test]
fn each_library_is_used_only_by_its_modules() {
    let mut wrong = Vec::new();
    for file in files_of_src() {
        for (library, modules) in LIBRARIES {
            if uses(&file.text, library) && !modules.contains(&file.top_level()) {
                wrong.push(format!("{}: uses {library}", file.path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn statuses_are_defined_in_one_place() {
    const STATUSES: [&str; 5] = [
        "StatusCode::BAD_REQUEST",
        "StatusCode::INTERNAL_SERVER_ERROR",
        "Status::internal(",
        "Status::invalid_argument(",
        "Status::not_found(",
    ];
    for file in files_of_src() {
        let names_status = STATUSES.iter().any(|status| file.text.contains(status));
        assert!(!names_status || file.top_level() == "status", "{}", file.path.display());
    }
}
