//! `sightfix migrate`

use std::path::Path;

use anyhow::Context as _;
use clap::Args;

use super::output::print_line;
use super::{DataFolder, runtime};
use crate::app::{store_limits, store_location};
use crate::store::{Sharing, Store, StoreOptions};

/// Bring the schema of the database up to date, as every start of a server does; before a rolling update
#[derive(Args)]
pub(super) struct Migrate {
    #[command(flatten)]
    folder: DataFolder,
}

impl Migrate {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        let location = store_location(&settings)?;
        let options = StoreOptions {
            limits: store_limits(&settings.limits),
            role: "sightfix migrate".to_owned(),
            sharing: Sharing::Command,
        };
        runtime()?.block_on(async {
            let store = Store::open_at(&location, options).await;
            store.with_context(|| format!("cannot open {location}"))?.close().await;
            print_line(&format_args!("the schema of {location} is up to date"))
        })
    }
}
