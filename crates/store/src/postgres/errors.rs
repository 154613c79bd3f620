//! Conversion of database errors into errors of the domain, and the repetition of what the database has ended.

use std::time::Duration;

use sqlx::error::DatabaseError;
use sqlx::postgres::{PgDatabaseError, PgSeverity};

use crate::domain::{Error, ErrorKind, Refusal};
use crate::refusals::closed;

/// Attempts of one call whose transactions the database ends in favour of others.
const ATTEMPTS: u32 = 5;
/// Before the second attempt; before each further one so much more.
const PAUSE: Duration = Duration::from_millis(10);

/// SQLSTATE of an error that has no code of its own.
const INTERNAL_ERROR: &str = "XX000";
const ENDED: &str = "the database has ended the connection; try again";

/// The meaning of a failed statement for its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Meaning {
    /// The database has ended the transaction in favour of another one; nothing of it was done.
    Conflict,
    /// The same call may work in a moment.
    TryAgain(&'static str),
    /// The database's disk is full.
    Full,
    Fault,
}

/// By SQLSTATE (PostgreSQL, appendix A).
fn meaning_of_code(code: &str) -> Meaning {
    match code {
        "53100" => Meaning::Full,
        "40001" | "40P01" | "23503" => Meaning::Conflict,
        "55P03" | "57014" => Meaning::TryAgain("the database is busy; try again"),
        "25006" => {
            Meaning::TryAgain("the database takes no changes now: it is a standby, or read-only; try again")
        }
        "25P03" | "57P01" | "57P02" | "57P03" | "57P05" => Meaning::TryAgain(ENDED),
        code if code.starts_with("08") || code.starts_with("53") => {
            Meaning::TryAgain("the database takes no more connections or has no resources left; try again")
        }
        _ => Meaning::Fault,
    }
}

pub(super) fn meaning(error: &sqlx::Error) -> Meaning {
    match error {
        sqlx::Error::PoolTimedOut => {
            Meaning::TryAgain("too many calls are waiting for the database; try again")
        }
        // A balancer without a server closes what it has accepted: the library then misses an answer of the protocol.
        sqlx::Error::Io(_) | sqlx::Error::Tls(_) | sqlx::Error::Protocol(_) | sqlx::Error::BeginFailed => {
            Meaning::TryAgain("the database cannot be reached; try again")
        }
        sqlx::Error::Database(error) => match error.code().as_deref() {
            // As when a new connection's cache of the catalogue finds no room on the disk.
            Some(INTERNAL_ERROR) if is_fatal(&**error) => Meaning::TryAgain(ENDED),
            Some(code) => meaning_of_code(code),
            None => Meaning::Fault,
        },
        _ => Meaning::Fault,
    }
}

/// True if the error has ended the connection.
fn is_fatal(error: &dyn DatabaseError) -> bool {
    let error = error.try_downcast_ref::<PgDatabaseError>();
    error.is_some_and(|error| matches!(error.severity(), PgSeverity::Fatal | PgSeverity::Panic))
}

/// A failed statement: refused where the caller can do something about it, else a fault. Why a change was refused
/// for now is logged here, for the refusal does not say it.
pub(crate) fn failed(error: sqlx::Error) -> Error {
    if matches!(error, sqlx::Error::PoolClosed) {
        return closed();
    }
    match meaning(&error) {
        Meaning::Conflict => {
            tracing::debug!(%error, "the database ended a transaction in favour of another one");
            Error::repeatable(ErrorKind::Overloaded, "another change came in between; try again")
        }
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

/// Attempts of one call. Of transactions that wait for each other the database ends one, which may be any of them and
/// is made again.
#[derive(Default)]
pub(crate) struct Attempts(u32);

impl Attempts {
    /// True if a call is to be made again, after a pause.
    pub(crate) async fn again(&mut self, error: Option<&Error>) -> bool {
        let is_repeatable = matches!(error, Some(Error::Refused(Refusal { may_repeat: true, .. })));
        self.0 += 1;
        if !is_repeatable {
            return false;
        }
        if self.0 == ATTEMPTS {
            tracing::warn!(
                attempts = ATTEMPTS,
                "the database ended every attempt in favour of other transactions"
            );
            return false;
        }
        tokio::time::sleep(PAUSE * self.0).await;
        true
    }
}

/// Makes a call again as long as the database ends its transaction in favour of another one.
macro_rules! repeated {
    ($call:expr) => {{
        let mut attempts = $crate::postgres::Attempts::default();
        loop {
            let done: $crate::domain::Result<_> = $call.await;
            if !attempts.again(done.as_ref().err()).await {
                break done;
            }
        }
    }};
}
pub(crate) use repeated;
