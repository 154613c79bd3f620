//! The store of a PostgreSQL database, which any number of processes share.
//!
//! Changes of several processes run at once. Where one is decided by rows that another may change, it locks them first:
//! a camera's row for what belongs to the camera (`cameras::lock_camera`), an advisory lock for limits over a whole
//! table (`locks`). Locks are taken in this order: cameras by their keys, an idempotency key, jobs, limits. Jobs are claimed with `SKIP LOCKED`.

mod camera_changes;
pub(crate) mod connection;
mod connection_owners;
mod copy;
pub(crate) mod errors;
mod group_commit;
mod history;
pub(crate) mod locks;
mod nodes;
mod outbox_logs;
mod sample_partitions;
mod sample_table;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use sqlx::{PgPool, Postgres, Transaction};

use super::StoreOptions;
use super::group_commit::GroupCommit;
use super::limits::{StorageStatus, StoreLimits, Usage};
use super::location::DatabaseUrl;
use crate::domain::{Durability, Error, ErrorKind, Result};
use crate::statements::sample_counts::count_all_samples;

pub(crate) use connection::{DATABASE_NOW_US, begin_write};
pub(crate) use errors::failed;
pub(super) use errors::{Attempts, repeated};
pub(crate) use outbox_logs::lock_log;
pub(crate) use sample_partitions::start_of_week;

use group_commit::GroupWriter;

pub use connection_owners::ConnectionReports;
pub use history::HistoryMark;
pub use nodes::{Acquired, NodeLeases, Renewed};

/// The store of one database.
#[derive(Clone)]
pub(crate) struct Store {
    inner: Arc<Inner>,
}

struct Inner {
    pool: PgPool,
    samples: GroupCommit,
    usage: Arc<Usage>,
    leases: NodeLeases,
}

impl Store {
    pub(super) async fn connect(url: &DatabaseUrl, options: StoreOptions) -> Result<Self> {
        let pool = connection::open(url).await?;
        let usage = Arc::new(Usage::new(options.limits));
        let writer = GroupWriter { pool: pool.clone(), usage: Arc::clone(&usage) };
        let samples = GroupCommit::start(Arc::new(writer));
        let leases = NodeLeases { renewals: connection::for_renewals(url)?, pool: pool.clone() };
        let inner = Arc::new(Inner { pool, samples, usage, leases });
        let store = Self { inner };
        store.count_all_samples().await?;
        Ok(store)
    }

    pub(super) async fn close(&self) {
        self.inner.samples.close().await;
        self.inner.leases.renewals.close().await;
        self.inner.pool.close().await;
    }

    pub(super) fn node_leases(&self) -> &NodeLeases {
        &self.inner.leases
    }

    pub(super) async fn ping(&self) -> Result<()> {
        if self.inner.samples.has_ended() {
            return Err(Error::refused(ErrorKind::ShuttingDown, "the store is closed"));
        }
        let mut reader = self.reader().await?;
        let (_, takes_changes): (i64, bool) = sqlx::query_as(
            "SELECT count(*), NOT (pg_is_in_recovery() OR current_setting('default_transaction_read_only')::BOOLEAN) \
             FROM cameras WHERE key = 0",
        )
        .fetch_one(&mut *reader)
        .await
        .map_err(failed)?;
        if takes_changes {
            return Ok(());
        }
        let message = "the database takes no changes: it is a standby, or read-only";
        Err(Error::refused(ErrorKind::Overloaded, message))
    }

    pub(super) fn is_full(&self) -> bool {
        self.inner.usage.is_full()
    }

    /// Counts, and tells how much is stored.
    pub(super) async fn maintain(&self) -> Result<StorageStatus> {
        self.count_all_samples().await?;
        let mut reader = self.reader().await?;
        let bytes: i64 = sqlx::query_scalar("SELECT pg_database_size(current_database())")
            .fetch_one(&mut *reader)
            .await
            .map_err(failed)?;
        // The next import shows whether there is space: the disk is that of another machine.
        self.inner.usage.has_room();
        Ok(StorageStatus {
            database_bytes: u64::try_from(bytes).unwrap_or_default(),
            free_bytes: 0,
            disk_available_bytes: None,
            samples: self.inner.usage.samples(),
            queued_rows: self.inner.samples.queued_rows(),
            is_full: self.is_full(),
        })
    }

    async fn count_all_samples(&self) -> Result<()> {
        self.inner.usage.counted(count_all_samples(&mut *self.reader().await?).await?);
        Ok(())
    }

    /// Keeps groups of samples from being stored until it is dropped.
    #[cfg(test)]
    pub(super) async fn hold(&self) -> Box<dyn Send + '_> {
        let pool = &self.inner.pool;
        let mut connections = Vec::new();
        for _ in 0..pool.options().get_max_connections() {
            connections.push(pool.acquire().await.expect("a connection"));
        }
        Box::new(connections)
    }

    /// Callers whose batches are still queued.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.inner.samples.waiting()
    }

    /// Executes statements without the checks of the store.
    #[cfg(test)]
    pub(super) async fn tamper(&self, sql: &'static str) {
        let mut transaction = self.writer().await.expect("a transaction");
        sqlx::raw_sql(sql).execute(&mut *transaction).await.expect("runs");
        transaction.commit().await.expect("commits");
    }

    /// The queue of samples that are committed in groups.
    pub(crate) fn sample_queue(&self) -> &GroupCommit {
        &self.inner.samples
    }

    pub(crate) fn limits(&self) -> &StoreLimits {
        &self.inner.usage.limits
    }

    /// A transaction for one or several reads, which all see the same state.
    pub(crate) async fn reader(&self) -> Result<Transaction<'static, Postgres>> {
        connection::begin_read(&self.inner.pool).await
    }

    /// A transaction for a change that must be on the disk before it is acknowledged.
    async fn writer(&self) -> Result<Transaction<'static, Postgres>> {
        connection::begin_write(&self.inner.pool, Durability::Synced).await
    }

    pub(crate) fn pool(&self) -> &PgPool {
        &self.inner.pool
    }
}
