//! Processes that share one database.

use std::fmt;
use std::time::Duration;

use jiff::Timestamp;
use uuid::Uuid;

/// One run of a process; drawn at its start, and again if its registration was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct NodeId(pub Uuid);

impl fmt::Display for NodeId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", self.0)
    }
}

/// A node's own description.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeProfile {
    /// Where clients reach it, such as `https://node-1.example.org:8443`, if they do.
    pub url: Option<String>,
    /// Name of its role.
    pub role: String,
    /// The node's version of the program.
    pub version: String,
    /// How long it counts as alive without another renewal.
    pub lease: Duration,
    /// When it was started, by its own clock.
    pub started_at: Timestamp,
}

/// A registered node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// The node's id.
    pub id: NodeId,
    /// The node's own description.
    pub profile: NodeProfile,
    /// The number of its latest renewal, drawn at random.
    pub renewal: i64,
    /// True if the node is shutting down.
    pub is_draining: bool,
    /// When it renewed its registration last, by the clock of the database; for people, nothing is decided by it.
    pub renewed_at: Timestamp,
}
