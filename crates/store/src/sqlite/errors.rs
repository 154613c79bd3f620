//! Conversion of database errors into errors of the domain.

use std::sync::atomic::{AtomicBool, Ordering};

use sqlx::error::DatabaseError;

use crate::domain::{Error, ErrorKind};
use crate::folder_fault::{FolderFault, FolderFaultKind};
use crate::refusals::closed;

/// SQLite's primary result code, if the error is SQLite's own.
pub(super) fn primary_code(error: &sqlx::Error) -> Option<u32> {
    let extended: u32 = error.as_database_error()?.code()?.parse().ok()?;
    Some(extended & 0xff)
}

/// SQLITE_BUSY and SQLITE_LOCKED: another connection holds the file.
pub(super) fn is_busy(error: &sqlx::Error) -> bool {
    matches!(primary_code(error), Some(5 | 6))
}

/// SQLITE_FULL, and SQLITE_IOERR_SHMSIZE: the index of the log cannot grow.
fn is_full(error: &sqlx::Error) -> bool {
    const IOERR_SHMSIZE: &str = "4874";
    let is_shm = |error: &dyn DatabaseError| error.code().is_some_and(|code| code == IOERR_SHMSIZE);
    primary_code(error) == Some(13) || error.as_database_error().is_some_and(is_shm)
}

/// A failed statement: refused where the caller can do something about it, else a fault.
pub(crate) fn failed(error: sqlx::Error) -> Error {
    match error {
        sqlx::Error::PoolClosed => closed(),
        sqlx::Error::PoolTimedOut => {
            Error::refused(ErrorKind::Overloaded, "too many reads are waiting for the store; try again")
        }
        busy if is_busy(&busy) => {
            Error::refused(ErrorKind::Overloaded, "another process holds the store; try again")
        }
        full if is_full(&full) => Error::refused(
            ErrorKind::InsufficientStorage,
            "the disk is full, or the database has reached limits.database_bytes; delete samples, models or \
             training runs, or give it more space",
        ),
        damaged if is_damaged(&damaged) => {
            DAMAGE_MET.store(true, Ordering::Relaxed);
            FolderFault::error(
                FolderFaultKind::Damaged,
                format!("the database is damaged ({damaged}); restore a backup: sightfix restore FILE"),
            )
        }
        other => Error::fault(other),
    }
}

/// One flag of the process, as the log is: a server has one store, and an error does not know its statement.
static DAMAGE_MET: AtomicBool = AtomicBool::new(false);

/// True if a statement has met a damaged page since the process was started.
pub(super) fn has_met_damage() -> bool {
    DAMAGE_MET.load(Ordering::Relaxed)
}

/// SQLITE_CORRUPT and SQLITE_NOTADB.
fn is_damaged(error: &sqlx::Error) -> bool {
    matches!(primary_code(error), Some(11 | 26))
}
