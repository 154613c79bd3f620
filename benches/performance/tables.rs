//! The tables of a run: printed as Markdown while it lasts, written as JSON at its end for `benches/compare.py`.

use std::fmt::Display;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use serde_json::{Value, json};

/// The tables so far, each with its title, its columns and its rows.
static TABLES: Mutex<Vec<Value>> = Mutex::new(Vec::new());

/// Begins a table; the first column has the names of the rows.
pub(crate) fn head(title: &str, columns: &[&str]) {
    let line = "---:|".repeat(columns.len() - 1);
    println!("\n### {title}\n\n| {} |\n|---|{line}", columns.join(" | "));
    let table = json!({"title": title, "columns": columns, "rows": []});
    TABLES.lock().unwrap_or_else(PoisonError::into_inner).push(table);
}

/// Adds a row to the table that was begun last: its name, and numbers with the decimals that are printed.
pub(crate) fn row(name: impl Display, numbers: &[(f64, usize)]) {
    let cells: Vec<String> =
        numbers.iter().map(|(number, decimals)| format!("{number:.decimals$}")).collect();
    println!("| {name} | {} |", cells.join(" | "));
    let row =
        json!({"name": name.to_string(), "numbers": numbers.iter().map(|cell| cell.0).collect::<Vec<_>>()});
    let mut tables = TABLES.lock().unwrap_or_else(PoisonError::into_inner);
    let rows = tables.last_mut().and_then(|table| table["rows"].as_array_mut());
    rows.expect("a table was begun").push(row);
}

/// Writes all tables to `bench.json` in the folder of compiled files, with the machine that they are of.
pub(crate) fn write() {
    let folder = option_env!("CARGO_TARGET_DIR").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("target"),
        |folder| Path::new(folder).to_path_buf(),
    );
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let tables = &*TABLES.lock().unwrap_or_else(PoisonError::into_inner);
    let run = json!({"version": env!("CARGO_PKG_VERSION"), "processor": processor(), "cores": cores, "tables": tables});
    let file = folder.join("bench.json");
    std::fs::write(&file, format!("{run:#}\n")).expect("the folder can be written");
    println!("\nwritten to {}", file.display());
}

/// The processor's name, where the system tells it.
fn processor() -> Option<String> {
    let told = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let (_, name) = told.lines().find(|line| line.starts_with("model name"))?.split_once(": ")?;
    Some(name.to_owned())
}
