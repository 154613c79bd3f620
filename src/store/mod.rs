//! Everything that lasts, behind one type: [`Store`]; the only floor that knows SQL.
//!
//! A file `sightfix.db` (SQLite, write-ahead log) with one writer connection and a few readers.
//! Samples of many callers share transactions (`group_commit`); activations, profiles and the state of
//! background jobs are on the disk before they are acknowledged (`Durability::Synced`).
//!
//! What never happens here: clocks are read, numbers are checked (they are valid by construction),
//! a transaction is held across anything but statements, a type of the database library gets out.
//! Rows that the constructors of `domain` refuse are faults that name table, column and row.

mod cameras;
mod connection;
mod evaluations;
mod faults;
mod fields;
mod group_commit;
mod jobs;
mod models;
mod moves;
mod runs;
mod samples;
#[cfg(test)]
mod tests;
mod training;

use std::path::Path;
use std::sync::Arc;

use sqlx::SqlitePool;
use sqlx::sqlite::SqlitePoolOptions;

use crate::domain::{Error, ErrorKind, Result};

pub use group_commit::Inserted;
pub use jobs::{Claim, Heartbeat, JobEnd};
pub use runs::{NewModel, RunEnd};
pub use samples::{SampleFilter, SampleKey};

use connection::{Durability, Writer};
use faults::failed;
use group_commit::GroupCommit;

/// All that lasts. Clones share one store; it lives until the last clone is dropped or it is closed.
///
/// Every method may fail with a fault of the server (disk, file), with
/// [`ErrorKind::Overloaded`] when another process holds the file for seconds, and with
/// [`ErrorKind::ShuttingDown`] after [`Store::close`].
#[derive(Clone)]
pub struct Store {
    inner: Arc<Inner>,
}

struct Inner {
    writer: Arc<Writer>,
    readers: SqlitePool,
    /// One reader for [`Store::ping`] alone, which slow reads do not keep waiting.
    probe: SqlitePool,
    samples: GroupCommit,
}

impl Store {
    /// Opens the store of a folder; makes the folder and the file if missing and brings the schema up
    /// to date. Must be called within a tokio runtime; the group-commit task lives on it.
    ///
    /// # Errors
    /// A fault that says what is wrong with folder or file: not writable, not a database, or written
    /// by a newer version.
    pub async fn open(folder: &Path) -> Result<Self> {
        let (writer, readers) = connection::open(folder).await?;
        let writer = Arc::new(writer);
        let samples = GroupCommit::start(Arc::clone(&writer));
        let options = readers.connect_options().as_ref().clone();
        let probe = SqlitePoolOptions::new().max_connections(1).connect_lazy_with(options);
        Ok(Self { inner: Arc::new(Inner { writer, readers, probe, samples }) })
    }

    /// Commits what was handed in, writes the log back into the file and lets go of it. Later calls
    /// are refused with [`ErrorKind::ShuttingDown`]. Closing twice does nothing.
    pub async fn close(&self) {
        self.inner.samples.close().await;
        self.inner.readers.close().await;
        self.inner.probe.close().await;
        self.inner.writer.close().await;
    }

    /// Whether the store answers.
    ///
    /// # Errors
    /// A fault if it does not.
    pub async fn ping(&self) -> Result<()> {
        if self.inner.samples.has_ended() {
            return Err(Error::refused(ErrorKind::ShuttingDown, "the store is closed"));
        }
        sqlx::query_scalar::<_, i64>("SELECT count(*) FROM cameras WHERE key = 0")
            .fetch_one(&self.inner.probe)
            .await
            .map_err(failed)?;
        Ok(())
    }

    fn readers(&self) -> &SqlitePool {
        &self.inner.readers
    }

    /// The writer's turn, for a change that must be on the disk before it is acknowledged.
    async fn synced(&self) -> Result<connection::Turn<'_>> {
        self.inner.writer.turn(Durability::Synced).await
    }

    /// The writer's turn, for a change that a power cut (not a crash) may undo.
    async fn relaxed(&self) -> Result<connection::Turn<'_>> {
        self.inner.writer.turn(Durability::Relaxed).await
    }
}
