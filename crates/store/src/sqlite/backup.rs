//! A verified copy of the database, while a server may be using it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use tempfile::NamedTempFile;

use super::backup_digest::{self, BackupContent};
use super::connection::cannot_open;
use super::file_check::{DatabaseReport, FileUse, check_file, missing};
use super::folder::{DATABASE, flush_entries, parent_of};
use crate::domain::{Error, ErrorKind, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};

const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// The rule for a file that has the name of the backup.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExistingFile {
    /// Nothing: the backup is refused.
    Keep,
    /// It is replaced once the backup is complete.
    Replace,
}

/// Copies the database of a folder into one file: everything that was committed before the call, in one
/// consistent state. A server that uses the folder goes on reading and writing.
///
/// The copy has a temporary name beside `target` until it is written, found sound (SQLite's integrity check, the
/// checksums of the models), given its digest and flushed to the disk.
///
/// # Errors
/// [`ErrorKind::InvalidArgument`] for a target that exists; a [`FolderFault`] for a database that cannot be read, or
/// a target that cannot be written.
pub async fn back_up(folder: &Path, target: &Path, existing: ExistingFile) -> Result<DatabaseReport> {
    let source = folder.join(DATABASE);
    if !source.is_file() {
        return Err(missing(folder));
    }
    let target = std::path::absolute(target).map_err(|error| not_written(target, &error))?;
    if existing == ExistingFile::Keep && target.exists() {
        return Err(exists(&target));
    }
    let copy = tempfile::Builder::new().prefix(".sightfix-backup-").tempfile_in(parent_of(&target));
    let copy = copy.map_err(|error| not_written(&target, &error))?;
    copy_database(&source, copy.path()).await?;
    let report = check_file(copy.path(), FileUse::Unused).await?;
    report.ensure_sound(&source)?;
    tokio::task::spawn_blocking(move || publish(copy, target, existing)).await.map_err(Error::fault)??;
    Ok(report)
}

/// Copies with one read transaction, which does not keep writers waiting.
async fn copy_database(source: &Path, copy: &Path) -> Result<()> {
    let Some(copy) = copy.to_str() else {
        return Err(Error::refused(ErrorKind::InvalidArgument, "the path of the backup must be UTF-8"));
    };
    let options = SqliteConnectOptions::new()
        .filename(source)
        .create_if_missing(false)
        .busy_timeout(BUSY_TIMEOUT)
        .disable_statement_logging();
    let mut connection = options.connect().await.map_err(|error| cannot_open(source, &error))?;
    let copied = sqlx::query("VACUUM INTO ?").bind(copy).execute(&mut connection).await;
    // Nothing was written to the source that closing could lose.
    let _ = connection.close().await;
    copied.map(drop).map_err(|error| cannot_open(source, &error))
}

fn publish(mut copy: NamedTempFile, target: PathBuf, existing: ExistingFile) -> Result<()> {
    backup_digest::append(copy.as_file_mut())
        .and_then(|()| copy.as_file().sync_all())
        .map_err(|error| not_written(&target, &error))?;
    let published = match existing {
        ExistingFile::Replace => copy.persist(&target),
        ExistingFile::Keep => copy.persist_noclobber(&target),
    };
    published.map_err(|error| not_written(&target, &error.error))?;
    flush_entries(parent_of(&target)).map_err(|error| not_written(&target, &error))
}

/// The contents of a backup, and the proof by its digest that it is what was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BackupReport {
    /// The contents of the database in it.
    pub report: DatabaseReport,
    /// True if it has a digest, as all backups have but those of other programs.
    pub has_digest: bool,
}

/// Reads and checks a whole backup: its structure, the checksums of the models, and its digest.
///
/// # Errors
/// A [`FolderFault`] if it cannot be read, is damaged, or was written by a newer version.
pub async fn inspect_backup(path: &Path) -> Result<BackupReport> {
    let (report, content) = check_backup(path).await?;
    Ok(BackupReport { report, has_digest: content.is_proven })
}

/// As [`inspect_backup`], with the part of the file that is the database.
pub(super) async fn check_backup(path: &Path) -> Result<(DatabaseReport, BackupContent)> {
    let report = check_file(path, FileUse::Unused).await?;
    report.ensure_sound(path)?;
    let path = path.to_owned();
    let read = tokio::task::spawn_blocking(move || backup_digest::read(&path));
    Ok((report, read.await.map_err(Error::fault)??))
}

fn exists(target: &Path) -> Error {
    let message = format!("{} exists; choose another name, or replace it with --replace", target.display());
    Error::refused(ErrorKind::InvalidArgument, message)
}

pub(super) fn not_written(path: &Path, error: &std::io::Error) -> Error {
    let kind = match error.kind() {
        std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => FolderFaultKind::NoSpace,
        _ => FolderFaultKind::NotWritable,
    };
    FolderFault::error(kind, format!("{} cannot be written: {error}", path.display()))
}
