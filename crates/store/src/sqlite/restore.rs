//! A backup instead of a folder's database.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use tempfile::NamedTempFile;

use super::backup::{check_backup, not_written};
use super::backup_digest::BackupContent;
use super::file_check::DatabaseReport;
use super::folder::{DATABASE, flush_entries, prepare_folder};
use super::occupants::Presence;
use super::server_lock::{ServerLock, in_use};
use crate::domain::{Error, ErrorKind, Result};

/// The role of this process to others while it restores.
const ROLE: &str = "sightfix restore";

/// The rule for a backup that has no digest, so that nothing shows if a value in it was changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MissingDigest {
    /// It is refused.
    Refuse,
    /// It is restored.
    Accept,
}

/// The outcome of a restore.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// The contents of the backup.
    pub report: DatabaseReport,
    /// Where the database before it is kept, if there was one.
    pub kept: Option<PathBuf>,
}

/// Replaces a folder's database by a backup; the former is kept under another name. The folder is made if
/// there is none. Whenever the process is killed, the folder has either database, complete.
///
/// # Errors
/// [`ErrorKind::InvalidArgument`] for a backup without a digest, unless that is accepted; a
/// [`FolderFault`](super::FolderFault): the backup is damaged or of a newer version, the folder is in use by
/// another process, or cannot be written. Nothing has changed then.
pub async fn restore(
    folder: &Path,
    backup: &Path,
    missing: MissingDigest,
    now: Timestamp,
) -> Result<Restored> {
    let (report, content) = check_backup(backup).await?;
    if !content.is_proven && missing == MissingDigest::Refuse {
        return Err(no_digest(backup));
    }
    prepare_folder(folder).await?;
    let mut lock = ServerLock::acquire(folder)?;
    lock.announce(ROLE)?;
    let mut presence = Presence::announce(folder, ROLE).map_err(|error| not_written(folder, &error))?;
    let others = presence.newcomers().map_err(|error| not_written(folder, &error))?;
    if let Some(other) = others.first() {
        return Err(in_use(folder, Some(other)));
    }
    let database = folder.join(DATABASE);
    if database.exists() {
        fold_log(&database).await;
    }
    let kept = database.with_extension(format!("db.before-restore-{}", now.strftime("%Y%m%dT%H%M%SZ")));
    let backup = backup.to_owned();
    let replaced = tokio::task::spawn_blocking(move || replace(&database, (&backup, &content), &kept));
    let kept = replaced.await.map_err(Error::fault)??;
    Ok(Restored { report, kept })
}

fn no_digest(backup: &Path) -> Error {
    let message = format!(
        "{} has no digest, so a changed value in it would not be seen: it was made by another \
         program, or its end is cut off; take another backup, or restore it as it is with --without-digest",
        backup.display()
    );
    Error::refused(ErrorKind::InvalidArgument, message)
}

/// Copies the write-ahead log into the database and removes it. If that fails, because the database is damaged, the
/// log is kept beside the database.
async fn fold_log(database: &Path) {
    let options =
        SqliteConnectOptions::new().filename(database).create_if_missing(false).disable_statement_logging();
    let folded = async {
        let mut connection = options.connect().await?;
        sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&mut connection).await?;
        connection.close().await
    };
    if let Err(error) = folded.await {
        tracing::warn!(%error, "the database that is replaced is kept as it is, with its log");
    }
}

/// The old database has both names until the new one takes its place, so that a power cut leaves either.
fn replace(
    database: &Path,
    (backup, content): (&Path, &BackupContent),
    kept: &Path,
) -> Result<Option<PathBuf>> {
    let folder = database.parent().unwrap_or_else(|| Path::new("."));
    let failed = |error: io::Error| not_written(database, &error);
    let mut copy = NamedTempFile::with_prefix_in("restore.", folder).map_err(failed)?;
    content.copy(backup, &mut copy).and_then(|()| copy.as_file().sync_all()).map_err(failed)?;
    let had_database = database.exists();
    if had_database {
        if kept.exists() {
            let message = format!("{} exists; try again in a second", kept.display());
            return Err(Error::refused(ErrorKind::InvalidArgument, message));
        }
        fs::hard_link(database, kept).map_err(failed)?;
        for companion in ["-wal", "-shm"] {
            move_if_there(&with_suffix(database, companion), &with_suffix(kept, companion))
                .map_err(failed)?;
        }
    }
    copy.persist(database).map_err(|error| failed(error.error))?;
    flush_entries(folder).map_err(failed)?;
    Ok(had_database.then(|| kept.to_owned()))
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

fn move_if_there(from: &Path, to: &Path) -> io::Result<()> {
    match fs::rename(from, to) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        moved => moved,
    }
}
