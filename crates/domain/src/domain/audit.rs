//! The audit log: who changed what, when and from where.

use std::net::IpAddr;
use std::sync::Arc;

use jiff::Timestamp;
use strum::{EnumString, IntoStaticStr};

use super::access::KeyId;
use super::error::Error;
use super::names::CameraId;

/// On whose behalf something is changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Actor {
    /// Name of the key, or what part of the program acts by itself.
    pub name: Arc<str>,
    /// The key, if one was presented.
    pub key_id: Option<KeyId>,
    /// The certificate or the person of a request without a key, for what belongs to one caller alone. Not recorded.
    pub identity: Option<Arc<str>>,
    /// The client's network address; `None` for a process on the data folder itself.
    pub address: Option<IpAddr>,
    /// Id of the request, as in the log.
    pub request_id: Option<Arc<str>>,
}

impl Actor {
    /// A part of the program that acts by itself.
    #[must_use]
    pub fn program(name: &str) -> Self {
        Self { name: name.into(), key_id: None, identity: None, address: None, request_id: None }
    }

    /// True if a client asked, rather than the program by itself.
    #[must_use]
    pub const fn is_client(&self) -> bool {
        self.key_id.is_some() || self.address.is_some()
    }
}

/// A kind of change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, EnumString, IntoStaticStr)]
#[strum(serialize_all = "kebab-case", parse_err_ty = Error, parse_err_fn = unknown_action)]
pub enum AuditAction {
    /// A camera was created.
    CameraCreated,
    /// A camera's profile was changed.
    CameraChanged,
    /// A camera was deleted with all that belongs to it.
    CameraDeleted,
    /// A site was created.
    SiteCreated,
    /// A site was changed.
    SiteChanged,
    /// A site was deleted.
    SiteDeleted,
    /// A place was created.
    PlaceCreated,
    /// A place was changed.
    PlaceChanged,
    /// A place was deleted with its events and counts.
    PlaceDeleted,
    /// A connection with another system was created.
    ConnectionCreated,
    /// A connection was changed, paused or resumed.
    ConnectionChanged,
    /// A connection was deleted with its outbox.
    ConnectionDeleted,
    /// The dead letters of a connection were put back among its waiting messages.
    DeadLettersRetried,
    /// The dead letters of a connection were deleted.
    DeadLettersDeleted,
    /// Samples were deleted.
    SamplesDeleted,
    /// Stored samples were replaced by those of an import.
    SamplesReplaced,
    /// A training run of a site was queued.
    SiteRunStarted,
    /// A training run of a site was cancelled.
    SiteRunCancelled,
    /// A training run was queued.
    RunStarted,
    /// A training run was cancelled.
    RunCancelled,
    /// An ended training run was deleted.
    RunDeleted,
    /// A model version was imported.
    ModelImported,
    /// A model version became the active one.
    ModelActivated,
    /// The model version before became the active one again.
    ModelRolledBack,
    /// A model version was deleted.
    ModelDeleted,
    /// An evaluation was queued.
    EvaluationStarted,
    /// An evaluation was cancelled.
    EvaluationCancelled,
    /// An ended evaluation was deleted.
    EvaluationDeleted,
    /// A key was created.
    KeyCreated,
    /// A key was revoked.
    KeyRevoked,
    /// A browser's session was started for the holder of a key, or for a person.
    SignedIn,
}

impl AuditAction {
    /// Name in the database and in wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

fn unknown_action(_: &str) -> Error {
    Error::invalid("action", "is not an action of the audit log")
}

/// Number of an entry of the audit log; entries are numbered in the order of their commits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct AuditNumber(pub u64);

/// An entry of the audit log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditEntry {
    /// The number of the entry.
    pub number: AuditNumber,
    /// Time of the change.
    pub time: Timestamp,
    /// Who changed it, and from where.
    pub actor: Actor,
    /// The kind of change.
    pub action: AuditAction,
    /// The camera that it was done to or for; it may have been deleted since.
    pub camera_id: Option<CameraId>,
    /// The object of the change: id of a run, number of a model version, name and role of a key.
    pub subject: Option<String>,
}
