//! Metrics, as one typed struct: no name is spelled at a call site.

use std::time::Duration;

use metrics::{Counter, Gauge, Histogram, Key, KeyName, Label, Level, Metadata, Recorder, SharedString};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle, PrometheusRecorder};

use crate::domain::{Flag, FusedFix, JobState};
use crate::fusion::track::{Rejection, RejectionReason};
use crate::store::StorageStatus;

/// Everything that is counted and timed.
#[derive(Clone)]
pub struct Metrics {
    handle: PrometheusHandle,
    fusions: FusionMetrics,
    imports: ImportMetrics,
    /// Training runs.
    pub training_runs: JobMetrics,
    /// Evaluations.
    pub evaluations: JobMetrics,
    connections: ConnectionMetrics,
    requests: RequestMetrics,
    live: LiveMetrics,
    storage: StorageMetrics,
}

#[derive(Clone)]
struct FusionMetrics {
    answered: Counter,
    denied: Counter,
    outside_training: Counter,
}

#[derive(Clone)]
struct ImportMetrics {
    accepted: Counter,
    duplicate: Counter,
    rejected: Counter,
}

#[derive(Clone)]
struct ConnectionMetrics {
    open: Gauge,
    refused: Counter,
    closed: [(CloseReason, Counter); CloseReason::ALL.len()],
}

#[derive(Clone)]
struct RequestMetrics {
    /// By class of status, 1xx to 5xx.
    answered: [Counter; 5],
    duration_s: Histogram,
    refused: Counter,
}

#[derive(Clone)]
struct LiveMetrics {
    track_nis: Histogram,
    track_rejections: [(RejectionReason, Counter); RejectionReason::ALL.len()],
    streams: Gauge,
    items: Counter,
    item_errors: Counter,
    answers_lost: Counter,
    cameras_moved: Counter,
}

#[derive(Clone)]
struct StorageMetrics {
    is_full: Gauge,
    database_bytes: Gauge,
    database_free_bytes: Gauge,
    disk_available_bytes: Gauge,
    samples: Gauge,
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

const NIS: &str = "sightfix_track_nis";

/// What is counted and timed of one kind of background job.
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
}

const METADATA: Metadata<'static> = Metadata::new("sightfix", Level::INFO, None);

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// Metrics of one server; two in one process do not mix.
    #[must_use]
    pub fn new() -> Self {
        let registry = Registry::new();
        Self {
            fusions: FusionMetrics::register(&registry),
            imports: ImportMetrics::register(&registry),
            training_runs: JobMetrics::register(
                &registry,
                ["sightfix_training_runs_total", "Training runs that ended"],
                ["sightfix_training_run_duration_seconds", "Time of a run"],
            ),
            evaluations: JobMetrics::register(
                &registry,
                ["sightfix_evaluations_total", "Evaluations that ended"],
                ["sightfix_evaluation_duration_seconds", "Time of an evaluation"],
            ),
            connections: ConnectionMetrics::register(&registry),
            requests: RequestMetrics::register(&registry),
            live: LiveMetrics::register(&registry),
            storage: StorageMetrics::register(&registry),
            handle: registry.recorder.handle(),
        }
    }

    /// The text that `/metrics` gives.
    #[must_use]
    pub fn render(&self) -> String {
        self.handle.render()
    }

    /// Gathers recorded times into their buckets. They pile up until then, so this must run every
    /// few seconds whether anybody reads the metrics or not.
    pub fn upkeep(&self) {
        self.handle.run_upkeep();
    }

    /// Observations were answered.
    pub fn fused(&self, fused: &[FusedFix]) {
        let having = |flag| fused.iter().filter(|fix| fix.flags.contains(&flag)).count() as u64;
        self.fusions.answered.increment(fused.len() as u64);
        self.fusions.denied.increment(having(Flag::GnssDenied));
        self.fusions.outside_training.increment(having(Flag::OutsideTraining));
    }

    /// An import was read: rows by outcome.
    pub fn imported(&self, accepted: u64, duplicate: u64, rejected: u64) {
        self.imports.accepted.increment(accepted);
        self.imports.duplicate.increment(duplicate);
        self.imports.rejected.increment(rejected);
    }

    /// A track used innovations, and rejected others.
    pub fn tracked(&self, nis: impl Iterator<Item = f64>, rejected: &[Rejection]) {
        nis.for_each(|nis| self.live.track_nis.record(nis));
        for rejection in rejected {
            for (reason, counter) in &self.live.track_rejections {
                counter.increment(u64::from(*reason == rejection.reason));
            }
        }
    }

    /// A live stream was opened.
    pub fn stream_opened(&self) {
        self.live.streams.increment(1.0);
    }

    /// A live stream was closed.
    pub fn stream_closed(&self) {
        self.live.streams.decrement(1.0);
    }

    /// An item of a live stream was answered, well or with its error.
    pub fn item_answered(&self, taken: bool) {
        if taken { self.live.items.increment(1) } else { self.live.item_errors.increment(1) }
    }

    /// A slow reader lost an answer.
    pub fn answer_lost(&self) {
        self.live.answers_lost.increment(1);
    }

    /// A camera was found to have moved.
    pub fn camera_moved(&self) {
        self.live.cameras_moved.increment(1);
    }

    /// How much is stored, and whether more can be.
    pub fn storage(&self, status: &StorageStatus) {
        self.storage.is_full.set(f64::from(u8::from(status.is_full)));
        self.storage.database_bytes.set(status.database_bytes as f64);
        self.storage.database_free_bytes.set(status.free_bytes as f64);
        if let Some(bytes) = status.disk_available_bytes {
            self.storage.disk_available_bytes.set(bytes as f64);
        }
        self.storage.samples.set(status.samples as f64);
    }

    /// A request was answered.
    pub fn answered(&self, status: u16, time: Duration) {
        let class = usize::from(status / 100).clamp(1, 5) - 1;
        self.requests.answered[class].increment(1);
        self.requests.duration_s.record(time.as_secs_f64());
    }

    /// A request was refused because a limit on requests or bytes under way was reached.
    pub fn refused(&self) {
        self.requests.refused.increment(1);
    }

    /// A connection beyond a limit was refused.
    pub fn connection_refused(&self) {
        self.connections.refused.increment(1);
    }

    /// The server closed a connection by itself.
    pub fn connection_closed(&self, reason: CloseReason) {
        for (known, counter) in &self.connections.closed {
            counter.increment(u64::from(*known == reason));
        }
    }

    /// A connection was opened; it counts until the value is dropped.
    #[must_use]
    pub fn connection(&self) -> OpenConnection {
        self.connections.open.increment(1.0);
        OpenConnection(self.connections.open.clone())
    }
}

impl FusionMetrics {
    fn register(registry: &Registry) -> Self {
        Self {
            answered: registry.counter("sightfix_fusions_total", "Observations answered"),
            denied: registry.counter("sightfix_fusions_denied_total", "Observations answered without a fix"),
            outside_training: registry.counter(
                "sightfix_fusions_outside_training_total",
                "Observations whose box was unlike those trained on",
            ),
        }
    }
}

impl ImportMetrics {
    fn register(registry: &Registry) -> Self {
        let rows = |outcome| {
            registry.labelled("sightfix_samples_total", "Rows of imports, by outcome", "outcome", outcome)
        };
        Self { accepted: rows("accepted"), duplicate: rows("duplicate"), rejected: rows("rejected") }
    }
}

impl JobMetrics {
    /// Each pair is a metric's name and its description.
    fn register(registry: &Registry, total: [&'static str; 2], duration: [&'static str; 2]) -> Self {
        let ended = |state: JobState| registry.labelled(total[0], total[1], "state", state.as_str());
        Self {
            succeeded: ended(JobState::Succeeded),
            failed: ended(JobState::Failed),
            cancelled: ended(JobState::Cancelled),
            duration_s: registry.histogram(duration[0], duration[1]),
        }
    }
}

impl ConnectionMetrics {
    fn register(registry: &Registry) -> Self {
        let closed = |reason: CloseReason| {
            let help = "Connections that the server closed by itself, by reason";
            let name = "sightfix_connections_closed_total";
            (reason, registry.labelled(name, help, "reason", reason.as_str()))
        };
        Self {
            open: registry.gauge("sightfix_connections", "Open connections"),
            refused: registry.counter(
                "sightfix_connections_refused_total",
                "Connections beyond the limit, in all or of one client address",
            ),
            closed: CloseReason::ALL.map(closed),
        }
    }
}

impl RequestMetrics {
    fn register(registry: &Registry) -> Self {
        let answered = |class| {
            let help = "Requests answered, by class of status";
            registry.labelled("sightfix_http_requests_total", help, "status", class)
        };
        Self {
            answered: ["1xx", "2xx", "3xx", "4xx", "5xx"].map(answered),
            duration_s: registry
                .histogram("sightfix_http_request_duration_seconds", "Time to an answer's head"),
            refused: registry.counter(
                "sightfix_requests_refused_total",
                "Requests refused because a limit on requests or bytes in flight was reached",
            ),
        }
    }
}

impl LiveMetrics {
    fn register(registry: &Registry) -> Self {
        let rejections = |reason: RejectionReason| {
            let help = "Measured positions that tracks rejected, by reason";
            let name = "sightfix_track_rejections_total";
            (reason, registry.labelled(name, help, "reason", reason.as_str()))
        };
        Self {
            track_nis: registry.histogram(
                NIS,
                "Normalised innovation squared of tracks, 2 degrees of freedom each; mean 2 if consistent",
            ),
            track_rejections: RejectionReason::ALL.map(rejections),
            streams: registry.gauge("sightfix_live_streams", "Open live streams"),
            items: registry.counter("sightfix_live_items_total", "Items of live streams that were accepted"),
            item_errors: registry
                .counter("sightfix_live_item_errors_total", "Items of live streams that were refused"),
            answers_lost: registry.counter(
                "sightfix_live_answers_lost_total",
                "Answers of live streams that slow readers lost",
            ),
            cameras_moved: registry.counter("sightfix_cameras_moved_total", "Alarms that a camera was moved"),
        }
    }
}

impl StorageMetrics {
    fn register(registry: &Registry) -> Self {
        Self {
            is_full: registry.gauge("sightfix_storage_full", "1 while imports are refused for want of space"),
            database_bytes: registry.gauge("sightfix_database_bytes", "Size of the database file"),
            database_free_bytes: registry
                .gauge("sightfix_database_free_bytes", "Of these, free for new rows"),
            disk_available_bytes: registry
                .gauge("sightfix_disk_available_bytes", "Available on the disk of the data folder"),
            samples: registry.gauge("sightfix_samples_stored", "Samples of all cameras"),
        }
    }
}

/// Registers metrics with their descriptions.
struct Registry {
    recorder: PrometheusRecorder,
}

impl Registry {
    fn new() -> Self {
        let recorder = PrometheusBuilder::new()
            .set_buckets_for_metric(
                Matcher::Suffix("duration_seconds".to_owned()),
                &[0.000_1, 0.000_3, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0],
            )
            // Quantiles of chi-square with 2 degrees: 10, 25, 50, 75, 90, 95, 99 and 99.9 %.
            .and_then(|builder| {
                let bounds = &[0.21, 0.58, 1.39, 2.77, 4.61, 5.99, 9.21, 13.8];
                builder.set_buckets_for_metric(Matcher::Full(NIS.to_owned()), bounds)
            })
            .unwrap_or_else(|_| PrometheusBuilder::new())
            .build_recorder();
        Self { recorder }
    }

    fn counter(&self, name: &'static str, help: &'static str) -> Counter {
        self.counter_with(name, help, Vec::new())
    }

    fn labelled(
        &self,
        name: &'static str,
        help: &'static str,
        label: &'static str,
        value: &'static str,
    ) -> Counter {
        self.counter_with(name, help, vec![Label::new(label, value)])
    }

    fn counter_with(&self, name: &'static str, help: &'static str, labels: Vec<Label>) -> Counter {
        self.recorder.describe_counter(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_counter(&Key::from_parts(name, labels), &METADATA)
    }

    fn gauge(&self, name: &'static str, help: &'static str) -> Gauge {
        self.recorder.describe_gauge(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_gauge(&Key::from_name(name), &METADATA)
    }

    fn histogram(&self, name: &'static str, help: &'static str) -> Histogram {
        self.recorder.describe_histogram(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_histogram(&Key::from_name(name), &METADATA)
    }
}

/// Counts an open connection while it lives.
pub struct OpenConnection(Gauge);

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}
