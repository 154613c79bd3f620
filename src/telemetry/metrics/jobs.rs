//! Background jobs: those that ended, and those that have not.

use std::time::Duration;

use metrics::{Counter, Gauge, Histogram};

use crate::domain::JobState;
use crate::telemetry::registry::Registry;

/// Jobs that have not ended.
#[derive(Clone)]
pub(super) struct QueueMetrics {
    pub(super) training: [Gauge; 2],
    pub(super) evaluation: [Gauge; 2],
}

/// Counts and durations of one kind of background job.
#[derive(Clone)]
pub struct JobMetrics {
    succeeded: Counter,
    failed: Counter,
    cancelled: Counter,
    duration_s: Histogram,
}

impl JobMetrics {
    /// A job has ended.
    pub fn ended(&self, state: JobState, time: Duration) {
        match state {
            JobState::Succeeded => self.succeeded.increment(1),
            JobState::Failed => self.failed.increment(1),
            JobState::Cancelled => self.cancelled.increment(1),
            JobState::Queued | JobState::Running | JobState::Cancelling => return,
        }
        self.duration_s.record(time.as_secs_f64());
    }

    /// Each pair is a metric's name and its description.
    pub(super) fn register(
        registry: &Registry,
        total: [&'static str; 2],
        duration: [&'static str; 2],
    ) -> Self {
        let ended = |state: JobState| registry.counter(total[0], total[1], &[("state", state.as_str())]);
        Self {
            succeeded: ended(JobState::Succeeded),
            failed: ended(JobState::Failed),
            cancelled: ended(JobState::Cancelled),
            duration_s: registry.histogram(duration[0], duration[1], &[]),
        }
    }
}

impl QueueMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        let jobs = |kind| {
            ["queued", "running"].map(|state| {
                let labels = [("kind", kind), ("state", state)];
                registry.gauge("sightfix_jobs", "Background jobs that have not ended", &labels)
            })
        };
        Self { training: jobs("training"), evaluation: jobs("evaluation") }
    }
}
