//! `sightfix backup`

use std::path::{Path, PathBuf};

use clap::Args;

use super::output::print_line;
use super::{DataFolder, runtime};
use crate::store::{DatabaseReport, ExistingFile, back_up};

/// Copy the database into one verified file, also while a server uses it
#[derive(Args)]
pub(super) struct Backup {
    /// File to write
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Replace the file if it exists, once the backup is complete
    #[arg(long)]
    replace: bool,
    #[command(flatten)]
    folder: DataFolder,
}

impl Backup {
    pub(super) fn run(self, settings_file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.folder_settings(settings_file, "backup")?;
        let existing = if self.replace { ExistingFile::Replace } else { ExistingFile::Keep };
        let report = runtime()?.block_on(back_up(&settings.data, &self.file, existing))?;
        print_line(&format_args!("backup {}: {}", self.file.display(), contents(&report)))
    }
}

/// The contents of a verified database, in words.
pub(super) fn contents(report: &DatabaseReport) -> String {
    let DatabaseReport { cameras, samples, models, bytes, .. } = report;
    format!("{cameras} cameras, {samples} samples, {models} model versions, {bytes} bytes, verified")
}
