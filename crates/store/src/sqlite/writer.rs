//! The one connection that writes, and its transactions.

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, Sqlite, SqliteConnection, Transaction};
use tokio::sync::{Mutex, MutexGuard};

use super::errors::{failed, is_busy};
use crate::domain::{Durability, Result};
use crate::refusals::closed;

/// Pages above the database's limit that are left to transactions other than growing ones.
const HEADROOM_PAGES: u32 = 256;

/// The effect of a transaction on the size of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Growth {
    /// Stores what clients send, up to the database's limit.
    Limited,
    /// Changes the state of jobs, or deletes: also works when the limit has been reached.
    Headroom,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct ConnectionMode {
    durability: Durability,
    growth: Growth,
}

/// The writing connection; a writer locks it.
pub(super) struct Writer {
    options: SqliteConnectOptions,
    /// Limit of the database's size.
    max_pages: Option<u32>,
    open: Mutex<Option<OpenConnection>>,
}

struct OpenConnection {
    connection: SqliteConnection,
    /// The mode of the connection; `None` while it is being changed, so that a caller that is
    /// cancelled half way leaves no wrong assumption.
    mode: Option<ConnectionMode>,
    /// A transaction could not begin, and no other process held the file.
    broken: bool,
}

impl OpenConnection {
    const fn new(connection: SqliteConnection) -> Self {
        Self { connection, mode: None, broken: false }
    }

    /// True if the library assumes a transaction that does not exist. That happens when the database
    /// ends one by itself (a full disk, an I/O error): the library's own end of it then fails.
    async fn is_stuck(&mut self) -> Result<bool, sqlx::Error> {
        if self.connection.is_in_transaction() {
            // Commands are executed in order, so this waits for a roll back that is under way.
            self.connection.ping().await?;
        }
        Ok(self.connection.is_in_transaction())
    }

    async fn set(&mut self, mode: ConnectionMode, max_pages: Option<u32>) -> Result<(), sqlx::Error> {
        if self.mode == Some(mode) {
            return Ok(());
        }
        let before = self.mode.take();
        if before.is_none_or(|before| before.durability != mode.durability) {
            let pragma = match mode.durability {
                Durability::Relaxed => "PRAGMA synchronous = NORMAL",
                Durability::Synced => "PRAGMA synchronous = FULL",
            };
            sqlx::query(pragma).execute(&mut self.connection).await?;
        }
        if let Some(limit) = max_pages
            && before.is_none_or(|before| before.growth != mode.growth)
        {
            let pages = match mode.growth {
                Growth::Limited => limit,
                Growth::Headroom => limit.saturating_add(HEADROOM_PAGES),
            };
            let pragma = sqlx::AssertSqlSafe(format!("PRAGMA max_page_count = {pages}"));
            sqlx::query(pragma).execute(&mut self.connection).await?;
        }
        self.mode = Some(mode);
        Ok(())
    }
}

/// The writer, locked.
pub(crate) struct WriterGuard<'w> {
    writer: &'w Writer,
    open: MutexGuard<'w, Option<OpenConnection>>,
    mode: ConnectionMode,
}

impl Writer {
    pub(super) fn new(
        options: SqliteConnectOptions,
        max_pages: Option<u32>,
        connection: SqliteConnection,
    ) -> Self {
        Self { options, max_pages, open: Mutex::new(Some(OpenConnection::new(connection))) }
    }

    /// How its connection is opened, for another one that writes.
    pub(super) fn options(&self) -> SqliteConnectOptions {
        self.options.clone()
    }

    /// Waits for the writer; durability and growth are those of the transactions of this guard.
    pub(super) async fn lock(&self, durability: Durability, growth: Growth) -> Result<WriterGuard<'_>> {
        let open = self.open.lock().await;
        if open.is_none() {
            return Err(closed());
        }
        Ok(WriterGuard { writer: self, open, mode: ConnectionMode { durability, growth } })
    }

    /// Copies the write-ahead log back into the file and closes it.
    pub(super) async fn close(&self) {
        let Some(mut open) = self.open.lock().await.take() else { return };
        // Another process may be reading; then the log stays, which loses nothing.
        if let Err(error) = sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&mut open.connection).await
        {
            tracing::debug!(%error, "the write-ahead log stays");
        }
        if let Err(error) = open.connection.close().await {
            tracing::warn!(%error, "closing the store");
        }
    }
}

impl WriterGuard<'_> {
    /// Sets the durability of the transactions that begin from now on.
    pub(super) const fn set_durability(&mut self, durability: Durability) {
        self.mode.durability = durability;
    }

    /// A transaction that holds the file's write lock from its start; rolled back if dropped.
    pub(crate) async fn begin(&mut self) -> Result<Transaction<'_, Sqlite>> {
        let open = self.ready().await?;
        match open.connection.begin_with("BEGIN IMMEDIATE").await {
            Ok(transaction) => Ok(transaction),
            Err(error) => {
                open.broken = !is_busy(&error);
                Err(failed(error))
            }
        }
    }

    /// Runs a statement that manages its own transaction.
    pub(super) async fn execute(&mut self, sql: &'static str) -> Result<()> {
        let open = self.ready().await?;
        sqlx::query(sql).execute(&mut open.connection).await.map_err(failed)?;
        Ok(())
    }

    /// The connection, opened again if it cannot be used any more, and set to the guard's mode.
    async fn ready(&mut self) -> Result<&mut OpenConnection> {
        let open = self.open.as_mut().ok_or_else(closed)?;
        // An error here means a connection that cannot be used any more.
        if open.broken || open.is_stuck().await.unwrap_or(true) {
            *open = OpenConnection::new(self.writer.options.connect().await.map_err(failed)?);
        }
        if let Err(error) = open.set(self.mode, self.writer.max_pages).await {
            open.broken = true;
            return Err(failed(error));
        }
        Ok(open)
    }
}
