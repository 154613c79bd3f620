//! `sightfix keys`

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use clap::{Args, Subcommand};
use jiff::Timestamp;

use super::output::{print_line, print_note};
use super::{DataFolder, MissingData, camera_id, open_app, runtime};
use crate::app::App;
use crate::clock::{Clock, Randomness};
use crate::domain::{ApiKey, CameraId, KeyId, KeySecret, NewKey, Role, Scope};

/// Keys read from the store at a time.
const PAGE_ITEMS: u32 = 100;
const SECONDS_PER_DAY: u64 = 86_400;

/// Create, list and revoke the keys that clients of a server present
#[derive(Args)]
pub(super) struct Keys {
    #[command(subcommand)]
    command: KeysCommand,
}

#[derive(Subcommand)]
enum KeysCommand {
    /// Create a key in the data folder and print its secret, which is shown this once
    Create(Create),
    /// List the keys of the data folder, newest first
    List(List),
    /// Revoke a key; a server on the data folder refuses it within two seconds
    Revoke(Revoke),
    /// Print a new secret without storing it, for SIGHTFIX_ADMIN_KEY or --admin-key-file
    Generate,
}

#[derive(Args)]
struct Create {
    /// Purpose of the key
    #[arg(long, value_name = "NAME")]
    name: String,
    /// viewer, edge, operator or admin
    #[arg(long, value_name = "ROLE")]
    role: Role,
    /// Camera that the role edge is restricted to; repeat it for more
    #[arg(long = "camera", value_name = "ID", value_parser = camera_id)]
    camera_ids: Vec<CameraId>,
    /// Days until the key stops working [default: never]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=36_500))]
    expires_in_days: Option<u32>,
    #[command(flatten)]
    folder: DataFolder,
}

#[derive(Args)]
struct List {
    #[command(flatten)]
    folder: DataFolder,
}

#[derive(Args)]
struct Revoke {
    /// Id of the key, as `sightfix keys list` shows it
    #[arg(value_name = "KEY")]
    key: KeyId,
    #[command(flatten)]
    folder: DataFolder,
}

impl Keys {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        match self.command {
            KeysCommand::Create(command) => command.run(file),
            KeysCommand::List(command) => command.run(file),
            KeysCommand::Revoke(command) => command.run(file),
            KeysCommand::Generate => {
                let randomness = Randomness::system();
                print_line(&KeySecret::generate(|bytes| randomness.fill(bytes)).reveal())
            }
        }
    }
}

impl Create {
    fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        let scope = Scope::new(self.role, self.camera_ids)?;
        let now = Clock::system().now();
        let expires_at =
            self.expires_in_days.map(|days| now + Duration::from_secs(u64::from(days) * SECONDS_PER_DAY));
        let key = NewKey::new(&self.name, scope, expires_at, now)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix keys", MissingData::Create).await?;
            let created = app.keys().create(&key).await;
            app.close().await;
            let (key, secret) = created?;
            print_note(format_args!("key {} for {}; its secret is not shown again:", key.id, key.name));
            print_line(&secret.reveal())?;
            let scheme = if settings.tls.certificate.is_some() { "https" } else { "http" };
            let secret = secret.reveal();
            print_note(format_args!(
                "try it: curl -H 'authorization: Bearer {secret}' {scheme}://{}/v1/cameras",
                settings.listen
            ));
            Ok(())
        })
    }
}

impl List {
    fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix keys", MissingData::Refuse).await?;
            let listed = print_all(&app).await;
            app.close().await;
            listed
        })
    }
}

async fn print_all(app: &App) -> anyhow::Result<()> {
    let now = app.clock.now();
    let mut before = None;
    loop {
        let page = app.keys().list(before, PAGE_ITEMS).await?;
        for key in page.items {
            print_line(&line_of(&key, now))?;
        }
        before = page.next;
        if before.is_none() {
            return Ok(());
        }
    }
}

fn line_of(key: &ApiKey, now: Timestamp) -> String {
    let state = match (key.revoked_at, key.expires_at) {
        (Some(at), _) => format!("revoked {at:.0}"),
        (None, Some(at)) if at <= now => format!("expired {at:.0}"),
        (None, Some(at)) => format!("expires {at:.0}"),
        (None, None) => "does not expire".to_owned(),
    };
    let used = key.last_used_at.map_or_else(|| "never used".to_owned(), |at| format!("last used {at:.0}"));
    let cameras: Vec<&str> = key.scope.cameras().iter().map(CameraId::as_str).collect();
    let role = match cameras.is_empty() {
        true => key.scope.role().to_string(),
        false => format!("{} of {}", key.scope.role(), cameras.join(", ")),
    };
    format!("{}  {role}  {}  created {:.0}, {state}, {used}", key.id, key.name, key.created_at)
}

impl Revoke {
    fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix keys", MissingData::Refuse).await?;
            let revoked = app.keys().revoke(self.key).await;
            app.close().await;
            let revoked_at = revoked?.revoked_at.context("the key was not revoked")?;
            print_line(&format_args!("revoked {revoked_at:.0}"))
        })
    }
}
