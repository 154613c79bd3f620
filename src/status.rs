//! The one table from an error's kind to the status on each transport.

use crate::domain::ErrorKind;

/// How an error kind is reported to a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Status {
    /// Status of the HTTP answer.
    pub http: u16,
    /// Number of the gRPC status code.
    pub grpc: i32,
    /// Last part of the problem's `type` and the `reason` of gRPC's `ErrorInfo`; stable.
    pub slug: &'static str,
    /// Title of the problem, the same for every occurrence.
    pub title: &'static str,
}

/// Where the problem types are described; a slug follows.
pub const PROBLEM_TYPE_PREFIX: &str = "urn:sightfix:problem:";

mod code {
    pub(super) const CANCELLED: i32 = 1;
    pub(super) const INVALID_ARGUMENT: i32 = 3;
    pub(super) const DEADLINE_EXCEEDED: i32 = 4;
    pub(super) const NOT_FOUND: i32 = 5;
    pub(super) const ALREADY_EXISTS: i32 = 6;
    pub(super) const PERMISSION_DENIED: i32 = 7;
    pub(super) const RESOURCE_EXHAUSTED: i32 = 8;
    pub(super) const FAILED_PRECONDITION: i32 = 9;
    pub(super) const ABORTED: i32 = 10;
    pub(super) const UNIMPLEMENTED: i32 = 12;
    pub(super) const INTERNAL: i32 = 13;
    pub(super) const UNAVAILABLE: i32 = 14;
    pub(super) const UNAUTHENTICATED: i32 = 16;
}

/// The row of the table.
#[must_use]
pub const fn of(kind: ErrorKind) -> Status {
    let (http, grpc, slug, title) = match kind {
        ErrorKind::InvalidArgument => {
            (422, code::INVALID_ARGUMENT, "invalid-argument", "A field has a value that cannot be used")
        }
        ErrorKind::MalformedBody => {
            (400, code::INVALID_ARGUMENT, "malformed-body", "The body is not of its format")
        }
        ErrorKind::UnsupportedMediaType => {
            (415, code::INVALID_ARGUMENT, "unsupported-media-type", "The content type is not read here")
        }
        ErrorKind::NotAcceptable => {
            (406, code::INVALID_ARGUMENT, "not-acceptable", "None of the accepted types is written here")
        }
        ErrorKind::TooLarge => (413, code::RESOURCE_EXHAUSTED, "too-large", "The request is beyond a limit"),
        ErrorKind::RouteNotFound => (404, code::UNIMPLEMENTED, "route-not-found", "There is no such path"),
        ErrorKind::MethodNotAllowed => {
            (405, code::UNIMPLEMENTED, "method-not-allowed", "The path does not know this method")
        }
        ErrorKind::CameraNotFound => (404, code::NOT_FOUND, "camera-not-found", "There is no such camera"),
        ErrorKind::RunNotFound => (404, code::NOT_FOUND, "run-not-found", "There is no such training run"),
        ErrorKind::TrackNotFound => (404, code::NOT_FOUND, "track-not-found", "No such target is followed"),
        ErrorKind::EvaluationNotFound => {
            (404, code::NOT_FOUND, "evaluation-not-found", "There is no such evaluation")
        }
        ErrorKind::ModelNotFound => {
            (404, code::NOT_FOUND, "model-not-found", "There is no such model version")
        }
        ErrorKind::KeyNotFound => (404, code::NOT_FOUND, "key-not-found", "There is no such key"),
        ErrorKind::CameraExists => {
            (409, code::ALREADY_EXISTS, "camera-exists", "A camera of that id exists already")
        }
        ErrorKind::RevisionMismatch => {
            (412, code::ABORTED, "revision-mismatch", "The camera was changed in the meantime")
        }
        ErrorKind::RevisionRequired => (
            428,
            code::FAILED_PRECONDITION,
            "revision-required",
            "The change needs the revision it is based on",
        ),
        ErrorKind::NoModel => (409, code::FAILED_PRECONDITION, "no-model", "The camera has no active model"),
        ErrorKind::NoEarlierModel => {
            (409, code::FAILED_PRECONDITION, "no-earlier-model", "No other model version was active before")
        }
        ErrorKind::ModelUnusable => {
            (409, code::FAILED_PRECONDITION, "model-unusable", "The stored model version cannot be used")
        }
        ErrorKind::RunLive => {
            (409, code::FAILED_PRECONDITION, "run-live", "The camera has a training run that has not ended")
        }
        ErrorKind::RunEnded => (409, code::FAILED_PRECONDITION, "run-ended", "The training run has ended"),
        ErrorKind::EvaluationEnded => {
            (409, code::FAILED_PRECONDITION, "evaluation-ended", "The evaluation has ended")
        }
        ErrorKind::ModelActive => {
            (409, code::FAILED_PRECONDITION, "model-active", "The model version is the active one")
        }
        ErrorKind::InsufficientStorage => {
            (507, code::RESOURCE_EXHAUSTED, "insufficient-storage", "There is no space to store it")
        }
        ErrorKind::UnusableSamples => {
            (422, code::FAILED_PRECONDITION, "unusable-samples", "The samples cannot support a fit")
        }
        ErrorKind::Cancelled => (499, code::CANCELLED, "cancelled", "The request was cancelled"),
        ErrorKind::Overloaded => (503, code::UNAVAILABLE, "overloaded", "The server has too much to do"),
        ErrorKind::Timeout => (408, code::DEADLINE_EXCEEDED, "timeout", "The request took too long"),
        ErrorKind::ShuttingDown => (503, code::UNAVAILABLE, "shutting-down", "The server is shutting down"),
        ErrorKind::Unauthenticated => {
            (401, code::UNAUTHENTICATED, "unauthenticated", "The request needs a key that works")
        }
        ErrorKind::PermissionDenied => {
            (403, code::PERMISSION_DENIED, "permission-denied", "The key may not do this")
        }
        ErrorKind::HostNotAllowed => {
            (421, code::PERMISSION_DENIED, "host-not-allowed", "The server does not answer for this host")
        }
        ErrorKind::OriginNotAllowed => (
            403,
            code::PERMISSION_DENIED,
            "origin-not-allowed",
            "A page of another origin asked for a change",
        ),
        ErrorKind::Internal => (500, code::INTERNAL, "internal", "The server failed"),
    };
    Status { http, grpc, slug, title }
}
