//! The right to run a connection with another system.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::registration::Registration;
use crate::clock::Clock;

/// Held by the task that reads a source, or delivers the outbox of a sink. A server that shares its database with no other
/// has it without asking.
#[derive(Clone)]
pub struct ConnectionLease(pub(super) Option<Arc<HeldConnection>>);

/// An ownership that is stored in the database.
pub(super) struct HeldConnection {
    pub(super) fence: i64,
    pub(super) registration: Arc<Registration>,
    pub(super) ended: CancellationToken,
}

impl ConnectionLease {
    /// For what every node does.
    #[must_use]
    pub const fn of_every_node() -> Self {
        Self(None)
    }

    /// Tells this ownership from an earlier one; 0 for a server that owns everything.
    #[must_use]
    pub fn fence(&self) -> i64 {
        self.0.as_ref().map_or(0, |held| held.fence)
    }

    /// True if nobody else can have the connection at this reading of the monotonic clock.
    #[must_use]
    pub fn is_valid(&self, now: Duration) -> bool {
        self.0.as_ref().is_none_or(|held| held.is_valid(now))
    }

    /// Waits until the lease has been given up, or another node may have the connection; without end for a server that
    /// owns everything.
    pub async fn ended(&self, clock: &Clock) {
        let Some(held) = &self.0 else { return std::future::pending().await };
        while let Some(left) = held.registration.time_left(clock.monotonic()) {
            tokio::select! {
                () = held.ended.cancelled() => return,
                () = tokio::time::sleep(left) => {}
            }
        }
    }
}

impl HeldConnection {
    pub(super) fn is_valid(&self, now: Duration) -> bool {
        self.registration.is_valid(now) && !self.ended.is_cancelled()
    }
}
