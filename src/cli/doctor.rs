//! `sightfix doctor`

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::Args;

use super::output::print_line;
use super::{DataFolder, runtime};
use crate::clock::Clock;
use crate::config::{Config, Overrides};
use crate::doctor::{Check, CheckStatus, examine};

/// Check folder, database, models, clock, port and system, and say what to do; fails if a check does
#[derive(Args)]
pub(super) struct Doctor {
    /// Address of the server
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
    /// Check a file of `sightfix backup`, too: its structure, its models and its digest
    #[arg(long, value_name = "FILE")]
    backup: Option<PathBuf>,
    /// Print the checks as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    folder: DataFolder,
}

impl Doctor {
    pub(super) fn run(self, settings_file: Option<&Path>) -> anyhow::Result<()> {
        let overrides = Overrides { listen: self.listen, ..self.folder.overrides() };
        let settings = Config::load(settings_file, overrides)?;
        let checks = runtime()?.block_on(examine(&settings, self.backup.as_deref(), &Clock::system()));
        if self.json {
            print_line(&serde_json::to_string_pretty(&checks)?)?;
        } else {
            checks.iter().try_for_each(|check| print_line(&line_of(check)))?;
        }
        let failed = checks.iter().filter(|check| check.status == CheckStatus::Failed).count();
        anyhow::ensure!(failed == 0, "{failed} of {} checks failed", checks.len());
        Ok(())
    }
}

fn line_of(check: &Check) -> String {
    let Check { name, status, finding, remedy } = check;
    let remedy = remedy.as_ref().map_or_else(String::new, |remedy| format!(". Remedy: {remedy}"));
    format!("{:<8} {name}: {finding}{remedy}", status.as_str())
}
