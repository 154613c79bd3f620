//! `sightfix config`

use std::path::Path;

use clap::Args;

use super::DataFolder;

/// Print the settings in force
#[derive(Args)]
pub(super) struct PrintConfig {
    #[command(flatten)]
    folder: DataFolder,
}

impl PrintConfig {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        // There is no secret among the settings yet; one must be a type that hides itself.
        print!("{}", toml::to_string_pretty(&self.folder.settings(file)?)?);
        Ok(())
    }
}
