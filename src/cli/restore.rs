//! `sightfix restore`

use std::path::{Path, PathBuf};

use clap::Args;

use super::backup::contents;
use super::output::print_line;
use super::{DataFolder, runtime};
use crate::clock::Clock;
use crate::store::{MissingDigest, restore};

/// Replace the database, which is kept under another name, by a backup; no server may run
#[derive(Args)]
pub(super) struct Restore {
    /// A file of `sightfix backup`
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Restore a file without a digest, of another program: changed values in it are not seen
    #[arg(long)]
    without_digest: bool,
    #[command(flatten)]
    folder: DataFolder,
}

impl Restore {
    pub(super) fn run(self, settings_file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.folder_settings(settings_file, "restore")?;
        let now = Clock::system().now();
        let missing = if self.without_digest { MissingDigest::Accept } else { MissingDigest::Refuse };
        let restored = runtime()?.block_on(restore(&settings.data, &self.file, missing, now))?;
        print_line(&format_args!("restored {}: {}", self.file.display(), contents(&restored.report)))?;
        match restored.kept {
            Some(kept) => print_line(&format_args!("the database before it is kept as {}", kept.display())),
            None => Ok(()),
        }
    }
}
