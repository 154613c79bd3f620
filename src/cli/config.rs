//! `sightfix config`

use std::path::Path;

use clap::Args;

use super::DataFolder;
use super::output::print_line;

/// Print the effective settings
#[derive(Args)]
pub(super) struct PrintConfig {
    #[command(flatten)]
    folder: DataFolder,
}

impl PrintConfig {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        print_line(&toml::to_string_pretty(&self.folder.settings(file)?)?.trim_end())
    }
}
