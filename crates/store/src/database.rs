//! The database of a store, whichever backend it has, and its transactions.

use std::sync::Arc;

use sqlx::pool::PoolConnection;
use sqlx::{PgPool, Sqlite};

use crate::domain::{Actor, Durability, Result};
use crate::group_commit::GroupCommit;
use crate::limits::StoreLimits;
use crate::query::{AnyConnection, Session};
use crate::{postgres, sqlite};

/// The backend of a store, and on whose behalf it is changed. Each of its methods makes one attempt; those of
/// [`crate::Store`] repeat what a database has ended in favour of another transaction.
#[derive(Clone)]
pub struct Database {
    pub(crate) backend: Backend,
    /// On whose behalf changes are recorded in the audit log.
    pub(crate) actor: Arc<Actor>,
}

#[derive(Clone)]
pub(crate) enum Backend {
    Sqlite(sqlite::Store),
    Postgres(postgres::Store),
}

/// The right to begin a transaction that changes something. In a data folder it is the lock of the one writer.
pub(crate) enum Writer<'s> {
    Sqlite(sqlite::WriterGuard<'s>),
    SqliteDeletion(sqlite::Deletion<'s>),
    Postgres(&'s PgPool, Durability),
}

/// A transaction; rolled back if it is dropped.
pub(crate) enum Transaction<'w> {
    /// Each of its statements sees the newest state.
    SqliteReader(PoolConnection<Sqlite>),
    Sqlite(sqlx::Transaction<'w, Sqlite>),
    Postgres(sqlx::Transaction<'static, sqlx::Postgres>),
}

impl Database {
    /// A transaction for one or several reads. In PostgreSQL they all see the same state.
    pub(crate) async fn reader(&self) -> Result<Transaction<'static>> {
        Ok(match &self.backend {
            Backend::Sqlite(store) => Transaction::SqliteReader(store.reader().await?),
            Backend::Postgres(store) => Transaction::Postgres(store.reader().await?),
        })
    }

    /// For a change that lets the database grow, and must be on the disk before it is acknowledged.
    pub(crate) async fn growing(&self) -> Result<Writer<'_>> {
        Ok(match &self.backend {
            Backend::Sqlite(store) => Writer::Sqlite(store.growing().await?),
            Backend::Postgres(store) => Writer::Postgres(store.pool(), Durability::Synced),
        })
    }

    /// For a change that also works when a data folder has reached its limit; with [`Durability::Relaxed`] a power
    /// cut (not a crash) may undo it.
    pub(crate) async fn changing(&self, durability: Durability) -> Result<Writer<'_>> {
        Ok(match &self.backend {
            Backend::Sqlite(store) => Writer::Sqlite(store.changing(durability).await?),
            Backend::Postgres(store) => Writer::Postgres(store.pool(), durability),
        })
    }

    /// As [`Database::changing`] with [`Durability::Synced`].
    pub(crate) async fn synced(&self) -> Result<Writer<'_>> {
        self.changing(Durability::Synced).await
    }

    /// As [`Database::changing`] with [`Durability::Relaxed`].
    pub(crate) async fn relaxed(&self) -> Result<Writer<'_>> {
        self.changing(Durability::Relaxed).await
    }

    /// For a deletion, which also works on a full disk.
    pub(crate) async fn deletion(&self) -> Result<Writer<'_>> {
        Ok(match &self.backend {
            Backend::Sqlite(store) => Writer::SqliteDeletion(store.deletion().await?),
            Backend::Postgres(store) => Writer::Postgres(store.pool(), Durability::Synced),
        })
    }

    pub(crate) fn limits(&self) -> &StoreLimits {
        match &self.backend {
            Backend::Sqlite(store) => store.limits(),
            Backend::Postgres(store) => store.limits(),
        }
    }

    /// The queue of samples that are committed in groups.
    pub(crate) fn sample_queue(&self) -> &GroupCommit {
        match &self.backend {
            Backend::Sqlite(store) => store.sample_queue(),
            Backend::Postgres(store) => store.sample_queue(),
        }
    }
}

impl Writer<'_> {
    pub(crate) async fn begin(&mut self) -> Result<Transaction<'_>> {
        Ok(match self {
            Self::Sqlite(writer) => Transaction::Sqlite(writer.begin().await?),
            Self::SqliteDeletion(deletion) => Transaction::Sqlite(deletion.begin().await?),
            Self::Postgres(pool, durability) => {
                Transaction::Postgres(postgres::begin_write(pool, *durability).await?)
            }
        })
    }

    /// To be called after the commit of a deletion: gives the freed space of a data folder back where its disk has none.
    pub(crate) async fn reclaim(self) {
        if let Self::SqliteDeletion(deletion) = self {
            deletion.reclaim().await;
        }
    }
}

impl Session for Transaction<'_> {
    fn connection(&mut self) -> AnyConnection<'_> {
        match self {
            Self::SqliteReader(connection) => AnyConnection::Sqlite(connection),
            Self::Sqlite(transaction) => AnyConnection::Sqlite(transaction),
            Self::Postgres(transaction) => AnyConnection::Postgres(transaction),
        }
    }
}

impl Transaction<'_> {
    /// Commits the changes; ends a reader.
    pub(crate) async fn commit(self) -> Result<()> {
        match self {
            Self::SqliteReader(_) => Ok(()),
            Self::Sqlite(transaction) => transaction.commit().await.map_err(sqlite::failed),
            Self::Postgres(transaction) => transaction.commit().await.map_err(postgres::failed),
        }
    }
}
