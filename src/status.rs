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
    /// Seconds after which the same request may succeed; `None` if it will not by itself.
    pub retry_after_s: Option<u32>,
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
    pub(super) const OUT_OF_RANGE: i32 = 11;
    pub(super) const UNIMPLEMENTED: i32 = 12;
    pub(super) const INTERNAL: i32 = 13;
    pub(super) const UNAVAILABLE: i32 = 14;
    pub(super) const UNAUTHENTICATED: i32 = 16;
}

/// The row of the table.
#[must_use]
pub fn of(kind: ErrorKind) -> Status {
    use ErrorKind as Kind;
    let (http, grpc, title) = match kind {
        Kind::InvalidArgument => (422, code::INVALID_ARGUMENT, "A field has a value that cannot be used"),
        Kind::InvalidQuery => (400, code::INVALID_ARGUMENT, "A parameter has a value that cannot be used"),
        Kind::MalformedBody => (400, code::INVALID_ARGUMENT, "The body is not of its format"),
        Kind::UnsupportedMediaType => (415, code::INVALID_ARGUMENT, "The content type is not read here"),
        Kind::NotAcceptable => (406, code::INVALID_ARGUMENT, "None of the accepted types is written here"),
        Kind::TooLarge => (413, code::RESOURCE_EXHAUSTED, "The request is beyond a limit"),
        Kind::RangeNotSatisfiable => (416, code::OUT_OF_RANGE, "The range begins after the end"),
        Kind::RouteNotFound => (404, code::UNIMPLEMENTED, "There is no such path"),
        Kind::MethodNotAllowed => (405, code::UNIMPLEMENTED, "The path does not know this method"),
        Kind::CameraNotFound => (404, code::NOT_FOUND, "There is no such camera"),
        Kind::RunNotFound => (404, code::NOT_FOUND, "There is no such training run"),
        Kind::TrackNotFound => (404, code::NOT_FOUND, "No such target is followed"),
        Kind::EvaluationNotFound => (404, code::NOT_FOUND, "There is no such evaluation"),
        Kind::ModelNotFound => (404, code::NOT_FOUND, "There is no such model version"),
        Kind::KeyNotFound => (404, code::NOT_FOUND, "There is no such key"),
        Kind::CameraExists => (409, code::ALREADY_EXISTS, "A camera of that id exists already"),
        Kind::SiteNotFound => (404, code::NOT_FOUND, "There is no such site"),
        Kind::SiteExists => (409, code::ALREADY_EXISTS, "A site of that id exists already"),
        Kind::SiteInUse => (409, code::FAILED_PRECONDITION, "The site has cameras"),
        Kind::PlaceNotFound => (404, code::NOT_FOUND, "There is no such place"),
        Kind::PlaceExists => (409, code::ALREADY_EXISTS, "A place of that id exists already"),
        Kind::ConnectionNotFound => (404, code::NOT_FOUND, "There is no such connection"),
        Kind::ConnectionExists => (409, code::ALREADY_EXISTS, "A connection of that id exists already"),
        Kind::ConnectionNotReceiving => {
            (409, code::FAILED_PRECONDITION, "The connection takes no messages now")
        }
        Kind::RevisionMismatch => (412, code::ABORTED, "The resource was changed in the meantime"),
        Kind::RevisionRequired => {
            (428, code::FAILED_PRECONDITION, "The change needs the revision it is based on")
        }
        Kind::NoModel => (409, code::FAILED_PRECONDITION, "The camera has no active model"),
        Kind::NoEarlierModel => (409, code::FAILED_PRECONDITION, "No other model version was active before"),
        Kind::ModelUnusable => (409, code::FAILED_PRECONDITION, "The stored model version cannot be used"),
        Kind::IdempotencyKeyReused => {
            (422, code::INVALID_ARGUMENT, "The idempotency key was used for another request")
        }
        Kind::RunLive => (409, code::FAILED_PRECONDITION, "There is a training run that has not ended"),
        Kind::RunEnded => (409, code::FAILED_PRECONDITION, "The training run has ended"),
        Kind::EvaluationEnded => (409, code::FAILED_PRECONDITION, "The evaluation has ended"),
        Kind::ModelActive => (409, code::FAILED_PRECONDITION, "The model version is the active one"),
        Kind::InsufficientStorage => (507, code::RESOURCE_EXHAUSTED, "There is no space to store it"),
        Kind::NotIdentifiable => {
            (422, code::FAILED_PRECONDITION, "Boxes and fixes cannot be associated with confidence")
        }
        Kind::UnusableSamples => (422, code::FAILED_PRECONDITION, "The samples cannot support a fit"),
        Kind::Cancelled => (499, code::CANCELLED, "The request was cancelled"),
        Kind::Overloaded => (503, code::UNAVAILABLE, "The server has too much to do"),
        Kind::RateLimited => (429, code::RESOURCE_EXHAUSTED, "The client sends too many requests"),
        Kind::Timeout => (408, code::DEADLINE_EXCEEDED, "The request took too long"),
        // UNAVAILABLE, which every client tries again: one that does not read the owner's address reaches the owner
        // through a balancer in the end.
        Kind::CameraOnOtherNode => (307, code::UNAVAILABLE, "Another node has the camera's live state"),
        Kind::CameraBetweenNodes => {
            (503, code::UNAVAILABLE, "The camera's live state is going from one node to another")
        }
        Kind::ShuttingDown => (503, code::UNAVAILABLE, "The server is shutting down"),
        Kind::Unauthenticated => (401, code::UNAUTHENTICATED, "The request needs a key that works"),
        Kind::PermissionDenied => (403, code::PERMISSION_DENIED, "The key may not do this"),
        Kind::SnapshotUnavailable => (502, code::UNAVAILABLE, "The snapshot address gave no picture"),
        Kind::SignInUnavailable => (502, code::UNAVAILABLE, "The OpenID provider gave no usable answer"),
        Kind::HostNotAllowed => (421, code::PERMISSION_DENIED, "The server does not answer for this host"),
        Kind::OriginNotAllowed => {
            (403, code::PERMISSION_DENIED, "A page of another origin asked for a change")
        }
        Kind::Internal => (500, code::INTERNAL, "The server failed"),
    };
    let is_temporary =
        matches!(kind, Kind::Overloaded | Kind::RateLimited | Kind::ShuttingDown | Kind::CameraBetweenNodes);
    Status { http, grpc, slug: kind.as_str(), title, retry_after_s: is_temporary.then_some(1) }
}
