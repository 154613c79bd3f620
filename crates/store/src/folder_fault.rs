//! Why a data folder cannot be used, as a type that commands turn into an exit code.

use crate::domain::Error;

/// The kinds of faults of a data folder, or of the database used instead of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FolderFaultKind {
    /// Another process holds it; it may be tried again later.
    InUse,
    /// The server of the database does not answer; it may be tried again later.
    Unreachable,
    /// There is no database, or no folder.
    Missing,
    /// The folder or the database cannot be written.
    NotWritable,
    /// The database was written by a newer version, or by a build that was never released.
    OtherSchema,
    /// The database is damaged, or the file is none.
    Damaged,
    /// The disk is full.
    NoSpace,
    /// Anything else.
    Other,
}

/// A fault of a data folder, in a sentence for the person who operates the server.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct FolderFault {
    /// The kind of fault.
    pub kind: FolderFaultKind,
    message: String,
}

impl FolderFault {
    pub(super) fn new(kind: FolderFaultKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into() }
    }

    /// As the error that the store's methods give.
    pub(super) fn error(kind: FolderFaultKind, message: impl Into<String>) -> Error {
        Error::fault(Self::new(kind, message))
    }
}
