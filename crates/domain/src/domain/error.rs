//! Errors, independent of the transport.
//!
//! A [`Refusal`] can be corrected by the caller and is shown to them; a [`Fault`] of the server is logged
//! once at the boundary and never shown.

use std::error::Error as StdError;
use std::fmt;

use strum::IntoStaticStr;

/// `std::result::Result` with this crate's error.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Every kind of error that a caller can receive. `status.rs` gives each its HTTP status, gRPC code and
/// problem type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ErrorKind {
    /// A field has a value that cannot be used.
    InvalidArgument,
    /// A parameter of a query has a value that cannot be used, on interfaces whose standard gives that a kind of
    /// its own.
    InvalidQuery,
    /// The body is not in the declared format.
    MalformedBody,
    /// The operation does not read this content type.
    UnsupportedMediaType,
    /// The operation writes none of the accepted content types.
    NotAcceptable,
    /// Body, batch or message beyond its limit.
    TooLarge,
    /// `Range` asks for bytes after the end.
    RangeNotSatisfiable,
    /// No such path.
    RouteNotFound,
    /// The path exists, the method does not.
    MethodNotAllowed,
    /// No such camera.
    CameraNotFound,
    /// No such training run.
    RunNotFound,
    /// No track of that target.
    TrackNotFound,
    /// No such evaluation.
    EvaluationNotFound,
    /// No such model version.
    ModelNotFound,
    /// No such key.
    KeyNotFound,
    /// A camera of that id exists already.
    CameraExists,
    /// No such site.
    SiteNotFound,
    /// A site of that id exists already.
    SiteExists,
    /// The site has cameras.
    SiteInUse,
    /// No such place.
    PlaceNotFound,
    /// A place of that id exists already.
    PlaceExists,
    /// No such connection.
    ConnectionNotFound,
    /// A connection of that id exists already.
    ConnectionExists,
    /// The connection takes no messages by HTTP, or is paused.
    ConnectionNotReceiving,
    /// `If-Match` names another revision than the stored one.
    RevisionMismatch,
    /// The change needs an `If-Match`.
    RevisionRequired,
    /// The camera has no active model yet.
    NoModel,
    /// No other model version was active before the active one.
    NoEarlierModel,
    /// The stored model version is damaged or cannot be loaded.
    ModelUnusable,
    /// The camera, or the site, has a training run that has not ended.
    RunLive,
    /// The idempotency key was used for another request.
    IdempotencyKeyReused,
    /// The training run has ended already.
    RunEnded,
    /// The evaluation has ended already.
    EvaluationEnded,
    /// The model version is the active one.
    ModelActive,
    /// The disk is full, or as much is stored as the settings allow.
    InsufficientStorage,
    /// Boxes and fixes cannot be associated with confidence.
    NotIdentifiable,
    /// The stored samples cannot support a fit.
    UnusableSamples,
    /// The caller went away or cancelled.
    Cancelled,
    /// More requests are in flight than the server takes.
    Overloaded,
    /// The client sends more requests per second than it may.
    RateLimited,
    /// The request took longer than it may.
    Timeout,
    /// Another node has the camera's live state.
    CameraOnOtherNode,
    /// No node that can be named has the camera's live state for sure.
    CameraBetweenNodes,
    /// The server is ending.
    ShuttingDown,
    /// No key was presented, or one that does not work.
    Unauthenticated,
    /// The key may not do this.
    PermissionDenied,
    /// The OpenID provider gave no usable answer.
    SignInUnavailable,
    /// The address of a camera's still picture gave none.
    SnapshotUnavailable,
    /// The request names a host that this server does not answer for.
    HostNotAllowed,
    /// A web page of another origin asks for a change.
    OriginNotAllowed,
    /// A fault of the server.
    Internal,
}

impl ErrorKind {
    /// Stable name, as in problem types and in the `reason` of gRPC's `ErrorInfo`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// Most fields at fault that one refusal names. gRPC sends them in headers, of which clients take no more
/// than 8 kB.
pub const MOST_VIOLATIONS: usize = 16;

/// Converts all items of a list.
///
/// # Errors
/// `InvalidArgument`, naming the fields at fault of all items below `list[index]`, so that a caller can
/// mend them at once; any other error as it comes.
pub fn convert_all<T, R>(
    list: &str,
    items: impl IntoIterator<Item = T>,
    mut convert: impl FnMut(T) -> Result<R>,
) -> Result<Vec<R>> {
    let items = items.into_iter();
    let mut converted = Vec::with_capacity(items.size_hint().0);
    let mut violations = Vec::new();
    for (index, item) in items.enumerate() {
        match convert(item) {
            Ok(item) => converted.push(item),
            Err(Error::Refused(mut refusal)) if refusal.kind == ErrorKind::InvalidArgument => {
                let parent = format!("{list}[{index}]");
                refusal.violations.iter_mut().for_each(|violation| violation.move_under(&parent));
                violations.append(&mut refusal.violations);
            }
            Err(error) => return Err(error),
        }
        if violations.len() >= MOST_VIOLATIONS {
            violations.truncate(MOST_VIOLATIONS);
            break;
        }
    }
    if violations.is_empty() {
        return Ok(converted);
    }
    let message = format!("nothing was done, for the {list} at fault");
    let kind = ErrorKind::InvalidArgument;
    Err(Error::Refused(Refusal {
        kind,
        message,
        violations,
        conflicting_id: None,
        other_node: None,
        may_repeat: false,
    }))
}

/// One invalid field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// Path of the field, dotted, with indexes in brackets: `observations[3].bounding_box.width_px`.
    pub field: String,
    /// States the fault and the valid values.
    pub message: String,
}

impl Violation {
    fn move_under(&mut self, parent: &str) {
        self.field = match self.field.as_str() {
            "" => parent.to_owned(),
            field if field.starts_with('[') => format!("{parent}{field}"),
            field => format!("{parent}.{field}"),
        };
    }
}

/// An error that the caller can correct; all of it may be shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The kind, which determines status and problem type.
    pub kind: ErrorKind,
    /// A human-readable sentence.
    pub message: String,
    /// The invalid fields, if any.
    pub violations: Vec<Violation>,
    /// Id of what stands in the way, for a conflict with something that the caller can look at.
    pub conflicting_id: Option<String>,
    /// Address of the node that would answer, such as `https://node-1.example.org:8443`.
    pub other_node: Option<String>,
    /// Nothing was done, and the same call may be made again at once: the database ended its transaction in favour of
    /// another one. Transports do not show this.
    pub may_repeat: bool,
}

impl fmt::Display for Refusal {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.violations.first() {
            Some(first) if self.message != first.message => {
                write!(out, "{}: {}: {}", self.message, first.field, first.message)
            }
            Some(first) => write!(out, "{}: {}", first.field, first.message),
            None => out.write_str(&self.message),
        }
    }
}

/// An error of the server, for the log only.
#[derive(Debug)]
pub struct Fault(Box<dyn StdError + Send + Sync>);

impl fmt::Display for Fault {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", self.0)?;
        let mut source = self.0.source();
        while let Some(cause) = source {
            write!(out, ": {cause}")?;
            source = cause.source();
        }
        Ok(())
    }
}

impl Fault {
    /// The cause, if it is of that type.
    #[must_use]
    pub fn cause<T: StdError + 'static>(&self) -> Option<&T> {
        self.0.downcast_ref()
    }
}

/// Refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The caller can correct it.
    #[error("{0}")]
    Refused(Refusal),
    /// The server is at fault.
    #[error("{0}")]
    Fault(Fault),
}

impl Error {
    /// A refusal of a request that another node answers.
    pub fn on_other_node(message: impl Into<String>, url: impl Into<String>) -> Self {
        Self::Refused(Refusal {
            kind: ErrorKind::CameraOnOtherNode,
            message: message.into(),
            violations: Vec::new(),
            conflicting_id: None,
            other_node: Some(url.into()),
            may_repeat: false,
        })
    }

    /// A refusal without a field.
    pub fn refused(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self::Refused(Refusal {
            kind,
            message: message.into(),
            violations: Vec::new(),
            conflicting_id: None,
            other_node: None,
            may_repeat: false,
        })
    }

    /// An invalid field.
    pub fn invalid(field: impl Into<String>, message: impl Into<String>) -> Self {
        Self::field(ErrorKind::InvalidArgument, field, message)
    }

    /// A refusal that names one field.
    pub fn field(kind: ErrorKind, field: impl Into<String>, message: impl Into<String>) -> Self {
        let violation = Violation { field: field.into(), message: message.into() };
        Self::Refused(Refusal {
            kind,
            message: violation.message.clone(),
            violations: vec![violation],
            conflicting_id: None,
            other_node: None,
            may_repeat: false,
        })
    }

    /// A refusal for something of that id, which stands in the way.
    pub fn conflict(kind: ErrorKind, id: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Refused(Refusal {
            kind,
            message: message.into(),
            violations: Vec::new(),
            conflicting_id: Some(id.into()),
            other_node: None,
            may_repeat: false,
        })
    }

    /// A refusal of a transaction that the database ended in favour of another one; the same call may be made again.
    pub fn repeatable(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self::Refused(Refusal {
            kind,
            message: message.into(),
            violations: Vec::new(),
            conflicting_id: None,
            other_node: None,
            may_repeat: true,
        })
    }

    /// A fault with its cause.
    pub fn fault(cause: impl Into<Box<dyn StdError + Send + Sync>>) -> Self {
        Self::Fault(Fault(cause.into()))
    }

    /// A refusal for all of these fields, given with what is wrong with them; nothing if there are none.
    ///
    /// # Errors
    /// `InvalidArgument`.
    pub fn check_all(message: &str, fields: impl Iterator<Item = (String, String)>) -> Result<()> {
        let violations = fields.map(|(field, message)| Violation { field, message });
        let violations: Vec<_> = violations.take(MOST_VIOLATIONS).collect();
        if violations.is_empty() {
            return Ok(());
        }
        let (kind, message) = (ErrorKind::InvalidArgument, message.to_owned());
        Err(Self::Refused(Refusal {
            kind,
            message,
            violations,
            conflicting_id: None,
            other_node: None,
            may_repeat: false,
        }))
    }

    /// The kind that `status.rs` maps.
    #[must_use]
    pub const fn kind(&self) -> ErrorKind {
        match self {
            Self::Refused(refusal) => refusal.kind,
            Self::Fault(_) => ErrorKind::Internal,
        }
    }

    /// The same refusal for another field.
    #[must_use]
    pub fn at(self, field: &str) -> Self {
        match self {
            Self::Refused(refusal) => Self::field(refusal.kind, field, refusal.message),
            fault @ Self::Fault(_) => fault,
        }
    }

    /// The same error with the field paths below a parent: `width_px` under `bounding_box`.
    #[must_use]
    pub fn under(mut self, parent: &str) -> Self {
        if let Self::Refused(refusal) = &mut self {
            refusal.violations.iter_mut().for_each(|violation| violation.move_under(parent));
        }
        self
    }
}
