//! Connections: open ones, and why others were refused or closed.

use metrics::{Counter, Gauge};

use crate::telemetry::registry::Registry;

#[derive(Clone)]
pub(super) struct ConnectionMetrics {
    pub(super) open: Gauge,
    pub(super) refused: Counter,
    pub(super) closed: [(CloseReason, Counter); CloseReason::ALL.len()],
}

/// Why the server closes a connection by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CloseReason {
    /// No request for the idle time.
    Idle,
    /// The client took a response too slowly.
    Stalled,
    /// Too many HTTP/2 control frames per second.
    Flooded,
    /// It was still open when the time to shut down was over.
    Shutdown,
}

impl CloseReason {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Idle, Self::Stalled, Self::Flooded, Self::Shutdown];

    /// The label in the metrics.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Stalled => "stalled",
            Self::Flooded => "flooded",
            Self::Shutdown => "shutdown",
        }
    }
}

impl ConnectionMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        let closed = |reason: CloseReason| {
            let help = "Connections that the server closed by itself, by reason";
            let name = "sightfix_connections_closed_total";
            (reason, registry.counter(name, help, &[("reason", reason.as_str())]))
        };
        Self {
            open: registry.gauge("sightfix_connections", "Open connections", &[]),
            refused: registry.counter(
                "sightfix_connections_refused_total",
                "Connections beyond the limit, in all or of one client address",
                &[],
            ),
            closed: CloseReason::ALL.map(closed),
        }
    }
}

/// Counts an open connection while it lives.
pub struct OpenConnection(pub(super) Gauge);

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}
