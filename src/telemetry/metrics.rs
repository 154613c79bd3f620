//! Metrics, as one typed struct: no name is spelled at a call site.

use std::time::Duration;

use metrics::{
    Counter, Gauge, Histogram, Key, KeyName, Label, Level, Metadata, Recorder, SharedString, Unit,
};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle, PrometheusRecorder};

use crate::domain::{Flag, FusedFix, JobState};
use crate::fusion::track::{Rejection, RejectionReason};
use crate::store::StorageStatus;

/// Everything that is counted and timed.
#[derive(Clone)]
pub struct Metrics {
    handle: PrometheusHandle,
    fusions: Counter,
    fusions_denied: Counter,
    fusions_outside_training: Counter,
    samples_accepted: Counter,
    samples_duplicate: Counter,
    samples_rejected: Counter,
    /// Training runs.
    pub training_runs: JobMetrics,
    /// Evaluations.
    pub evaluations: JobMetrics,
    connections: Gauge,
    connections_refused: Counter,
    connections_closed: [(CloseReason, Counter); CloseReason::ALL.len()],
    http_requests: [Counter; 5],
    http_duration_s: Histogram,
    requests_refused: Counter,
    track_nis: Histogram,
    track_rejections: [(RejectionReason, Counter); RejectionReason::ALL.len()],
    live_streams: Gauge,
    live_items: Counter,
    live_item_errors: Counter,
    live_answers_lost: Counter,
    cameras_moved: Counter,
    storage_full: Gauge,
    database_bytes: Gauge,
    database_free_bytes: Gauge,
    disk_available_bytes: Gauge,
    samples_stored: Gauge,
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
            JobState::Queued | JobState::Running => return,
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
        let counter = |name: &'static str, help: &'static str, labels: Vec<Label>| {
            describe(&recorder, name, help, Recorder::describe_counter);
            recorder.register_counter(&Key::from_parts(name, labels), &METADATA)
        };
        let plain = |name, help| counter(name, help, Vec::new());
        let labelled = |name, help, label, value| counter(name, help, vec![Label::new(label, value)]);
        let samples =
            |outcome| labelled("sightfix_samples_total", "Rows of imports, by outcome", "outcome", outcome);
        let http = |class| {
            labelled("sightfix_http_requests_total", "Requests answered, by class of status", "status", class)
        };
        let histogram = |name: &'static str, help: &'static str| {
            describe(&recorder, name, help, Recorder::describe_histogram);
            recorder.register_histogram(&Key::from_name(name), &METADATA)
        };
        let jobs = |name, help, duration_name, duration_help| {
            let ended = |state: JobState| labelled(name, help, "state", state.as_str());
            JobMetrics {
                succeeded: ended(JobState::Succeeded),
                failed: ended(JobState::Failed),
                cancelled: ended(JobState::Cancelled),
                duration_s: histogram(duration_name, duration_help),
            }
        };
        let gauge = |name: &'static str, help: &'static str| {
            describe(&recorder, name, help, Recorder::describe_gauge);
            recorder.register_gauge(&Key::from_name(name), &METADATA)
        };
        describe(&recorder, "sightfix_connections", "Open connections", Recorder::describe_gauge);
        describe(&recorder, "sightfix_live_streams", "Open live streams", Recorder::describe_gauge);
        let rejections = |reason: RejectionReason| {
            let help = "Measured positions that tracks did not take up, by reason";
            (reason, labelled("sightfix_track_rejections_total", help, "reason", reason.as_str()))
        };
        let closed = |reason: CloseReason| {
            let help = "Connections that the server closed by itself, by reason";
            (reason, labelled("sightfix_connections_closed_total", help, "reason", reason.as_str()))
        };
        Self {
            fusions: plain("sightfix_fusions_total", "Observations answered"),
            fusions_denied: plain("sightfix_fusions_denied_total", "Observations answered without a fix"),
            fusions_outside_training: plain(
                "sightfix_fusions_outside_training_total",
                "Observations whose box was unlike those trained on",
            ),
            samples_accepted: samples("accepted"),
            samples_duplicate: samples("duplicate"),
            samples_rejected: samples("rejected"),
            training_runs: jobs(
                "sightfix_training_runs_total",
                "Training runs that ended",
                "sightfix_training_run_duration_seconds",
                "Time of a run",
            ),
            evaluations: jobs(
                "sightfix_evaluations_total",
                "Evaluations that ended",
                "sightfix_evaluation_duration_seconds",
                "Time of an evaluation",
            ),
            connections_refused: plain(
                "sightfix_connections_refused_total",
                "Connections beyond the limit, in all or of one client address",
            ),
            connections_closed: CloseReason::ALL.map(closed),
            connections: recorder.register_gauge(&Key::from_name("sightfix_connections"), &METADATA),
            http_requests: [http("1xx"), http("2xx"), http("3xx"), http("4xx"), http("5xx")],
            http_duration_s: histogram("sightfix_http_request_duration_seconds", "Time to an answer's head"),
            requests_refused: plain(
                "sightfix_requests_refused_total",
                "Requests refused because a limit on requests or bytes under way was reached",
            ),
            track_nis: histogram(
                NIS,
                "Normalised innovation squared of tracks, 2 degrees each; mean 2 if consistent",
            ),
            track_rejections: RejectionReason::ALL.map(rejections),
            live_streams: recorder.register_gauge(&Key::from_name("sightfix_live_streams"), &METADATA),
            live_items: plain("sightfix_live_items_total", "Items of live streams that were taken"),
            live_item_errors: plain(
                "sightfix_live_item_errors_total",
                "Items of live streams that were not taken",
            ),
            live_answers_lost: plain(
                "sightfix_live_answers_lost_total",
                "Answers of live streams that slow readers lost",
            ),
            cameras_moved: plain("sightfix_cameras_moved_total", "Alarms that a camera was moved"),
            storage_full: gauge("sightfix_storage_full", "1 while imports are refused for want of space"),
            database_bytes: gauge("sightfix_database_bytes", "Size of the database file"),
            database_free_bytes: gauge("sightfix_database_free_bytes", "Of these, free for new rows"),
            disk_available_bytes: gauge(
                "sightfix_disk_available_bytes",
                "Left on the disk of the data folder",
            ),
            samples_stored: gauge("sightfix_samples_stored", "Samples of all cameras"),
            handle: recorder.handle(),
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
        self.fusions.increment(fused.len() as u64);
        self.fusions_denied.increment(having(Flag::GnssDenied));
        self.fusions_outside_training.increment(having(Flag::OutsideTraining));
    }

    /// An import was read: rows by outcome.
    pub fn imported(&self, accepted: u64, duplicate: u64, rejected: u64) {
        self.samples_accepted.increment(accepted);
        self.samples_duplicate.increment(duplicate);
        self.samples_rejected.increment(rejected);
    }

    /// A track took up innovations, and did not take up others.
    pub fn tracked(&self, nis: impl Iterator<Item = f64>, rejected: &[Rejection]) {
        nis.for_each(|nis| self.track_nis.record(nis));
        for rejection in rejected {
            for (reason, counter) in &self.track_rejections {
                counter.increment(u64::from(*reason == rejection.reason));
            }
        }
    }

    /// A live stream was opened.
    pub fn stream_opened(&self) {
        self.live_streams.increment(1.0);
    }

    /// A live stream was closed.
    pub fn stream_closed(&self) {
        self.live_streams.decrement(1.0);
    }

    /// An item of a live stream was answered, well or with its error.
    pub fn item_answered(&self, taken: bool) {
        if taken { self.live_items.increment(1) } else { self.live_item_errors.increment(1) }
    }

    /// A slow reader lost an answer.
    pub fn answer_lost(&self) {
        self.live_answers_lost.increment(1);
    }

    /// A camera was found to have moved.
    pub fn camera_moved(&self) {
        self.cameras_moved.increment(1);
    }

    /// How much is stored, and whether more can be.
    pub fn storage(&self, status: &StorageStatus) {
        self.storage_full.set(f64::from(u8::from(status.is_full)));
        self.database_bytes.set(status.database_bytes as f64);
        self.database_free_bytes.set(status.free_bytes as f64);
        if let Some(bytes) = status.disk_available_bytes {
            self.disk_available_bytes.set(bytes as f64);
        }
        self.samples_stored.set(status.samples as f64);
    }

    /// A request was answered.
    pub fn answered(&self, status: u16, time: Duration) {
        let class = usize::from(status / 100).clamp(1, 5) - 1;
        self.http_requests[class].increment(1);
        self.http_duration_s.record(time.as_secs_f64());
    }

    /// A request was refused because a limit on requests or bytes under way was reached.
    pub fn refused(&self) {
        self.requests_refused.increment(1);
    }

    /// A connection beyond a limit was refused.
    pub fn connection_refused(&self) {
        self.connections_refused.increment(1);
    }

    /// The server closed a connection by itself.
    pub fn connection_closed(&self, reason: CloseReason) {
        for (known, counter) in &self.connections_closed {
            counter.increment(u64::from(*known == reason));
        }
    }

    /// A connection was opened; it counts until the value is dropped.
    #[must_use]
    pub fn connection(&self) -> OpenConnection {
        self.connections.increment(1.0);
        OpenConnection(self.connections.clone())
    }
}

fn describe(
    recorder: &PrometheusRecorder,
    name: &'static str,
    help: &'static str,
    by: fn(&PrometheusRecorder, KeyName, Option<Unit>, SharedString),
) {
    by(recorder, KeyName::from(name), None, SharedString::from(help));
}

/// Counts an open connection while it lives.
pub struct OpenConnection(Gauge);

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}
