//! The command line: one file per subcommand. A subcommand reads its flags, calls the layers below, and
//! prints the result.
//!
//! Does not contain rules of the domain.

mod backup;
mod config;
mod copy;
mod doctor;
mod evaluate;
mod evaluate_site;
mod exit_code;
mod files;
mod fuse;
mod gnss_error;
mod health;
mod import;
mod keys;
mod layout;
mod migrate;
mod models;
mod openapi;
mod output;
mod pair;
mod progress;
mod recordings;
mod rejected_rows;
mod replay;
mod restore;
mod serve;
mod shell;
mod simulate;
mod simulate_site;
mod site_recording;
mod summary;
mod tls;
mod train;

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, Parser, Subcommand};

use crate::app::access::Caller;
use crate::app::{App, store_limits, store_location};
use crate::clock::{Clock, Randomness};
use crate::config::{Config, Overrides, Secret};
use crate::domain::{CameraId, ReceiverId, SiteId, TargetId};
use crate::store::{Location, Sharing, Store, StoreOptions};
use crate::telemetry::Metrics;

pub use exit_code::exit_code;
pub use output::reader_is_gone;

/// How settings are named in the environment.
const ENVIRONMENT: &str = "Every setting can also be given in the environment: SIGHTFIX_ and its name in capitals, with \
__ between a section and a name: SIGHTFIX_LISTEN, SIGHTFIX_DATA, SIGHTFIX_LOG_FORMAT, SIGHTFIX_LIMITS__BODY_BYTES. \
`sightfix config` prints all of them. Flags take precedence over the environment, and the environment over the file.";

/// Positions of targets from the bounding boxes of an uncalibrated fixed camera and from GNSS fixes
#[derive(Parser)]
#[command(name = "sightfix", version, arg_required_else_help = true, after_help = ENVIRONMENT)]
pub struct Cli {
    /// Settings file [default: sightfix.toml in the working folder, if it exists]
    #[arg(long, global = true, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print no progress and no notes, only results and errors
    #[arg(long, short, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Serve REST and gRPC on one port
    Serve(serve::Serve),
    /// Import samples from a file into a camera
    Import(import::Import),
    /// Pair detections and fixes that were recorded separately into samples
    Pair(pair::Pair),
    /// Train a camera's model from its samples
    Train(train::Train),
    /// Write a camera's model versions to files, for sightfix or for other runtimes
    Models(models::Models),
    /// Fuse observations from a file, without a server
    Fuse(fuse::Fuse),
    /// Estimate a receiver's error from many fixes at one fixed point
    GnssError(gnss_error::EstimateGnssError),
    /// Compare methods on a test file, without a server
    Evaluate(evaluate::Evaluate),
    /// Write a simulated world with its truth
    Simulate(simulate::Simulate),
    /// Stream recorded boxes and fixes to a server, as one or many cameras
    Replay(replay::Replay),
    /// Create, list and revoke the keys that clients of a server present
    Keys(keys::Keys),
    /// Make the certificate that browsers on phones need, without a name of one's own
    Tls(tls::Tls),
    /// Copy the database into one verified file, also while a server uses it
    Backup(backup::Backup),
    /// Replace the database by a backup
    Restore(restore::Restore),
    /// Copy everything from a data folder or database into another one, and compare
    Copy(copy::Copy),
    /// Bring the schema of the database up to date, before servers of a new version start
    Migrate(migrate::Migrate),
    /// Check folder, database, models, clock, port and system, and say what to do
    Doctor(doctor::Doctor),
    /// Check whether a server is alive
    Health(health::Health),
    /// Print the effective settings
    Config(config::PrintConfig),
    /// Print the OpenAPI description of the REST interface
    Openapi(openapi::Openapi),
    /// Print completions for a shell
    Completions(shell::Completions),
    /// Print the manual page, or write those of all subcommands to a folder
    Man(shell::Man),
}

impl Cli {
    /// Parses the arguments of the process; exits if they are invalid.
    #[must_use]
    pub fn from_arguments() -> Self {
        Self::parse()
    }

    /// Runs the command.
    ///
    /// # Errors
    /// A human-readable error.
    pub fn run(self) -> anyhow::Result<()> {
        let file = self.config.as_deref();
        if self.quiet {
            output::be_quiet();
        }
        match self.command {
            Command::Serve(command) => command.run(file),
            Command::Import(command) => command.run(file),
            Command::Pair(command) => command.run(file),
            Command::Train(command) => command.run(file),
            Command::Models(command) => command.run(file),
            Command::Fuse(command) => command.run(file),
            Command::GnssError(command) => command.run(),
            Command::Evaluate(command) => command.run(),
            Command::Simulate(command) => command.run(),
            Command::Replay(command) => command.run(file),
            Command::Keys(command) => command.run(file),
            Command::Tls(command) => command.run(),
            Command::Backup(command) => command.run(file),
            Command::Restore(command) => command.run(file),
            Command::Copy(command) => command.run(),
            Command::Migrate(command) => command.run(file),
            Command::Doctor(command) => command.run(file),
            Command::Health(command) => command.run(file),
            Command::Config(command) => command.run(file),
            Command::Openapi(command) => command.run(),
            Command::Completions(command) => command.run(),
            Command::Man(command) => command.run(),
        }
    }
}

/// The data folder of a command, or the database in its place.
#[derive(Args)]
struct DataFolder {
    /// Folder of the database [env: SIGHTFIX_DATA]
    #[arg(long, value_name = "DIR", conflicts_with = "database")]
    data: Option<PathBuf>,
    /// PostgreSQL database instead of the folder: postgres://user@host/name. Others on this machine see it; set
    /// SIGHTFIX_DATABASE if it has a password
    #[arg(long, value_name = "URL")]
    database: Option<String>,
}

impl DataFolder {
    fn settings(&self, file: Option<&Path>) -> anyhow::Result<Config> {
        Config::load(file, self.overrides())
    }

    fn overrides(&self) -> Overrides {
        let database = self.database.clone().map(Secret::from);
        Overrides { data: self.data.clone(), database, ..Overrides::default() }
    }

    /// The settings of a command that works on the files of a data folder.
    fn folder_settings(&self, file: Option<&Path>, command: &str) -> anyhow::Result<Config> {
        let settings = self.settings(file)?;
        anyhow::ensure!(
            settings.database.is_none(),
            "sightfix {command} is for data folders, and the setting database names a PostgreSQL database: use the \
             database's own tools (pg_dump and pg_restore, or base backups with archived WAL)"
        );
        Ok(settings)
    }
}

/// The rule for a missing data folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MissingData {
    Create,
    /// A mistyped path must not become a folder.
    Refuse,
}

/// The application on the store, without a server. A server may use the same data folder; each logs the
/// other, this process by its `role`.
async fn open_app(settings: &Config, role: &str, missing: MissingData) -> anyhow::Result<App> {
    let location = store_location(settings)?;
    if let (Location::Folder(folder), MissingData::Refuse) = (&location, missing) {
        anyhow::ensure!(
            folder.is_dir(),
            "there is no data folder {}; `sightfix serve` and `sightfix import --create` make one",
            folder.display()
        );
    }
    let options = StoreOptions {
        limits: store_limits(&settings.limits),
        role: role.to_owned(),
        sharing: Sharing::Command,
    };
    let store =
        Store::open_at(&location, options).await.with_context(|| format!("cannot open {location}"))?;
    for other in store.newcomers() {
        output::print_note(format_args!("note: another process uses the same data folder: {other}"));
    }
    let app = App::new(store, Clock::system(), Randomness::system(), settings.limits.clone(), Metrics::new());
    Ok(app.await?.on_behalf_of(Caller::program(role)))
}

/// The tokio runtime of one command.
fn runtime() -> anyhow::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().context("cannot start the runtime")
}

fn camera_id(text: &str) -> Result<CameraId, String> {
    CameraId::new(text).map_err(|error| error.to_string())
}

fn site_id(text: &str) -> Result<SiteId, String> {
    SiteId::new(text).map_err(|error| error.to_string())
}

fn receiver_id(text: &str) -> Result<ReceiverId, String> {
    ReceiverId::new(text).map_err(|error| error.to_string())
}

fn target_id(text: &str) -> Result<TargetId, String> {
    TargetId::new(text).map_err(|error| error.to_string())
}
