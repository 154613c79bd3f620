//! Opening the database: its settings, its schema, its writer and its readers.

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::sqlite::{
    SqliteAutoVacuum, SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{ConnectOptions, Connection, SqliteConnection, SqlitePool};
use tokio::time::Instant;

use super::errors::{is_busy, primary_code};
use super::writer::Writer;
use crate::domain::{Error, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};
use crate::schema;

/// How long to wait for another process that writes.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// How long opening is tried again while another process holds the file. Turning on the write-ahead log does
/// not wait by itself.
const OPEN_TIME: Duration = Duration::from_secs(8);
const OPEN_PAUSE: Duration = Duration::from_millis(50);

/// Reads that run at once; more wait.
const READERS: u32 = 4;
const READER_WAIT: Duration = Duration::from_secs(10);

/// Opens a database with its schema brought up to date. `max_pages` limits its size.
pub(super) async fn open(path: &Path, max_pages: Option<u32>) -> Result<(Writer, SqlitePool)> {
    let options = options(path);
    let mut writer = writer_options(options.clone());
    // Free pages can be given back to the disk in new files only: the setting is part of the file's format. In an
    // existing one it is no change, and yet a commit, which makes a full disk copy the log back.
    if std::fs::metadata(path).is_ok_and(|metadata| metadata.len() == 0) {
        writer = writer.auto_vacuum(SqliteAutoVacuum::Incremental);
    }
    let connection = open_writer(&writer).await.map_err(|cause| unusable(path, &cause))?;
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

/// The log is copied back every 16 MB, and is cut to that size after a large change.
fn writer_options(options: SqliteConnectOptions) -> SqliteConnectOptions {
    options
        .journal_mode(SqliteJournalMode::Wal)
        .pragma("cache_size", "-16000")
        .pragma("wal_autocheckpoint", "4000")
        .pragma("journal_size_limit", "16777216")
        .thread_name(|_| "store-writer".to_owned())
}

async fn open_writer(options: &SqliteConnectOptions) -> Result<SqliteConnection, MigrateError> {
    let began = Instant::now();
    loop {
        match connect_and_migrate(options).await {
            Err(MigrateError::Execute(error)) if is_busy(&error) && began.elapsed() < OPEN_TIME => {
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
    schema::SQLITE.run_direct(None, &mut *transaction, false).await?;
    transaction.commit().await?;
    Ok(connection)
}

/// The step that brings a schema to what this version knows.
pub(super) fn newest_step() -> i64 {
    schema::SQLITE.iter().map(|step| step.version).max().unwrap_or_default()
}

/// Why the file cannot be used, for the person who started the program.
fn unusable(path: &Path, cause: &MigrateError) -> Error {
    match cause {
        MigrateError::VersionMissing(step) => newer(path, *step),
        MigrateError::VersionMismatch(step) => FolderFault::error(
            FolderFaultKind::OtherSchema,
            format!(
                "{} has another schema in step {step}; it was made by a build that was never released",
                path.display()
            ),
        ),
        MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _) => cannot_open(path, error),
        _ => FolderFault::error(FolderFaultKind::Other, format!("cannot open {}: {cause}", path.display())),
    }
}

pub(super) fn newer(path: &Path, step: i64) -> Error {
    FolderFault::error(
        FolderFaultKind::OtherSchema,
        format!(
            "{} was written by a newer version of sightfix (its schema has step {step}); start that version, or \
             another folder",
            path.display()
        ),
    )
}

/// Why a database file cannot be opened or read, by SQLite's result code.
pub(super) fn cannot_open(path: &Path, error: &sqlx::Error) -> Error {
    use FolderFaultKind::{Damaged, InUse, NoSpace, NotWritable, Other};
    let path = path.display();
    let (kind, message) = match primary_code(error) {
        Some(8 | 14) => {
            (NotWritable, format!("{path} cannot be opened for writing; check the owner of folder and file"))
        }
        Some(26) => (Damaged, format!("{path} is not a database; move it away, or choose another folder")),
        Some(11) => {
            (Damaged, format!("{path} is damaged ({error}); restore a backup: sightfix restore FILE"))
        }
        Some(5 | 6) => (InUse, format!("{path} is held by another process")),
        Some(13) => (NoSpace, format!("no space is left for {path}")),
        _ => (Other, format!("cannot open {path}: {error}")),
    };
    FolderFault::error(kind, message)
}
