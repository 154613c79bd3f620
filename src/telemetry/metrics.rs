//! Metrics, as one typed struct: no name is spelled at a call site.

use std::sync::Arc;
use std::time::Duration;

use metrics::{Counter, Gauge, Histogram};
use metrics_exporter_prometheus::PrometheusHandle;

use super::process;
use super::registry::Registry;
use super::request_metrics::{RequestMetrics, Route, RpcCall};
use crate::admission::{QuotaUsage, Quotas};
use crate::domain::{Flag, FusedFix, JobState};
use crate::fusion::track::{Rejection, RejectionReason};
use crate::store::{JobCounts, StorageStatus};

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
    requests_refused: Counter,
    live: LiveMetrics,
    sites: SiteMetrics,
    storage: StorageMetrics,
    quotas: [QuotaMetrics; Quotas::COUNT],
    queues: QueueMetrics,
    models_unusable: Gauge,
    maintenance_errors: Counter,
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
struct SiteMetrics {
    items: [(SiteItemOutcome, Counter); SiteItemOutcome::ALL.len()],
    tracks: Gauge,
    tracks_started: Counter,
    handovers: Counter,
    events_lost: Counter,
}

/// What became of a box or fix that was handed to the tracker of a site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SiteItemOutcome {
    /// It went into the tracker.
    Tracked,
    /// A later frame had been tracked before.
    Late,
    /// The queue, or its frame, was full.
    Overflow,
    /// It is beyond the range of the site's plane.
    OutOfRange,
    /// Its position is too uncertain to tell targets apart.
    Uncertain,
}

impl SiteItemOutcome {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Tracked, Self::Late, Self::Overflow, Self::OutOfRange, Self::Uncertain];

    /// The label in the metrics.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Tracked => "tracked",
            Self::Late => "late",
            Self::Overflow => "overflow",
            Self::OutOfRange => "out_of_range",
            Self::Uncertain => "uncertain",
        }
    }
}

#[derive(Clone)]
struct StorageMetrics {
    is_full: Gauge,
    database_bytes: Gauge,
    database_free_bytes: Gauge,
    disk_available_bytes: Gauge,
    samples: Gauge,
    queued_rows: Gauge,
}

#[derive(Clone)]
struct QuotaMetrics {
    held: Gauge,
    limit: Gauge,
}

/// Jobs that have not ended.
#[derive(Clone)]
struct QueueMetrics {
    training: [Gauge; 2],
    evaluation: [Gauge; 2],
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

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// Metrics of one server; two in one process do not mix.
    #[must_use]
    pub fn new() -> Self {
        let registry = Arc::new(Registry::new());
        register_build_info(&registry);
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
            requests: RequestMetrics::new(&registry),
            requests_refused: registry.counter(
                "sightfix_requests_refused_total",
                "Requests refused because a limit on requests or bytes in flight was reached",
                &[],
            ),
            live: LiveMetrics::register(&registry),
            sites: SiteMetrics::register(&registry),
            storage: StorageMetrics::register(&registry),
            quotas: Quotas::NAMES.map(|name| QuotaMetrics::register(&registry, name)),
            queues: QueueMetrics::register(&registry),
            models_unusable: registry.gauge(
                "sightfix_models_unusable",
                "Cameras whose active model cannot be used",
                &[],
            ),
            maintenance_errors: registry.counter(
                "sightfix_maintenance_errors_total",
                "Rounds of the store's maintenance that failed",
                &[],
            ),
            handle: registry.handle(),
        }
    }

    /// The text that `/metrics` gives: these metrics, and the figures of the process at this moment.
    #[must_use]
    pub fn render(&self) -> String {
        self.handle.render() + &process::render()
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

    /// A box or fix was handed to the tracker of a site.
    pub fn site_item(&self, outcome: SiteItemOutcome) {
        for (known, counter) in &self.sites.items {
            counter.increment(u64::from(*known == outcome));
        }
    }

    /// A world track was confirmed.
    pub fn world_track_started(&self) {
        self.sites.tracks_started.increment(1);
        self.sites.tracks.increment(1.0);
    }

    /// A world track has ended, or was merged into another.
    pub fn world_track_ended(&self) {
        self.sites.tracks.decrement(1.0);
    }

    /// A camera sees a target that another camera saw before.
    pub fn handed_over(&self) {
        self.sites.handovers.increment(1);
    }

    /// Events of a site were lost to a slow reader.
    pub fn site_events_lost(&self, events: u64) {
        self.sites.events_lost.increment(events);
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
        self.storage.queued_rows.set(f64::from(status.queued_rows));
    }

    /// A round of the store's maintenance failed.
    pub fn maintenance_failed(&self) {
        self.maintenance_errors.increment(1);
    }

    /// How much of the quotas is held.
    pub fn quotas(&self, usages: &[QuotaUsage; Quotas::COUNT]) {
        for (metrics, usage) in self.quotas.iter().zip(usages) {
            metrics.held.set(usage.held as f64);
            metrics.limit.set(usage.limit as f64);
        }
    }

    /// How many jobs have not ended.
    pub fn jobs(&self, counts: &JobCounts) {
        let QueueMetrics { training, evaluation } = &self.queues;
        for (gauges, counts) in [(training, counts.training), (evaluation, counts.evaluation)] {
            gauges[0].set(counts.queued as f64);
            gauges[1].set(counts.running as f64);
        }
    }

    /// How many cameras have an active model that cannot be used.
    pub fn models_unusable(&self, cameras: usize) {
        self.models_unusable.set(cameras as f64);
    }

    /// A REST request was answered.
    pub fn answered(&self, route: Route, status: u16, time: Duration) {
        self.requests.answered(route, status, time);
    }

    /// A call of an RPC begins; it is counted when the value is dropped.
    #[must_use]
    pub fn call(&self, rpc: &'static str) -> RpcCall {
        self.requests.call(rpc)
    }

    /// A request was refused because a limit on requests or bytes under way was reached.
    pub fn refused(&self) {
        self.requests_refused.increment(1);
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
    fn register(registry: &Registry) -> Self {
        let rows = |outcome| {
            registry.counter("sightfix_samples_total", "Rows of imports, by outcome", &[("outcome", outcome)])
        };
        Self { accepted: rows("accepted"), duplicate: rows("duplicate"), rejected: rows("rejected") }
    }
}

impl JobMetrics {
    /// Each pair is a metric's name and its description.
    fn register(registry: &Registry, total: [&'static str; 2], duration: [&'static str; 2]) -> Self {
        let ended = |state: JobState| registry.counter(total[0], total[1], &[("state", state.as_str())]);
        Self {
            succeeded: ended(JobState::Succeeded),
            failed: ended(JobState::Failed),
            cancelled: ended(JobState::Cancelled),
            duration_s: registry.histogram(duration[0], duration[1], &[]),
        }
    }
}

impl ConnectionMetrics {
    fn register(registry: &Registry) -> Self {
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

impl QuotaMetrics {
    fn register(registry: &Registry, resource: &'static str) -> Self {
        let labels = [("resource", resource)];
        Self {
            held: registry.gauge("sightfix_quota_held", "Held of a bounded resource by all clients", &labels),
            limit: registry.gauge("sightfix_quota_limit", "Limit of a bounded resource", &labels),
        }
    }
}

impl QueueMetrics {
    fn register(registry: &Registry) -> Self {
        let jobs = |kind| {
            ["queued", "running"].map(|state| {
                let labels = [("kind", kind), ("state", state)];
                registry.gauge("sightfix_jobs", "Background jobs that have not ended", &labels)
            })
        };
        Self { training: jobs("training"), evaluation: jobs("evaluation") }
    }
}

fn register_build_info(registry: &Registry) {
    let profile = if cfg!(debug_assertions) { "debug" } else { "release" };
    let labels = [
        ("version", env!("CARGO_PKG_VERSION")),
        ("os", std::env::consts::OS),
        ("architecture", std::env::consts::ARCH),
        ("profile", profile),
    ];
    registry.gauge("sightfix_build_info", "1; the labels tell what runs", &labels).set(1.0);
}

impl LiveMetrics {
    fn register(registry: &Registry) -> Self {
        let rejections = |reason: RejectionReason| {
            let help = "Measured positions that tracks rejected, by reason";
            let name = "sightfix_track_rejections_total";
            (reason, registry.counter(name, help, &[("reason", reason.as_str())]))
        };
        Self {
            track_nis: registry.histogram(
                "sightfix_track_nis",
                "Normalised innovation squared of tracks, 2 degrees of freedom each; mean 2 if consistent",
                &[],
            ),
            track_rejections: RejectionReason::ALL.map(rejections),
            streams: registry.gauge("sightfix_live_streams", "Open live streams", &[]),
            items: registry.counter(
                "sightfix_live_items_total",
                "Items of live streams that were accepted",
                &[],
            ),
            item_errors: registry.counter(
                "sightfix_live_item_errors_total",
                "Items of live streams that were refused",
                &[],
            ),
            answers_lost: registry.counter(
                "sightfix_live_answers_lost_total",
                "Answers of live streams that slow readers lost",
                &[],
            ),
            cameras_moved: registry.counter(
                "sightfix_cameras_moved_total",
                "Alarms that a camera was moved",
                &[],
            ),
        }
    }
}

impl SiteMetrics {
    fn register(registry: &Registry) -> Self {
        let items = |outcome: SiteItemOutcome| {
            let help = "Boxes and fixes handed to the trackers of sites, by outcome";
            (outcome, registry.counter("sightfix_site_items_total", help, &[("outcome", outcome.as_str())]))
        };
        Self {
            items: SiteItemOutcome::ALL.map(items),
            tracks: registry.gauge("sightfix_world_tracks", "Confirmed world tracks of all sites", &[]),
            tracks_started: registry.counter(
                "sightfix_world_tracks_started_total",
                "World tracks that were confirmed",
                &[],
            ),
            handovers: registry.counter(
                "sightfix_world_track_handovers_total",
                "Targets handed over from camera to camera",
                &[],
            ),
            events_lost: registry.counter(
                "sightfix_site_events_lost_total",
                "Events of sites that slow readers lost",
                &[],
            ),
        }
    }
}

impl StorageMetrics {
    fn register(registry: &Registry) -> Self {
        Self {
            is_full: registry.gauge(
                "sightfix_storage_full",
                "1 while imports are refused for want of space",
                &[],
            ),
            database_bytes: registry.gauge("sightfix_database_bytes", "Size of the database file", &[]),
            database_free_bytes: registry.gauge(
                "sightfix_database_free_bytes",
                "Of these, free for new rows",
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

/// Counts an open connection while it lives.
pub struct OpenConnection(Gauge);

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}
