//! Refusals and faults that every backend states alike.

use crate::domain::{CameraId, ConnectionId, Error, ErrorKind, EvaluationId, KeyId, PlaceId, RunId, SiteId};

/// A row that does not hold what was written: another program or the disk has changed it.
#[derive(Debug, thiserror::Error)]
#[error("the store is corrupt: table {table}, column {column}, row {row}: {cause}")]
pub(super) struct Corrupt {
    pub(super) table: &'static str,
    pub(super) column: String,
    pub(super) row: String,
    pub(super) cause: String,
}

/// A copy of an error, for another caller of the same transaction.
pub(super) fn copy_of(error: &Error) -> Error {
    match error {
        Error::Refused(refusal) => Error::Refused(refusal.clone()),
        Error::Fault(fault) => Error::fault(fault.to_string()),
    }
}

pub(super) fn closed() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server is ending; try again soon")
}

pub(super) fn no_camera(id: &CameraId) -> Error {
    Error::refused(ErrorKind::CameraNotFound, format!("no camera has the id {id}"))
}

pub(super) fn no_site(id: &SiteId) -> Error {
    Error::refused(ErrorKind::SiteNotFound, format!("no site has the id {id}"))
}

pub(super) fn no_place(id: &PlaceId) -> Error {
    Error::refused(ErrorKind::PlaceNotFound, format!("no place has the id {id}"))
}

pub(super) fn no_connection(id: &ConnectionId) -> Error {
    Error::refused(ErrorKind::ConnectionNotFound, format!("no connection has the id {id}"))
}

/// The refusal of a camera's profile that names a site.
pub(super) fn unknown_site(id: &SiteId) -> Error {
    Error::invalid("site", format!("is {id}, and no site has that id; create the site first"))
}

pub(super) fn no_run(id: RunId) -> Error {
    Error::refused(ErrorKind::RunNotFound, format!("no training run has the id {id}"))
}

pub(super) fn no_evaluation(id: EvaluationId) -> Error {
    Error::refused(ErrorKind::EvaluationNotFound, format!("no evaluation has the id {id}"))
}

pub(super) fn no_key(id: KeyId) -> Error {
    Error::refused(ErrorKind::KeyNotFound, format!("no key has the id {id}"))
}

pub(super) fn no_model(camera: &CameraId, number: u32) -> Error {
    Error::refused(ErrorKind::ModelNotFound, format!("camera {camera} has no model version {number}"))
}
