//! Opening the database: its settings, its schema, its writer and its readers.

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{
    SqliteAutoVacuum, SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{ConnectOptions, Connection, SqliteConnection, SqlitePool};

use super::errors::{is_busy, primary_code};
use super::folder;
use super::writer::Writer;
use crate::domain::{Error, Result};

/// How long to wait for another process that writes.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// Turning on the write-ahead log does not wait for other processes by itself, so it is tried again.
const OPEN_ATTEMPTS: u32 = 20;
const OPEN_PAUSE: Duration = Duration::from_millis(50);

/// Reads that run at once; more wait.
const READERS: u32 = 4;
const READER_WAIT: Duration = Duration::from_secs(10);

static MIGRATIONS: Migrator = sqlx::migrate!("migrations/sqlite");

/// Opens the database of a folder with its schema brought up to date. `max_pages` limits its size.
pub(super) async fn open(folder: &Path, max_pages: Option<u32>) -> Result<(Writer, SqlitePool)> {
    let path = folder::prepare(folder).await?;
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
    Ok((Writer::new(writer, max_pages, connection), readers))
}

fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .foreign_keys(true)
        .busy_timeout(BUSY_TIMEOUT)
        .synchronous(SqliteSynchronous::Full)
        .pragma("temp_store", "MEMORY")
        .disable_statement_logging()
}

/// The log is copied back every 16 MB, and is cut to that size after a large change. Free pages can
/// be given back to the disk in new files only: the setting is part of the file's format.
fn writer_options(options: SqliteConnectOptions) -> SqliteConnectOptions {
    options
        .auto_vacuum(SqliteAutoVacuum::Incremental)
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

/// All missing steps in one transaction: two processes that start at once do not interfere, and a step
/// that fails leaves the file as it was.
async fn connect_and_migrate(options: &SqliteConnectOptions) -> Result<SqliteConnection, MigrateError> {
    let mut connection = options.connect().await?;
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    MIGRATIONS.run_direct(None, &mut *transaction, false).await?;
    transaction.commit().await?;
    Ok(connection)
}

/// Why the file cannot be used, for the person who started the program.
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
