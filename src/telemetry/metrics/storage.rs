//! Metrics of stored rows and of bounded resources in use.

use metrics::Gauge;

use crate::telemetry::registry::Registry;

#[derive(Clone)]
pub(super) struct StorageMetrics {
    pub(super) is_full: Gauge,
    pub(super) database_bytes: Gauge,
    pub(super) database_free_bytes: Gauge,
    pub(super) disk_available_bytes: Gauge,
    pub(super) samples: Gauge,
    pub(super) queued_rows: Gauge,
}

#[derive(Clone)]
pub(super) struct QuotaMetrics {
    pub(super) held: Gauge,
    pub(super) limit: Gauge,
}

impl StorageMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        Self {
            is_full: registry.gauge(
                "sightfix_storage_full",
                "1 while imports are refused for want of space",
                &[],
            ),
            database_bytes: registry.gauge("sightfix_database_bytes", "Size of the database file", &[]),
            database_free_bytes: registry.gauge(
                "sightfix_database_free_bytes",
                "Bytes of the database that are free for new rows",
                &[],
            ),
            disk_available_bytes: registry.gauge(
                "sightfix_disk_available_bytes",
                "Available on the disk of the data folder",
                &[],
            ),
            samples: registry.gauge("sightfix_samples_stored", "Samples of all cameras", &[]),
            queued_rows: registry.gauge(
                "sightfix_sample_rows_queued",
                "Samples that wait to be stored, or are being stored",
                &[],
            ),
        }
    }
}

impl QuotaMetrics {
    pub(super) fn register(registry: &Registry, resource: &'static str) -> Self {
        let labels = [("resource", resource)];
        Self {
            held: registry.gauge("sightfix_quota_held", "Held of a bounded resource by all clients", &labels),
            limit: registry.gauge("sightfix_quota_limit", "Limit of a bounded resource", &labels),
        }
    }
}
