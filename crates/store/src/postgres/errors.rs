//! Conversion of database errors into errors of the domain.

use crate::domain::{Error, ErrorKind};
use crate::refusals::closed;

const CONFLICT: &str = "another change came in between; try again";

/// What a failed statement means to its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Meaning {
    /// The same call may work in a moment.
    TryAgain(&'static str),
    /// The database's disk is full.
    Full,
    Fault,
}

/// By SQLSTATE (PostgreSQL, appendix A).
fn meaning(code: &str) -> Meaning {
    match code {
        "53100" => Meaning::Full,
        "40001" | "40P01" | "23503" => Meaning::TryAgain(CONFLICT),
        "55P03" | "57014" => Meaning::TryAgain("the database is busy; try again"),
        "25P03" | "57P01" | "57P02" | "57P03" | "57P05" => {
            Meaning::TryAgain("the database has ended the connection; try again")
        }
        code if code.starts_with("08") || code.starts_with("53") => {
            Meaning::TryAgain("the database takes no more connections or has no resources left; try again")
        }
        _ => Meaning::Fault,
    }
}

/// A failed statement: refused where the caller can do something about it, else a fault. Why a change was refused
/// for now is logged here, for the refusal does not say it.
pub(super) fn failed(error: sqlx::Error) -> Error {
    let meaning = match &error {
        sqlx::Error::PoolClosed => return closed(),
        sqlx::Error::PoolTimedOut => {
            Meaning::TryAgain("too many calls are waiting for the database; try again")
        }
        sqlx::Error::Io(_) | sqlx::Error::Tls(_) | sqlx::Error::BeginFailed => {
            Meaning::TryAgain("the database cannot be reached; try again")
        }
        sqlx::Error::Database(error) => error.code().map_or(Meaning::Fault, |code| meaning(&code)),
        _ => Meaning::Fault,
    };
    match meaning {
        Meaning::TryAgain(message) => {
            tracing::warn!(%error, "the database did not complete a transaction");
            Error::refused(ErrorKind::Overloaded, message)
        }
        Meaning::Full => Error::refused(
            ErrorKind::InsufficientStorage,
            "the disk of the database is full; delete samples, models or training runs, or give it more space",
        ),
        Meaning::Fault => Error::fault(error),
    }
}

/// Whether the database has ended a transaction in favour of another one, by which nothing of it was done.
pub(super) fn is_conflict(error: &Error) -> bool {
    error.kind() == ErrorKind::Overloaded && error.to_string().contains(CONFLICT)
}
