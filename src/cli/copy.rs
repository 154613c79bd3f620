//! `sightfix copy`

use std::path::Path;

use anyhow::Context as _;
use clap::Args;

use super::output::print_line;
use super::runtime;
use crate::store::{CopiedTable, Location, Sharing, Store, StoreOptions};

/// Copy everything into another store, an empty one, and compare them; no server may use either
#[derive(Args)]
pub(super) struct Copy {
    /// Data folder, or URL of a PostgreSQL database
    #[arg(long, value_name = "DIR|URL")]
    from: String,
    /// The same for the copy; a folder is made if it does not exist, a database must exist
    #[arg(long, value_name = "DIR|URL")]
    to: String,
}

impl Copy {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let (from, to) = (location(&self.from)?, location(&self.to)?);
        if let Location::Folder(folder) = &from {
            anyhow::ensure!(folder.is_dir(), "there is no data folder {}", folder.display());
        }
        runtime()?.block_on(async {
            let (source, target) = (open(&from).await?, open(&to).await?);
            let copied = source.copy_to(&target).await;
            source.close().await;
            target.close().await;
            for CopiedTable { name, rows, sha256 } in copied? {
                print_line(&format_args!("{name:<20} {rows:>12} rows  sha256 {sha256}"))?;
            }
            print_line(&format_args!("{to} holds the same as {from}"))
        })
    }
}

fn location(text: &str) -> anyhow::Result<Location> {
    let url = text.contains("://").then_some(text);
    Ok(Location::new(Path::new(text), url)?)
}

/// As a server does, so that none uses the same folder.
async fn open(location: &Location) -> anyhow::Result<Store> {
    let options = StoreOptions {
        role: "sightfix copy".to_owned(),
        sharing: Sharing::OneServer,
        ..StoreOptions::default()
    };
    Store::open_at(location, options).await.with_context(|| format!("cannot open {location}"))
}
