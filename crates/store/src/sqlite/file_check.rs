//! The contents and the integrity of a database file: for backups, restores and `sightfix doctor`.

use std::path::Path;

use futures_util::TryStreamExt as _;
use jiff::Timestamp;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, SqliteConnection};

use super::connection::{cannot_open, newer, newest_step};
use super::folder::DATABASE;
use crate::domain::{Error, Result, model_sha256};
use crate::folder_fault::{FolderFault, FolderFaultKind};

/// Steps of the schema that brought what is read here.
const CHECKSUMS_STEP: i64 = 5;
const BOXES_WITHOUT_FIX_STEP: i64 = 7;

/// The contents of a database file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DatabaseReport {
    /// Step of its schema.
    pub schema_step: i64,
    /// Step to which this version brings a schema.
    pub newest_step: i64,
    /// Size of the file, without its write-ahead log.
    pub bytes: u64,
    /// Number of cameras.
    pub cameras: u64,
    /// Samples, with a fix or without.
    pub samples: u64,
    /// Number of model versions.
    pub models: u64,
    /// Time of the latest sample.
    pub latest_sample_at: Option<Timestamp>,
    /// The findings of SQLite's integrity check; empty for a sound file.
    pub problems: Vec<String>,
    /// Model versions that do not match their checksums.
    pub damaged_models: Vec<String>,
}

impl DatabaseReport {
    /// # Errors
    /// A [`FolderFault`] that names the first thing that is damaged in the file.
    pub(super) fn ensure_sound(&self, path: &Path) -> Result<()> {
        let path = path.display();
        let damaged = |message| Err(FolderFault::error(FolderFaultKind::Damaged, message));
        match (self.problems.first(), self.damaged_models.first()) {
            (Some(problem), _) => damaged(format!("{path} is damaged: {problem}")),
            (None, Some(model)) => damaged(format!(
                "{path}: the model {model} does not match its checksum; activate another version and delete this one"
            )),
            (None, None) => Ok(()),
        }
    }
}

/// States if other processes may be using a database file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FileUse {
    /// Nobody does, as with a backup: nothing is created beside it.
    Unused,
    /// A server may be writing to it.
    Shared,
}

/// Reads and checks the whole database of a data folder, beside a server that may be using it. Nothing is
/// changed, nor is an older schema brought up to date.
///
/// # Errors
/// A [`FolderFault`] if it cannot be read.
pub async fn inspect(folder: &Path) -> Result<DatabaseReport> {
    check_file(&folder.join(DATABASE), FileUse::Shared).await
}

/// Reads and checks a whole database file.
///
/// # Errors
/// A [`FolderFault`] if it cannot be read, or was written by a newer version.
pub(super) async fn check_file(path: &Path, file_use: FileUse) -> Result<DatabaseReport> {
    let bytes = match std::fs::metadata(path) {
        Ok(metadata) => metadata.len(),
        Err(error) => {
            let message = format!("{} cannot be read: {error}", path.display());
            return Err(FolderFault::error(FolderFaultKind::Missing, message));
        }
    };
    let options =
        SqliteConnectOptions::new().filename(path).create_if_missing(false).disable_statement_logging();
    let options = match file_use {
        FileUse::Unused => options.read_only(true).immutable(true),
        FileUse::Shared => options.pragma("query_only", "ON"),
    };
    let mut connection = options.connect().await.map_err(|error| cannot_open(path, &error))?;
    let report = read(&mut connection, bytes).await.map_err(|error| cannot_open(path, &error));
    // Nothing was written that closing could lose.
    let _ = connection.close().await;
    let report = report?.ok_or_else(|| {
        let message = format!("{} is not a database of sightfix", path.display());
        FolderFault::error(FolderFaultKind::OtherSchema, message)
    })?;
    if report.schema_step > report.newest_step {
        return Err(newer(path, report.schema_step));
    }
    Ok(report)
}

/// `None` for a database without the tables of this program.
async fn read(connection: &mut SqliteConnection, bytes: u64) -> sqlx::Result<Option<DatabaseReport>> {
    let problems: Vec<String> =
        sqlx::query_scalar("PRAGMA integrity_check(10)").fetch_all(&mut *connection).await?;
    let tables: i64 =
        count(connection, "SELECT count(*) FROM sqlite_schema WHERE name = '_sqlx_migrations'").await?;
    if tables == 0 {
        return Ok(None);
    }
    let schema_step: i64 = sqlx::query_scalar("SELECT coalesce(max(version), 0) FROM _sqlx_migrations")
        .fetch_one(&mut *connection)
        .await?;
    let newest_step = newest_step();
    let mut report = DatabaseReport {
        schema_step,
        newest_step,
        bytes,
        cameras: 0,
        samples: 0,
        models: 0,
        latest_sample_at: None,
        problems: problems.into_iter().filter(|line| line != "ok").collect(),
        damaged_models: Vec::new(),
    };
    // Counting in tables that are damaged or unknown would only fail.
    if report.problems.is_empty() && (1..=newest_step).contains(&schema_step) {
        read_contents(connection, &mut report).await?;
    }
    Ok(Some(report))
}

async fn read_contents(connection: &mut SqliteConnection, report: &mut DatabaseReport) -> sqlx::Result<()> {
    let as_count = |count: i64| u64::try_from(count).unwrap_or_default();
    report.cameras = as_count(count(connection, "SELECT count(*) FROM cameras").await?);
    report.samples = as_count(count(connection, "SELECT count(*) FROM samples").await?);
    report.models = as_count(count(connection, "SELECT count(*) FROM models").await?);
    if report.schema_step >= BOXES_WITHOUT_FIX_STEP {
        report.samples += as_count(count(connection, "SELECT count(*) FROM samples_without_fix").await?);
    }
    // The primary key begins with the camera, so that the latest of each is found without a scan.
    let latest_us: Option<i64> = sqlx::query_scalar(
        "SELECT max((SELECT max(time_us) FROM samples WHERE camera_key = cameras.key)) FROM cameras",
    )
    .fetch_one(&mut *connection)
    .await?;
    report.latest_sample_at = latest_us.and_then(|us| Timestamp::from_microsecond(us).ok());
    if report.schema_step >= CHECKSUMS_STEP {
        report.damaged_models = damaged_models(connection).await?;
    }
    Ok(())
}

async fn count(connection: &mut SqliteConnection, sql: &'static str) -> sqlx::Result<i64> {
    sqlx::query_scalar(sql).fetch_one(connection).await
}

async fn damaged_models(connection: &mut SqliteConnection) -> sqlx::Result<Vec<String>> {
    let mut damaged = Vec::new();
    let mut models = sqlx::query_as::<_, (String, i64, Vec<u8>, Vec<u8>, String)>(
        "SELECT cameras.id, number, CAST(metadata AS BLOB), weights, sha256 FROM models \
         JOIN cameras ON cameras.key = camera_key",
    )
    .fetch(connection);
    while let Some((camera, number, document, weights, sha256)) = models.try_next().await? {
        if sha256 != model_sha256(&document, &weights) {
            damaged.push(format!("version {number} of camera {camera}"));
        }
    }
    Ok(damaged)
}

/// True if a folder has a database.
#[must_use]
pub fn has_database(folder: &Path) -> bool {
    folder.join(DATABASE).exists()
}

/// As the errors of the store for a folder without a database.
pub(super) fn missing(folder: &Path) -> Error {
    let message = format!("there is no database in {}", folder.display());
    FolderFault::error(FolderFaultKind::Missing, message)
}
