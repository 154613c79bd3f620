//! Processes that share the database, and the cameras that this one owns.

use metrics::{Counter, Gauge};

use crate::telemetry::registry::Registry;

#[derive(Clone)]
pub(super) struct ClusterMetrics {
    pub(super) nodes: Gauge,
    pub(super) owned_cameras: Gauge,
    pub(super) takeovers: Counter,
    pub(super) registrations_lost: Counter,
    pub(super) history_breaks: Counter,
}

impl ClusterMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        Self {
            nodes: registry.gauge("sightfix_nodes", "Processes that share the PostgreSQL database", &[]),
            owned_cameras: registry.gauge(
                "sightfix_owned_cameras",
                "Cameras whose live state is on this node of those that share the database",
                &[],
            ),
            takeovers: registry.counter(
                "sightfix_camera_takeovers_total",
                "Cameras that were acquired after their owner had ended without releasing them",
                &[],
            ),
            registrations_lost: registry.counter(
                "sightfix_node_registrations_lost_total",
                "Times that this node could not renew its registration in time, and lost its cameras",
                &[],
            ),
            history_breaks: registry.counter(
                "sightfix_database_history_breaks_total",
                "Times that the database continued from an earlier state than it had acknowledged, or may have, as after a fail-over",
                &[],
            ),
        }
    }
}
