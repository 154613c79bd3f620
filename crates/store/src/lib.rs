//! Persistent storage as one type, [`Store`]; the only crate with SQL.
//!
//! Two backends: a file in a data folder (`sqlite`) and a database of a server (`postgres`). The methods of [`Store`]
//! are listed once, in `contract`, with what they promise; the suite in `tests` holds both backends to it. What is
//! stored is written once, an entity per file (`entities`), over the statements of `query` and the transactions of
//! `database`. What is in a row (`rows`), the rules of jobs (`jobs`), limits and the queue of samples that are
//! committed in groups (`group_commit`) are the same for both, too.
//!
//! The crate reads no clock, and checks no numbers, since they are valid by construction. It holds a transaction across
//! statements alone, and makes no type of the database library public. Rows that the constructors of `domain` refuse
//! are faults that name table, column and row.
//!
//! The schema is in `migrations/` at the top of the repository, a folder per backend. `.ci/postgres` runs the suite
//! against a server.

#![warn(missing_docs)]
// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod contract;
mod copy;
mod database;
mod entities;
mod folder_fault;
mod group_commit;
mod jobs;
mod limits;
mod location;
mod locks;
mod postgres;
mod query;
mod refusals;
mod row_decoder;
mod rows;
mod schema;
mod sqlite;
mod statements;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::sync::Arc;

use sightfix_domain::{domain, geo};

use crate::domain::{Actor, CameraId, CameraKey, Durability, Result, StoredSample};

use database::{Backend, Database};

pub use crate::domain::{SampleFilter, SampleKey};
pub use copy::CopiedTable;
pub use entities::RunSubject;
pub use folder_fault::{FolderFault, FolderFaultKind};
pub use group_commit::{Completion, InsertOptions, Inserted};
pub use jobs::{Claim, Heartbeat, JobCounts, JobEnd, LiveJobs};
pub use limits::{StorageStatus, StoreLimits};
pub use location::{DatabaseUrl, Location};
pub use postgres::{Acquired, ConnectionReports, HistoryMark, NodeLeases, Renewed};
pub use rows::cameras::{CameraContent, CameraVersion, CameraVersions, ChangeMark};
pub use rows::idempotency::{IdempotencyRecord, StoredAnswer};
pub use rows::keys::KeysVersion;
pub use rows::models::{NewModel, StoredHeldOutError, StoredModel};
pub use rows::runs::{RunEnd, RunOutput};
pub use rows::site_runs::{SiteCameraOutput, SiteRunEnd, SiteRunOutput};
pub use sqlite::{
    BackupReport, DatabaseReport, ExistingFile, MissingDigest, Occupant, Restored, back_up,
    disk_available_bytes, has_database, inspect, inspect_backup, restore, server_of,
};

/// The storage of one data folder, or of one PostgreSQL database. Clones share one store; it lives until the last
/// clone is dropped or it is closed.
///
/// Every method may fail with a fault of the server (disk, file, connection), with
/// [`ErrorKind::Overloaded`](crate::domain::ErrorKind) when another process holds the file for seconds or the
/// database server does not answer, with `InsufficientStorage` when there is no space for what it writes, and with
/// `ShuttingDown` after [`Store::close`].
#[derive(Clone)]
pub struct Store(Database);

/// How a store is opened.
#[derive(Debug, Clone)]
pub struct StoreOptions {
    /// The limits of its contents.
    pub limits: StoreLimits,
    /// The purpose of this process, for the logs of others that use the same folder.
    pub role: String,
    /// States if other processes may use the folder in the same way.
    pub sharing: Sharing,
}

/// States if several processes may use a folder in the same way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sharing {
    /// A server: there is at most one, beside any number of commands.
    OneServer,
    /// A command, which works beside a server and other commands.
    Command,
}

impl Default for StoreOptions {
    fn default() -> Self {
        Self { limits: StoreLimits::default(), role: "sightfix".to_owned(), sharing: Sharing::Command }
    }
}

/// The same call on whichever backend the store has.
macro_rules! on_backend {
    ($store:expr, $backend:ident => $call:expr) => {
        match &$store.0.backend {
            $crate::database::Backend::Sqlite($backend) => $call,
            $crate::database::Backend::Postgres($backend) => $call,
        }
    };
}
use on_backend;

impl Store {
    /// Opens the store of a folder without limits; see [`Store::open_with`].
    ///
    /// # Errors
    /// As [`Store::open_with`].
    pub async fn open(folder: &Path) -> Result<Self> {
        Self::open_with(folder, StoreOptions::default()).await
    }

    /// Opens the store of a folder; makes the folder and the file if missing and brings the schema up
    /// to date. Must be called within a tokio runtime; the group-commit task lives on it.
    ///
    /// # Errors
    /// A [`FolderFault`] that says what is wrong with folder or file: in use by another server, not writable,
    /// not a database, damaged, or written by a newer version.
    pub async fn open_with(folder: &Path, options: StoreOptions) -> Result<Self> {
        let actor = Arc::new(Actor::program(&options.role));
        let backend = Backend::Sqlite(sqlite::Store::open_with(folder, options).await?);
        Ok(Self(Database { backend, actor }))
    }

    /// Opens the store of a folder ([`Store::open_with`]), or connects to a database and brings its schema up to
    /// date. Any number of servers and commands may use one database.
    ///
    /// # Errors
    /// A [`FolderFault`] that says what is wrong with the folder, the file or the database. No part of a URL's
    /// secrets is in it.
    pub async fn open_at(location: &Location, options: StoreOptions) -> Result<Self> {
        match location {
            Location::Folder(folder) => Self::open_with(folder, options).await,
            Location::Database(url) => {
                let actor = Arc::new(Actor::program(&options.role));
                let backend = Backend::Postgres(postgres::Store::connect(url, options).await?);
                Ok(Self(Database { backend, actor }))
            }
        }
    }

    /// The same store, whose changes are recorded as those of an actor.
    #[must_use]
    pub fn on_behalf_of(&self, actor: Arc<Actor>) -> Self {
        Self(Database { backend: self.0.backend.clone(), actor })
    }

    /// Commits what is queued and closes the file or the connections. Later calls are refused with
    /// [`ErrorKind::ShuttingDown`](crate::domain::ErrorKind). Closing twice does nothing.
    pub async fn close(&self) {
        on_backend!(self, store => store.close().await);
    }

    /// Checks that the store answers.
    ///
    /// # Errors
    /// A fault if it does not.
    pub async fn ping(&self) -> Result<()> {
        on_backend!(self, store => store.ping().await)
    }

    /// Who has the live state of each camera, where several processes share the database; `None` for a data folder,
    /// whose one server has that of all.
    #[must_use]
    pub fn node_leases(&self) -> Option<&NodeLeases> {
        match &self.0.backend {
            Backend::Sqlite(_) => None,
            Backend::Postgres(store) => Some(store.node_leases()),
        }
    }

    /// Other processes that have begun to use the data folder since the last call; at the first, all
    /// that use it. None for a database, which any number of processes may use.
    #[must_use]
    pub fn newcomers(&self) -> Vec<Occupant> {
        match &self.0.backend {
            Backend::Sqlite(store) => store.newcomers(),
            Backend::Postgres(_) => Vec::new(),
        }
    }

    /// Logs the processes of [`Store::newcomers`].
    pub fn log_newcomers(&self) {
        if let Backend::Sqlite(store) = &self.0.backend {
            store.log_newcomers();
        }
    }

    /// True if a damaged page was read since the process was started, so that a backup should be restored. For a
    /// PostgreSQL database see its own log.
    #[must_use]
    pub fn is_damaged(&self) -> bool {
        match &self.0.backend {
            Backend::Sqlite(store) => store.is_damaged(),
            Backend::Postgres(_) => false,
        }
    }

    /// True if imports are refused for want of space, as far as is known without looking.
    #[must_use]
    pub fn is_full(&self) -> bool {
        on_backend!(self, store => store.is_full())
    }

    /// Stores samples of a camera and returns after their commit, and with [`Durability::Synced`] after
    /// they have been flushed to the disk; all of them are stored, or none. A sample whose camera, target
    /// and time are stored already is left as it is and counted as a duplicate, but a sample with a fix
    /// replaces one without, and with [`OnConflict::Replace`](crate::domain::OnConflict) each replaces
    /// a stored one. Many callers at once share a transaction; a caller who goes away
    /// does not stop it.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`], [`crate::domain::ErrorKind::InsufficientStorage`].
    pub async fn insert_samples(
        &self,
        id: &CameraId,
        samples: Vec<impl Into<StoredSample>>,
        options: impl Into<InsertOptions>,
    ) -> Result<Inserted> {
        let samples = stored(samples);
        self.0.insert_samples(id, None, samples, options.into()).await
    }

    /// As [`Store::insert_samples`], for the camera of that key alone: if it was deleted and created again
    /// under the same id, nothing is stored.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`], [`crate::domain::ErrorKind::InsufficientStorage`].
    pub async fn insert_samples_of(
        &self,
        id: &CameraId,
        key: CameraKey,
        samples: Vec<impl Into<StoredSample>>,
        durability: Durability,
    ) -> Result<Inserted> {
        let samples = stored(samples);
        self.0.insert_samples(id, Some(key), samples, durability.into()).await
    }
}

fn stored(samples: Vec<impl Into<StoredSample>>) -> Vec<StoredSample> {
    samples.into_iter().map(Into::into).collect()
}
