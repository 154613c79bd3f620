//! Checks of everything that may keep a server from working on this machine, each with its remedy.
//!
//! Does not repair, change settings, or migrate an older schema.

mod database;
mod folder;
mod port;
mod system;

use std::path::Path;

use serde::Serialize;

use crate::clock::Clock;
use crate::config::Config;

pub use port::{reachable, request_liveness};

/// How serious a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CheckStatus {
    /// Nothing to do.
    Ok,
    /// The server works, though not for ever or not in full.
    Warning,
    /// The server does not start, or refuses work.
    Failed,
}

impl CheckStatus {
    /// The word in the output.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warning => "warning",
            Self::Failed => "failed",
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// The object of the check.
    pub name: &'static str,
    /// How serious it is.
    pub status: CheckStatus,
    /// The finding, in words.
    pub finding: String,
    /// The remedy, unless none is needed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
}

impl Check {
    fn ok(name: &'static str, finding: impl Into<String>) -> Self {
        Self { name, status: CheckStatus::Ok, finding: finding.into(), remedy: None }
    }

    fn warning(name: &'static str, finding: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, status: CheckStatus::Warning, finding: finding.into(), remedy: Some(remedy.into()) }
    }

    fn failed(name: &'static str, finding: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, status: CheckStatus::Failed, finding: finding.into(), remedy: Some(remedy.into()) }
    }
}

/// Makes all checks of a server with these settings, and those of a backup if one is named. Reads the whole database,
/// which takes seconds per gigabyte.
pub async fn examine(config: &Config, backup: Option<&Path>, clock: &Clock) -> Vec<Check> {
    let mut checks = match config.database {
        None => vec![folder::writable(config), folder::space(config), folder::lock(config)],
        Some(_) => Vec::new(),
    };
    let (of_database, report) = database::check(config, clock).await;
    checks.extend(of_database);
    checks.push(system::clock(clock, report.as_ref()).await);
    checks.push(port::check(config).await);
    checks.push(system::open_files(config));
    checks.push(system::memory(config));
    if let Some(file) = backup {
        checks.push(database::backup(file).await);
    }
    checks
}

/// Bytes in a unit that people read.
fn in_units(bytes: u64) -> String {
    const MIB: u64 = 1 << 20;
    if bytes < 10 * MIB { format!("{} KiB", bytes >> 10) } else { format!("{} MiB", bytes / MIB) }
}
