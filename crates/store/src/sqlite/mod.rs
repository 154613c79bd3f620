//! The store of a data folder: a file `sightfix.db` (SQLite, write-ahead log) with one writer connection and a few
//! readers.
//!
//! A change is flushed to the disk before it is acknowledged ([`Durability::Synced`]), except for the progress of
//! jobs and for samples whose sender asks for less. A transaction is held across nothing but statements.

mod backup;
mod backup_digest;
mod connection;
mod copy;
pub(crate) mod errors;
mod file_check;
mod folder;
mod group_commit;
mod occupants;
mod outbox_logs;
mod reserve;
mod restore;
mod sample_table;
mod server_lock;
mod space;
#[cfg(test)]
mod tests;
mod writer;

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use sqlx::pool::PoolConnection;
use sqlx::sqlite::SqlitePoolOptions;
use sqlx::{Sqlite, SqlitePool};

use super::group_commit::GroupCommit;
use super::limits::StoreLimits;
use super::{Sharing, StoreOptions};
use crate::domain::{Durability, Error, ErrorKind, Result};

pub use backup::{BackupReport, ExistingFile, back_up, inspect_backup};
pub use file_check::{DatabaseReport, has_database, inspect};
pub use occupants::Occupant;
pub use reserve::available_bytes as disk_available_bytes;
pub use restore::{MissingDigest, Restored, restore};
pub use server_lock::holder as server_of;

pub(crate) use errors::failed;
pub(crate) use outbox_logs::open_log;
pub(crate) use space::Deletion;
pub(crate) use writer::WriterGuard;

use group_commit::GroupWriter;
use occupants::Presence;
use reserve::Reserve;
use server_lock::ServerLock;
use space::Space;
use writer::{Growth, Writer};

/// The store of one data folder.
#[derive(Clone)]
pub(crate) struct Store {
    inner: Arc<Inner>,
}

struct Inner {
    writer: Arc<Writer>,
    readers: SqlitePool,
    /// One reader for [`Store::ping`] alone, which slow reads do not keep waiting.
    probe: SqlitePool,
    samples: GroupCommit,
    space: Arc<Space>,
    /// `None` where the process could not announce itself, and after closing.
    presence: Mutex<Option<Presence>>,
    /// The lock of a server, until the store is closed.
    server_lock: Mutex<Option<ServerLock>>,
}

impl Store {
    /// Opens the store of a folder; makes the folder and the file if missing and brings the schema up
    /// to date. Must be called within a tokio runtime; the group-commit task lives on it.
    ///
    /// # Errors
    /// A [`FolderFault`] that says what is wrong with folder or file: in use by another server, not writable,
    /// not a database, damaged, or written by a newer version.
    pub(super) async fn open_with(folder: &Path, options: StoreOptions) -> Result<Self> {
        let StoreOptions { limits, role, sharing } = options;
        let path = folder::prepare(folder).await?;
        let space = Space::new(limits, Reserve::new(folder, limits.reserve_bytes));
        // Before the schema is touched: a server of another version may be using it.
        let server_lock = match sharing {
            Sharing::OneServer => {
                let mut lock = ServerLock::acquire(folder)?;
                space.make_room_to_start().await?;
                lock.announce(&role)?;
                Some(lock)
            }
            Sharing::Command => None,
        };
        let (writer, readers) = connection::open(&path, Space::max_pages(&limits)).await?;
        space.set_aside_at_start().await;
        let writer = Arc::new(writer);
        let group_writer = GroupWriter { writer: Arc::clone(&writer), space: Arc::clone(&space) };
        let samples = GroupCommit::start(Arc::new(group_writer));
        let presence = Presence::announce(folder, &role)
            .inspect_err(
                |error| tracing::warn!(%error, "others cannot see that this process uses the data folder"),
            )
            .ok();
        let presence = Mutex::new(presence);
        let probe = SqlitePoolOptions::new()
            .max_connections(1)
            .connect_lazy_with(readers.connect_options().as_ref().clone());
        let server_lock = Mutex::new(server_lock);
        let inner = Inner { writer, readers, probe, samples, space, presence, server_lock };
        let store = Self { inner: Arc::new(inner) };
        store.count_all_samples().await?;
        Ok(store)
    }

    /// Commits what is queued, copies the log back into the file and closes it. Later calls
    /// are refused with [`ErrorKind::ShuttingDown`]. Closing twice does nothing.
    pub(super) async fn close(&self) {
        self.inner.samples.close().await;
        self.inner.readers.close().await;
        self.inner.probe.close().await;
        self.inner.writer.close().await;
        self.presence().take();
        self.inner.server_lock.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// Other processes that have begun to use the data folder since the last call; at the first, all
    /// that use it.
    pub(super) fn newcomers(&self) -> Vec<Occupant> {
        let newcomers = self.presence().as_mut().map(Presence::newcomers).transpose();
        newcomers
            .inspect_err(
                |error| tracing::warn!(%error, "cannot tell which other processes use the data folder"),
            )
            .ok()
            .flatten()
            .unwrap_or_default()
    }

    /// Logs the processes of [`Store::newcomers`].
    pub(super) fn log_newcomers(&self) {
        for Occupant { pid, host, role } in self.newcomers() {
            tracing::warn!(pid, host, role, "another process uses the same data folder");
        }
    }

    fn presence(&self) -> std::sync::MutexGuard<'_, Option<Presence>> {
        self.inner.presence.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) async fn ping(&self) -> Result<()> {
        if self.inner.samples.has_ended() {
            return Err(Error::refused(ErrorKind::ShuttingDown, "the store is closed"));
        }
        sqlx::query_scalar::<_, i64>("SELECT count(*) FROM cameras WHERE key = 0")
            .fetch_one(&self.inner.probe)
            .await
            .map_err(failed)?;
        Ok(())
    }

    pub(super) fn is_damaged(&self) -> bool {
        errors::has_met_damage()
    }

    /// Keeps groups of samples from being stored until it is dropped.
    #[cfg(test)]
    pub(super) async fn hold(&self) -> Box<dyn Send + '_> {
        Box::new(self.changing(Durability::Relaxed).await.expect("the writer"))
    }

    /// Callers whose batches are still queued.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.inner.samples.waiting()
    }

    /// Executes statements without the checks of the store.
    #[cfg(test)]
    pub(super) async fn tamper(&self, sql: &'static str) {
        let mut writer = self.changing(Durability::Relaxed).await.expect("the writer");
        let mut transaction = writer.begin().await.expect("begins");
        sqlx::raw_sql(sql).execute(&mut *transaction).await.expect("runs");
        transaction.commit().await.expect("commits");
    }

    fn readers(&self) -> &SqlitePool {
        &self.inner.readers
    }

    /// The queue of samples that are committed in groups.
    pub(crate) fn sample_queue(&self) -> &GroupCommit {
        &self.inner.samples
    }

    pub(crate) fn limits(&self) -> &StoreLimits {
        &self.inner.space.usage.limits
    }

    pub(crate) async fn reader(&self) -> Result<PoolConnection<Sqlite>> {
        self.readers().acquire().await.map_err(failed)
    }

    /// The writer, for a change that also works when the limit of the database's size has been reached.
    pub(crate) async fn changing(&self, durability: Durability) -> Result<WriterGuard<'_>> {
        self.inner.writer.lock(durability, Growth::Headroom).await
    }
}
