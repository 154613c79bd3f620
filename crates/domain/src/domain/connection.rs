//! Connections with other systems, and the messages that wait to be delivered to them.

use std::fmt;

use jiff::Timestamp;
use uuid::Uuid;

use super::camera::{ExpectedVersion, Revision};
use super::names::ConnectionId;
use super::node::NodeId;

/// A connection as the operator defines it. Settings and secrets are JSON that has been checked where it was read.
#[derive(Clone, PartialEq, Eq)]
pub struct NewConnection {
    /// The slug chosen by the operator.
    pub id: ConnectionId,
    /// Display name.
    pub display_name: String,
    /// True if the connection is paused.
    pub paused: bool,
    /// Address, format and what goes where, as JSON.
    pub settings: String,
    /// Passwords and keys, as a JSON object of texts. Never shown and never logged.
    pub secrets: String,
}

impl fmt::Debug for NewConnection {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("NewConnection")
            .field("id", &self.id)
            .field("paused", &self.paused)
            .field("settings", &self.settings)
            .finish_non_exhaustive()
    }
}

/// Identifies a stored connection for good: one that is deleted and created again under the same id has another key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ConnectionKey(pub i64);

impl From<i64> for ConnectionKey {
    fn from(key: i64) -> Self {
        Self(key)
    }
}

impl From<ConnectionKey> for i64 {
    fn from(key: ConnectionKey) -> Self {
        key.0
    }
}

/// A stored connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Connection {
    /// Identity of this connection among all that had its id.
    pub key: ConnectionKey,
    /// The settings that the operator defined.
    pub profile: NewConnection,
    /// Counts its changes, from 1.
    pub revision: Revision,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest change.
    pub updated_at: Timestamp,
}

impl Connection {
    /// Returns the version that a change of this connection is based on.
    #[must_use]
    pub const fn version(&self) -> ExpectedVersion<ConnectionKey> {
        ExpectedVersion { key: Some(self.key), revision: self.revision }
    }

    /// Its id.
    #[must_use]
    pub const fn id(&self) -> &ConnectionId {
        &self.profile.id
    }
}

/// A message that is to be delivered at least once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutboxMessage {
    /// Its place in the outbox; messages are delivered in this order. Before it is stored, its place in the log that it
    /// comes from, from 1.
    pub number: i64,
    /// The same at every attempt, so that the receiver can recognise a repetition.
    pub message_id: String,
    /// Where it goes at the receiver, such as the topic.
    pub subject: String,
    /// Content of the message.
    pub payload: Vec<u8>,
    /// When it was made.
    pub created_at: Timestamp,
}

/// The log of positions that a process keeps for each sink until they are in its outbox.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutboxLog {
    /// Another one for every run of a process.
    pub id: Uuid,
    /// The process, where several share the database.
    pub node: Option<NodeId>,
}

/// How far a source has read a partition of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SourceOffset {
    /// Name of the topic.
    pub topic: String,
    /// Number of its partition.
    pub partition: i32,
    /// Offset of the first message that is not settled.
    pub next_offset: i64,
}

/// A message that the receiver refused, or that could not be delivered for too long.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeadLetter {
    /// The message that was not delivered.
    pub message: OutboxMessage,
    /// Why it is not tried any more.
    pub reason: String,
}

/// Numbers of messages in the outbox of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct OutboxCounts {
    /// Messages that wait.
    pub queued: u64,
    /// Messages that are not tried any more.
    pub dead: u64,
    /// When the oldest waiting message was made.
    pub oldest_at: Option<Timestamp>,
}
