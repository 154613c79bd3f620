//! Metrics, as one typed struct: no call site names a metric by a text.

mod answers;
mod cluster;
mod connections;
mod jobs;
mod live;
mod outside;
mod storage;

use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use metrics::{Counter, Gauge};
use metrics_exporter_prometheus::PrometheusHandle;

use self::answers::{FusionMetrics, ImportMetrics};
use self::cluster::ClusterMetrics;
use self::connections::ConnectionMetrics;
use self::jobs::QueueMetrics;
use self::live::{LiveMetrics, SiteMetrics};
use self::storage::{QuotaMetrics, StorageMetrics};
use super::process;
use super::registry::Registry;
use super::request_metrics::{RequestMetrics, Route, RpcCall};
use crate::admission::{QuotaUsage, Quotas};
use crate::domain::{Flag, FusedFix};
use crate::fusion::track::Rejection;
use crate::store::{JobCounts, StorageStatus};

pub use self::connections::{CloseReason, OpenConnection};
pub use self::jobs::JobMetrics;
pub use self::live::SiteItemOutcome;
pub use self::outside::OutsideFigures;

/// Everything that is counted and timed.
#[derive(Clone)]
pub struct Metrics {
    handle: PrometheusHandle,
    fusions: FusionMetrics,
    imports: ImportMetrics,
    pub training_runs: JobMetrics,
    pub evaluations: JobMetrics,
    connections: ConnectionMetrics,
    /// Metrics of connections with other systems, as text.
    outside: Arc<ArcSwap<String>>,
    requests: RequestMetrics,
    requests_refused: Counter,
    live: LiveMetrics,
    cluster: ClusterMetrics,
    sites: SiteMetrics,
    storage: StorageMetrics,
    quotas: [QuotaMetrics; Quotas::COUNT],
    queues: QueueMetrics,
    models_unusable: Gauge,
    maintenance_errors: Counter,
    retention_refused: Gauge,
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
            outside: Arc::new(ArcSwap::from_pointee(outside::rendered(&[]))),
            requests: RequestMetrics::new(&registry),
            requests_refused: registry.counter(
                "sightfix_requests_refused_total",
                "Requests refused because a limit on requests or bytes in flight was reached",
                &[],
            ),
            live: LiveMetrics::register(&registry),
            cluster: ClusterMetrics::register(&registry),
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
            retention_refused: registry.gauge(
                "sightfix_sample_retention_refused",
                "1 while no sample is deleted for its age since the clock is far from the newest sample",
                &[],
            ),
            handle: registry.handle(),
        }
    }

    /// The text that `/metrics` gives: these metrics, and the figures of the process at this moment.
    #[must_use]
    pub fn render(&self) -> String {
        self.handle.render() + self.outside.load().as_str() + &process::render()
    }

    /// Gathers recorded times into their buckets. They pile up until then, so this must run every
    /// few seconds whether anybody reads the metrics or not.
    pub fn maintenance_round(&self) {
        self.handle.run_upkeep();
    }

    /// Observations were answered.
    pub fn fused(&self, fused: &[FusedFix]) {
        self.fusions.answered.increment(fused.len() as u64);
        let flagged = [
            (Flag::GnssDenied, &self.fusions.denied),
            (Flag::OutsideTraining, &self.fusions.outside_training),
        ];
        for (flag, counter) in flagged {
            let count = fused.iter().filter(|fix| fix.flags.contains(&flag)).count();
            // An increment by 0 takes as long as any other.
            if count > 0 {
                counter.increment(count as u64);
            }
        }
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

    /// So many clocks of a site have become wrong.
    pub fn clocks_wrong(&self, clocks: usize) {
        self.live.clocks_wrong.increment(clocks as u64);
    }

    /// Number of processes that share the database.
    pub fn nodes(&self, nodes: usize) {
        self.cluster.nodes.set(nodes as f64);
    }

    /// Number of cameras that this process owns.
    pub fn owned_cameras(&self, cameras: usize) {
        self.cluster.owned_cameras.set(cameras as f64);
    }

    /// A camera was acquired whose owner has ended without releasing it.
    pub fn camera_taken_over(&self) {
        self.cluster.takeovers.increment(1);
    }

    /// This process could not renew its registration in time.
    pub fn node_registration_lost(&self) {
        self.cluster.registrations_lost.increment(1);
    }

    /// The database may have lost what it had acknowledged.
    pub fn database_history_broke(&self) {
        self.cluster.history_breaks.increment(1);
    }

    /// A box or fix was handed to the tracker of a site.
    pub fn site_item(&self, outcome: SiteItemOutcome) {
        for (known, counter) in &self.sites.items {
            counter.increment(u64::from(*known == outcome));
        }
    }

    /// A measurement could not be compared with places, for too many waited.
    pub fn place_measurement_dropped(&self) {
        self.live.place_measurements_dropped.increment(1);
    }

    /// Messages of place events were dropped, for too many waited in the outbox of a sink.
    pub fn place_messages_dropped(&self, count: u64) {
        self.live.place_messages_dropped.increment(count);
    }

    /// A finished track could not be kept, for too many waited for the archive.
    pub fn finished_track_dropped(&self) {
        self.live.finished_tracks_dropped.increment(1);
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

    /// True if samples are not deleted for their age, since the clock is not believed.
    pub fn retention_refused(&self, is_refused: bool) {
        self.retention_refused.set(f64::from(u8::from(is_refused)));
    }

    /// How much of the quotas is held.
    pub fn quotas(&self, usages: &[QuotaUsage; Quotas::COUNT]) {
        for (metrics, usage) in self.quotas.iter().zip(usages) {
            metrics.held.set(usage.held as f64);
            metrics.limit.set(usage.limit as f64);
        }
    }

    /// Number of jobs that have not ended.
    pub fn jobs(&self, counts: &JobCounts) {
        let QueueMetrics { training, evaluation } = &self.queues;
        for (gauges, counts) in [(training, counts.training), (evaluation, counts.evaluation)] {
            gauges[0].set(counts.queued as f64);
            gauges[1].set(counts.running as f64);
        }
    }

    /// Number of cameras with an active model that cannot be used.
    pub fn models_unusable(&self, cameras: usize) {
        self.models_unusable.set(cameras as f64);
    }

    /// Records the figures of connections with other systems.
    pub fn outside_connections(&self, connections: &[OutsideFigures]) {
        self.outside.store(Arc::new(outside::rendered(connections)));
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
