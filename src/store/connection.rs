//! The file: opening it, its schema, its one writer and its readers.

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, Sqlite, SqliteConnection, SqlitePool, Transaction};
use tokio::sync::{Mutex, MutexGuard};

use super::faults::{closed, failed, is_busy, primary_code};
use crate::domain::{Error, Result};

const FILE_NAME: &str = "sightfix.db";

/// How long to wait for another process that writes.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// Turning on the write-ahead log does not wait for others by itself, so opening is tried again.
const OPEN_ATTEMPTS: u32 = 20;
const OPEN_PAUSE: Duration = Duration::from_millis(50);

/// Reads that run at once; more wait.
const READERS: u32 = 4;
const READER_WAIT: Duration = Duration::from_secs(10);

static MIGRATIONS: Migrator = sqlx::migrate!("migrations/sqlite");

/// What has happened when a change is acknowledged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Durability {
    /// It survives a crash of the process; a power cut may undo the latest.
    Relaxed,
    /// It is on the disk.
    Synced,
}

/// The one connection that writes. Whoever writes takes a turn.
pub(super) struct Writer {
    options: SqliteConnectOptions,
    open: Mutex<Option<Open>>,
}

struct Open {
    connection: SqliteConnection,
    /// `None` while a change of it is under way, so that a caller who goes away leaves no wrong belief.
    durability: Option<Durability>,
    /// A transaction could not begin, and nobody else held the file.
    broken: bool,
}

impl Open {
    const fn new(connection: SqliteConnection) -> Self {
        Self { connection, durability: None, broken: false }
    }

    /// Whether the library believes in a transaction that is not there. That happens when the database
    /// ends one by itself (a full disk, an I/O error): the library's own end of it then fails.
    async fn is_stuck(&mut self) -> Result<bool, sqlx::Error> {
        if self.connection.is_in_transaction() {
            // Commands are worked off in order, so this waits for a roll back that is under way.
            self.connection.ping().await?;
        }
        Ok(self.connection.is_in_transaction())
    }

    async fn set(&mut self, durability: Durability) -> Result<(), sqlx::Error> {
        if self.durability == Some(durability) {
            return Ok(());
        }
        self.durability = None;
        let pragma = match durability {
            Durability::Relaxed => "PRAGMA synchronous = NORMAL",
            Durability::Synced => "PRAGMA synchronous = FULL",
        };
        sqlx::query(pragma).execute(&mut self.connection).await?;
        self.durability = Some(durability);
        Ok(())
    }
}

/// The writer, held.
pub(super) struct Turn<'w> {
    options: &'w SqliteConnectOptions,
    open: MutexGuard<'w, Option<Open>>,
    durability: Durability,
}

impl Writer {
    /// Waits for the writer; `durability` is that of the transactions of this turn.
    pub(super) async fn turn(&self, durability: Durability) -> Result<Turn<'_>> {
        let open = self.open.lock().await;
        if open.is_none() {
            return Err(closed());
        }
        Ok(Turn { options: &self.options, open, durability })
    }

    /// Writes the log back into the file and closes it.
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

impl Turn<'_> {
    /// A transaction that holds the file's write lock from its first moment; rolled back if dropped.
    pub(super) async fn begin(&mut self) -> Result<Transaction<'_, Sqlite>> {
        let open = self.open.as_mut().ok_or_else(closed)?;
        // An error here means a connection that is of no more use.
        if open.broken || open.is_stuck().await.unwrap_or(true) {
            *open = Open::new(self.options.connect().await.map_err(failed)?);
        }
        if let Err(error) = open.set(self.durability).await {
            open.broken = true;
            return Err(failed(error));
        }
        match open.connection.begin_with("BEGIN IMMEDIATE").await {
            Ok(transaction) => Ok(transaction),
            Err(error) => {
                open.broken = !is_busy(&error);
                Err(failed(error))
            }
        }
    }
}

/// Opens the file of a folder with its schema brought up to date.
pub(super) async fn open(folder: &Path) -> Result<(Writer, SqlitePool)> {
    tokio::fs::create_dir_all(folder)
        .await
        .map_err(|error| Error::fault(format!("cannot make the folder {}: {error}", folder.display())))?;
    let path = folder.join(FILE_NAME);
    let options = options(&path);
    let writer = writer_options(options.clone());
    let connection = open_writer(&writer).await.map_err(|cause| unusable(&path, &cause))?;
    let readers = SqlitePoolOptions::new()
        .max_connections(READERS)
        .acquire_timeout(READER_WAIT)
        .test_before_acquire(false)
        .idle_timeout(None)
        .max_lifetime(None)
        .connect_lazy_with(options.create_if_missing(false).pragma("query_only", "ON").row_buffer_size(512));
    Ok((Writer { options: writer, open: Mutex::new(Some(Open::new(connection))) }, readers))
}

fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .foreign_keys(true)
        .busy_timeout(BUSY_TIMEOUT)
        .synchronous(SqliteSynchronous::Normal)
        .pragma("temp_store", "MEMORY")
        .disable_statement_logging()
}

/// The log is written back every 16 MB, and is cut to that size after a large change.
fn writer_options(options: SqliteConnectOptions) -> SqliteConnectOptions {
    options
        .journal_mode(SqliteJournalMode::Wal)
        .pragma("cache_size", "-16000")
        .pragma("wal_autocheckpoint", "4000")
        .pragma("journal_size_limit", "16777216")
        .thread_name(|_| "store-writer".to_owned())
}

async fn open_writer(options: &SqliteConnectOptions) -> Result<SqliteConnection, MigrateError> {
    let mut attempt = 1;
    loop {
        match connect_and_migrate(options).await {
            Err(MigrateError::Execute(error)) if is_busy(&error) && attempt < OPEN_ATTEMPTS => {
                attempt += 1;
                tokio::time::sleep(OPEN_PAUSE).await;
            }
            other => return other,
        }
    }
}

/// All missing steps in one transaction: two processes that start at once do not meet, and a step that
/// fails leaves the file as it was.
async fn connect_and_migrate(options: &SqliteConnectOptions) -> Result<SqliteConnection, MigrateError> {
    let mut connection = options.connect().await?;
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    MIGRATIONS.run_direct(None, &mut *transaction, false).await?;
    transaction.commit().await?;
    Ok(connection)
}

/// Why the file cannot be used, for whoever started the program.
fn unusable(path: &Path, cause: &MigrateError) -> Error {
    let path = path.display();
    let code = match cause {
        MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _) => primary_code(error),
        _ => None,
    };
    Error::fault(match (cause, code) {
        (MigrateError::VersionMissing(step), _) => format!(
            "{path} was written by a newer version of sightfix (its schema has step {step}); start that \
             version, or another folder"
        ),
        (MigrateError::VersionMismatch(step), _) => {
            format!(
                "{path} has another schema in step {step}; it was made by a build that was never released"
            )
        }
        (_, Some(8 | 14)) => {
            format!("{path} cannot be opened for writing; check the owner of folder and file")
        }
        (_, Some(26)) => format!("{path} is not a database; move it away, or choose another folder"),
        (_, Some(5 | 6)) => format!("{path} is held by another process"),
        (_, Some(13)) => format!("no space is left for {path}"),
        _ => format!("cannot open {path}: {cause}"),
    })
}
