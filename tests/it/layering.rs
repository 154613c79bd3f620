//! Checks the layers and library boundaries of docs/architecture.md on the source text.

mod imports;

use std::collections::BTreeMap;

use self::imports::{SourceFile, circle, imports_within_modules, source_files};

/// The layer of each module. A module imports only from modules of lower layers.
const LAYERS: &[(&str, u32)] = &[
    ("geo", 0),
    ("statistics", 0),
    ("domain", 1),
    ("backoff", 2),
    ("clock", 2),
    ("config", 2),
    ("shutdown", 2),
    ("tls_client", 2),
    ("exchange", 2),
    ("store", 2),
    ("filters", 2),
    ("model", 3),
    ("admission", 3),
    ("openid", 3),
    ("telemetry", 5),
    ("fusion", 4),
    ("simulation", 4),
    ("evaluation", 5),
    ("app", 6),
    ("paper_experiments", 6),
    ("worker", 7),
    ("connect", 7),
    ("status", 7),
    ("http", 8),
    ("grpc", 8),
    ("server", 9),
    ("replay", 9),
    ("doctor", 9),
    ("cli", 10),
];

/// The modules that may use a library.
const LIBRARIES: &[(&str, &[&str])] = &[
    ("candle_core", &["model"]),
    ("candle_nn", &["model"]),
    ("sqlx", &["store"]),
    ("axum", &["http", "server"]),
    ("utoipa_axum", &["http"]),
    ("utoipa_swagger_ui", &["http"]),
    ("tonic", &["grpc"]),
    ("tonic_types", &["grpc"]),
    ("tonic_health", &["grpc"]),
    ("tonic_reflection", &["grpc"]),
    ("prost", &["grpc", "model"]),
    ("geographiclib_rs", &["geo"]),
    ("nmea", &["exchange"]),
    ("quick_xml", &["exchange"]),
    ("rustls", &["connect", "openid", "server", "tls_client"]),
    ("tokio_rustls", &["connect", "openid", "server"]),
    ("rustls_native_certs", &["tls_client"]),
    ("ring", &["openid"]),
    ("rumqttc", &["connect"]),
    ("rskafka", &["connect"]),
    ("hmac", &["connect"]),
    ("clap", &["cli"]),
    ("clap_complete", &["cli"]),
    ("clap_mangen", &["cli"]),
    ("flate2", &["cli"]),
    ("zstd", &["cli"]),
    ("indicatif", &["cli"]),
    ("metrics_exporter_prometheus", &["telemetry"]),
];

/// Whether a text uses a library by the path `library::`.
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
    for SourceFile { path, text, module } in &source_files() {
        let module = module.first().map_or("", String::as_str);
        if matches!(module, "lib" | "main") {
            continue;
        }
        let path = path.display();
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
fn the_files_of_a_module_import_each_other_without_circles() {
    let files = source_files();
    let imports = imports_within_modules(&files);
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
    for file in source_files() {
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
    for file in source_files() {
        let names_status = STATUSES.iter().any(|status| file.text.contains(status));
        assert!(!names_status || file.top_level() == "status", "{}", file.path.display());
    }
}
