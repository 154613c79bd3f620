//! Holds the floors and the library walls that docs/architecture.md draws.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// A module imports only from modules of a lower number; those of one number do not know each other.
const FLOORS: &[(&str, u32)] = &[
    ("geo", 0),
    ("domain", 1),
    ("clock", 2),
    ("config", 2),
    ("shutdown", 2),
    ("exchange", 2),
    ("store", 2),
    ("filters", 2),
    ("model", 3),
    ("admission", 3),
    ("telemetry", 5),
    ("fusion", 4),
    ("simulation", 4),
    ("evaluation", 5),
    ("app", 6),
    ("paper_experiments", 6),
    ("worker", 7),
    ("status", 7),
    ("http", 8),
    ("grpc", 8),
    ("server", 9),
    ("replay", 9),
    ("cli", 10),
];

/// A library is named only in these modules.
const WALLS: &[(&str, &[&str])] = &[
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
    ("prost", &["grpc"]),
    ("geographiclib_rs", &["geo"]),
    ("nmea", &["exchange"]),
    ("quick_xml", &["exchange"]),
    ("clap", &["cli"]),
    ("indicatif", &["cli"]),
    ("metrics_exporter_prometheus", &["telemetry"]),
];

struct Source {
    path: PathBuf,
    module: String,
    text: String,
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut folders = vec![root.clone()];
    let mut sources = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("src can be read") {
            let path = entry.expect("an entry can be read").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let below = path.strip_prefix(&root).expect("below src");
                let first = below.components().next().expect("a name").as_os_str().to_string_lossy();
                let module = first.trim_end_matches(".rs").to_owned();
                let text = without_tests(&path, fs::read_to_string(&path).expect("source can be read"));
                sources.push(Source { path, module, text });
            }
        }
    }
    sources
}

/// Unit tests may look upwards: a filter is tried on a simulation.
fn without_tests(path: &Path, text: String) -> String {
    if path.components().any(|part| matches!(part.as_os_str().to_str(), Some("tests" | "tests.rs"))) {
        return String::new();
    }
    match text.find("\n#[cfg(test)]\nmod tests {") {
        Some(end) => text[..end].to_owned(),
        None => text,
    }
}

/// Names after `crate::` outside of comments, with their lines.
fn imports(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//")).flat_map(
        |(number, line)| {
            line.match_indices("crate::").map(move |(at, found)| {
                let rest = &line[at + found.len()..];
                let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
                (number + 1, &rest[..end])
            })
        },
    )
}

#[test]
fn every_module_stands_on_a_floor_and_imports_only_from_below() {
    let floors: BTreeMap<_, _> = FLOORS.iter().copied().collect();
    let mut wrong = Vec::new();
    for source in sources() {
        if matches!(source.module.as_str(), "lib" | "main") {
            continue;
        }
        let Some(floor) = floors.get(source.module.as_str()) else {
            wrong.push(format!("{}: the module stands on no floor", source.path.display()));
            continue;
        };
        for (line, name) in imports(&source.text) {
            let Some(below) = floors.get(name) else { continue };
            if name != source.module && below >= floor {
                wrong.push(format!("{}:{line}: {} imports {name}", source.path.display(), source.module));
            }
        }
        if source.text.contains("use crate::{") && source.module != "server" {
            wrong.push(format!("{}: write one `use crate::module` a line", source.path.display()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn each_library_stays_behind_its_wall() {
    let mut wrong = Vec::new();
    for source in sources() {
        for (library, modules) in WALLS {
            let named = source.text.lines().filter(|line| !line.trim_start().starts_with("//")).any(|line| {
                line.match_indices(&format!("{library}::")).any(|(at, _)| {
                    !line[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':')
                })
            });
            if named && !modules.contains(&source.module.as_str()) {
                wrong.push(format!("{}: names {library}", source.path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn statuses_are_written_in_one_place() {
    let allowed = ["status"];
    for source in sources() {
        let named = source.text.lines().filter(|line| !line.trim_start().starts_with("//")).any(|line| {
            line.contains("StatusCode::BAD_REQUEST")
                || line.contains("StatusCode::INTERNAL_SERVER_ERROR")
                || line.contains("Status::internal(")
                || line.contains("Status::invalid_argument(")
                || line.contains("Status::not_found(")
        });
        assert!(!named || allowed.contains(&source.module.as_str()), "{}", source.path.display());
    }
}
