//! `sightfix config`

use std::path::Path;

use clap::Args;

use super::DataFolder;

/// Print the effective settings
#[derive(Args)]
pub(super) struct PrintConfig {
    #[command(flatten)]
    folder: DataFolder,
}

impl PrintConfig {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        // No setting is secret; a secret one needs a type whose serialisation hides it.
        print!("{}", toml::to_string_pretty(&self.folder.settings(file)?)?);
        Ok(())
    }
}
