//! Answers and imports.

use metrics::Counter;

use crate::telemetry::registry::Registry;

#[derive(Clone)]
pub(super) struct FusionMetrics {
    pub(super) answered: Counter,
    pub(super) denied: Counter,
    pub(super) outside_training: Counter,
}

#[derive(Clone)]
pub(super) struct ImportMetrics {
    pub(super) accepted: Counter,
    pub(super) duplicate: Counter,
    pub(super) rejected: Counter,
}

impl FusionMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        Self {
            answered: registry.counter("sightfix_fusions_total", "Observations answered", &[]),
            denied: registry.counter(
                "sightfix_fusions_denied_total",
                "Observations answered without a fix",
                &[],
            ),
            outside_training: registry.counter(
                "sightfix_fusions_outside_training_total",
                "Observations whose box was unlike those trained on",
                &[],
            ),
        }
    }
}

impl ImportMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        let rows = |outcome| {
            registry.counter("sightfix_samples_total", "Rows of imports, by outcome", &[("outcome", outcome)])
        };
        Self { accepted: rows("accepted"), duplicate: rows("duplicate"), rejected: rows("rejected") }
    }
}
