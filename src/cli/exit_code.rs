//! The exit code of a command that failed, so that a supervisor knows whether to start it again.

use std::process::ExitCode;

use crate::domain::{Error, ErrorKind};
use crate::store::{FolderFault, FolderFaultKind};

/// The data folder is in use, or the server of the database does not answer; trying again later may help. Invalid flags are 2.
const IN_USE: u8 = 3;
/// The data folder cannot be used until somebody does something about it.
const UNUSABLE: u8 = 4;

/// Rows were imported, but more of them were rejected than the caller accepts.
const REJECTED: u8 = 5;

/// Why an import that stored rows is not a success; for people.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(super) struct TooManyRejected(pub(super) String);

/// The exit code for an error: 3 and 4 for a data folder or database, 5 for too many rejected rows, else 1.
#[must_use]
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    if error.is::<TooManyRejected>() {
        return ExitCode::from(REJECTED);
    }
    let fault = match error.downcast_ref::<Error>() {
        // The database has ended a connection, or has too much to do.
        Some(error) if error.kind() == ErrorKind::Overloaded => return ExitCode::from(IN_USE),
        Some(Error::Fault(fault)) => fault.cause::<FolderFault>(),
        _ => None,
    };
    match fault.map(|fault| fault.kind) {
        None => ExitCode::FAILURE,
        Some(FolderFaultKind::InUse | FolderFaultKind::Unreachable) => ExitCode::from(IN_USE),
        Some(_) => ExitCode::from(UNUSABLE),
    }
}
