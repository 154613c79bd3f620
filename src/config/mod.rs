//! Settings and limits: defaults < file < `SIGHTFIX_*` < flags.

mod console;
mod load;
mod openid;
mod origin;
mod secret;
mod tls;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{Error, ErrorKind, Result, SampleOverflow, TimeBounds};

pub use console::Console;
pub use load::Overrides;
pub use openid::OpenIdSettings;
pub use secret::{DeclaredConnection, Secret};
pub use tls::TlsSettings;

/// Everything that can be set.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Folder of the database, created at the first start.
    #[schema(value_type = String)]
    pub data: PathBuf,
    /// URL of a PostgreSQL database that replaces the folder, such as
    /// `postgres://user:password@host/sightfix?sslmode=verify-full`; none by default.
    #[schema(value_type = Option<String>)]
    pub database: Option<Secret>,
    /// The role of this process among those that share one database.
    pub role: NodeRole,
    /// Address of this process for clients that others with the same database redirect here, such as
    /// `https://node-1.example.org:8443`; by default that of `listen`, if it names one machine.
    pub advertised_url: Option<String>,
    /// The response to a request for the live state of a camera that another process has: `redirect`, or `proxy`.
    pub camera_on_other_node: OtherNode,
    /// Seconds after which the live streams of a silent process go to another one with the same database.
    pub node_lease_s: u32,
    /// Address of the one port for REST and gRPC.
    #[schema(value_type = String)]
    pub listen: SocketAddr,
    /// Address of a second port, for probes and metrics alone, without keys and without TLS; none if left out.
    #[schema(value_type = Option<String>)]
    pub metrics_listen: Option<SocketAddr>,
    /// Host names under which clients reach the server besides its addresses, each with or without a
    /// port; `*` accepts every name.
    pub allowed_hosts: Vec<String>,
    /// Origins of other servers' pages that may use the REST interface from a browser, with a key, such as
    /// `https://maps.example.org`; none by default.
    pub cors_origins: Vec<String>,
    /// Addresses or networks (`10.0.0.0/8`) of proxies in front, whose `X-Forwarded-For` names the client.
    pub trusted_proxies: Vec<String>,
    /// Serve everybody on an address that other machines reach, while no key exists.
    pub insecure: bool,
    /// Secret of an administrator's key (`sightfix keys generate`), for the first start of a container.
    #[schema(value_type = Option<String>)]
    pub admin_key: Option<Secret>,
    /// File that contains that secret instead.
    #[schema(value_type = Option<String>)]
    pub admin_key_file: Option<PathBuf>,
    /// Encryption of the port.
    pub tls: TlsSettings,
    /// Sign-in of people by OpenID Connect.
    pub openid: OpenIdSettings,
    /// Secret of the key that `replay` sends to a server.
    #[schema(value_type = Option<String>)]
    pub api_key: Option<Secret>,
    /// `text` or `json` lines in the log.
    pub log_format: LogFormat,
    /// The filter of log lines, in the syntax of `tracing`'s env filter.
    pub log_filter: String,
    /// Collector of OpenTelemetry traces (OTLP over gRPC), such as `http://localhost:4317`; needs the cargo feature
    /// `otel`.
    pub trace_endpoint: Option<String>,
    /// Workers of training runs.
    pub training: Workers,
    /// Workers of evaluations.
    pub evaluation: Workers,
    /// Folder below which sinks of connections write files (`file:`), each in a folder of its own; without it there are
    /// no such sinks.
    #[schema(value_type = Option<String>)]
    pub export_folder: Option<PathBuf>,
    /// Where finished tracks of cameras and sites with a history are kept: a folder, or a bucket of an object store as
    /// `s3://bucket/prefix` (docs/howto/history.md); by default the folder `archive` in `data`.
    pub archive: Option<String>,
    /// Serial devices that sources of connections may read (`serial:`), as their addresses name them.
    #[schema(value_type = Vec<String>)]
    pub serial_devices: Vec<PathBuf>,
    /// Connections with other systems, as `POST /v1/connections` takes them; created or changed at the start.
    #[schema(value_type = Vec<String>)]
    pub connections: Vec<DeclaredConnection>,
    /// The operator's console.
    pub console: Console,
    /// The limits of everything that an outside client can make large.
    pub limits: Limits,
}

/// The response to a request for the live state of a camera that another process has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum OtherNode {
    /// The client gets the address of the other process: 307, or `UNAVAILABLE` with `owner` in `ErrorInfo`.
    Redirect,
    /// The request is sent on to that process.
    Proxy,
}

/// The role of a process among those that share one database.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum NodeRole {
    /// Answers clients, and works on training runs and evaluations.
    Both,
    /// Answers clients; jobs are left to others.
    Serve,
    /// Works on training runs and evaluations; its port has probes and metrics alone.
    Train,
}

impl NodeRole {
    /// True if it works on training runs and evaluations.
    #[must_use]
    pub const fn works_on_jobs(self) -> bool {
        matches!(self, Self::Both | Self::Train)
    }

    /// Its name in settings.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Both => "both",
            Self::Serve => "serve",
            Self::Train => "train",
        }
    }

    /// True if it answers clients.
    #[must_use]
    pub const fn answers_clients(self) -> bool {
        matches!(self, Self::Both | Self::Serve)
    }
}

/// Form of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Lines for people.
    Text,
    /// JSON for machines.
    Json,
}

/// Workers of one kind of background job.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Workers {
    /// Jobs carried out at the same time, each on a thread of its own at the lowest priority.
    pub workers: usize,
    /// Seconds after which another worker claims the job of a silent one.
    pub lease_s: u32,
}

/// Everything that an outside client can make large has its limit here.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Bytes of a request body, other than an import.
    pub body_bytes: usize,
    /// Bytes of a camera's picture.
    pub picture_bytes: usize,
    /// Bytes of an import's body.
    pub import_bytes: usize,
    /// Bytes of an import held in memory before it goes to a temporary file.
    pub import_memory_bytes: usize,
    /// Bytes of all imports held in memory; beyond, they go to temporary files at once.
    pub spool_memory_bytes: usize,
    /// Bytes of all imports in temporary files.
    pub spool_disk_bytes: usize,
    /// Client-streamed imports at a time.
    pub import_streams: usize,
    /// Bytes of all requests under way: their bodies, and 16 KiB each.
    pub request_memory_bytes: usize,
    /// Bytes of one gRPC message.
    pub message_bytes: usize,
    /// Observations in one fusion request.
    pub batch_observations: usize,
    /// Items on one page of a list.
    pub page_items: u32,
    /// Detections and fixes of an import in two parts, each; they are paired in memory.
    pub pairing_rows: usize,
    /// Imports in two parts that are paired at the same time; more wait.
    pub pairings: usize,
    /// Tracklets of an import whose boxes and fixes are matched.
    pub match_tracklets: usize,
    /// Receivers of an import whose boxes and fixes are matched.
    pub match_receivers: usize,
    /// Comparisons of an import whose boxes and fixes are matched: pairs of a tracklet and a fix during it, for each clock
    /// offset that is tried.
    pub match_comparisons: u64,
    /// Rejected rows of an import that are reported one by one.
    pub rejected_rows: usize,
    /// Bytes of a request's headers.
    pub header_bytes: u32,
    /// Seconds to send a request's headers.
    pub header_s: u64,
    /// Seconds after which a connection without a request, or whose client takes nothing of what is
    /// written, is closed; also the interval of HTTP/2 pings.
    pub idle_s: u64,
    /// Seconds over which the least rate of a body is measured.
    pub body_grace_s: u64,
    /// Least bytes per second of a body, and of a response that the client takes slowly.
    pub body_bytes_per_s: u64,
    /// HTTP/2 frames per second and connection that carry neither headers nor data.
    pub control_frames_per_s: u32,
    /// New connections per second of one address, TLS handshakes included; 0 is no limit.
    pub connections_per_s: u32,
    /// Seconds for which an address that flooded a connection is refused new ones; 0 refuses none.
    pub flood_penalty_s: u64,
    /// Bytes per second of bodies of one client that are refused for what they contain; beyond, the client waits
    /// before its next body is read. 0 is no limit.
    pub refused_bytes_per_s: u32,
    /// Seconds that a request may take, its body included, until its answer begins.
    pub request_s: u64,
    /// Number of open connections.
    pub connections: usize,
    /// Streams per HTTP/2 connection.
    pub streams_per_connection: u32,
    /// Requests worked on at a time; one counts from the end of its body to the start of its answer.
    pub requests: usize,
    /// Number of `requests` that are reserved for fusions.
    pub reserved_requests: usize,
    /// Requests per second of one client, which is a key, or an address without one; 0 is no limit.
    pub requests_per_s: u32,
    /// Requests per second of one address without a key, session or certificate that works, where one is needed; 0 is
    /// no limit.
    pub anonymous_requests_per_s: u32,
    /// Sessions of browsers at a time; beyond, nobody signs in.
    pub sessions: usize,
    /// Sessions of one key, or of one person, at a time; beyond, their oldest ends.
    pub sessions_per_key: usize,
    /// Share of each limit on requests, streams and bytes that one client (a key, or an address without
    /// one) may hold, and of the limit on connections that one address may hold; above 0 and up to 1.
    pub client_share: f64,
    /// Event streams open at a time.
    pub event_streams: usize,
    /// Targets followed at a time, per camera.
    pub tracks_per_camera: usize,
    /// Points of a target's track that are kept, half a second or more apart.
    pub track_points: usize,
    /// Memory of the recorded path of one track, bytes; beyond, every second point is left out.
    pub history_track_bytes: usize,
    /// Finished tracks that wait for the archive; beyond, they are not kept.
    pub history_queue: usize,
    /// Seconds that the time of a live item may be ahead of the server's clock; beyond, it is refused.
    pub live_ahead_s: u32,
    /// Live streams open at a time.
    pub live_streams: usize,
    /// Live streams open at a time under one client name.
    pub live_streams_per_client: usize,
    /// Answers of a live stream that wait for a slow reader; beyond that the oldest are dropped.
    pub live_answers: usize,
    /// Seconds after which a live stream without an item is ended.
    pub live_idle_s: u64,
    /// Seconds after which the client of a live stream is asked to open another.
    pub live_age_s: u64,
    /// Training runs that have not ended, over all cameras; also over all sites.
    pub live_runs: u32,
    /// Passes of one training run.
    pub epochs: u32,
    /// Seconds until a retraining after a camera was moved is tried again, if it could not start, failed or
    /// was not promoted; doubled with each attempt, up to 64 times as long.
    pub retrain_pause_s: u32,
    /// Samples with a fix of one training run; the latest are taken.
    pub samples_per_run: u32,
    /// Samples with a fix of one training run of a site, of all its cameras; the latest of each are taken.
    pub samples_per_site_run: u32,
    /// Cameras of one training run of a site.
    pub cameras_per_site_run: u32,
    /// Boxes without a fix of one training run or evaluation; more are thinned evenly.
    pub boxes_without_fix_per_run: u32,
    /// Evaluations that have not ended, over all cameras.
    pub live_evaluations: u32,
    /// Seeds of one evaluation.
    pub evaluation_seeds: u32,
    /// Samples of one evaluation, those to learn from and those to judge on together.
    pub rows_per_evaluation: u32,
    /// Positions of the line that is an evaluation's truth.
    pub truth_line_positions: usize,
    /// Cameras; more are refused.
    pub cameras: u32,
    /// Sites; more are refused.
    pub sites: u32,
    /// Places; more are refused.
    pub places: u32,
    /// Measurements that wait to be compared with places; beyond, they are dropped.
    pub place_queue: usize,
    /// Events of all places; beyond, the oldest are deleted.
    pub place_events: u32,
    /// Days that the counts of a place by minutes are kept, before its newest ones.
    pub place_minute_days: u32,
    /// Days that its counts by hours are kept.
    pub place_hour_days: u32,
    /// Connections with other systems; more are refused.
    pub outside_connections: u32,
    /// Bytes of one message of a connection; a larger one is skipped.
    pub connection_message_bytes: usize,
    /// Messages of one source that were read and not taken yet; beyond, no more are read.
    pub connection_queue: usize,
    /// Messages of one source, or boxes and fixes of them, that wait until what is to be stored is stored; beyond, no more
    /// are read.
    pub connection_unsettled: usize,
    /// Bytes that one source holds of messages that were read and not taken yet; beyond, no more are read.
    pub connection_queue_bytes: usize,
    /// Bytes of a compressed batch of messages of a source once it is decompressed; a larger one is rejected.
    pub connection_batch_bytes: usize,
    /// Clients that may be connected to one listening source.
    pub connection_clients: usize,
    /// Messages of one sink that wait for their receiver; beyond, the oldest is dropped.
    pub outbox_messages: u32,
    /// Files of one sink; beyond, the oldest is deleted.
    pub export_files: usize,
    /// Messages of one sink that were refused or could not be delivered; beyond, the oldest is deleted.
    pub dead_letters: u32,
    /// Boxes and fixes of one site that wait for its tracker; beyond, they are dropped.
    pub site_queue: usize,
    /// Frames of one site that wait for earlier ones of other cameras; beyond, the oldest is tracked.
    pub site_frames: usize,
    /// Boxes of one frame; beyond, they are dropped.
    pub boxes_per_frame: usize,
    /// Milliseconds that a frame waits for the rest of its boxes, and for earlier frames of other cameras.
    pub site_wait_ms: u64,
    /// World tracks of one site.
    pub tracks_per_site: usize,
    /// Events of one site that a reader may continue after; a slower one loses the oldest.
    pub site_events: usize,
    /// Boxes and fixes that a camera without a model records to learn from; beyond, the oldest are deleted.
    pub recording_rows: u64,
    /// Bytes of that recording; beyond, the oldest rows are deleted.
    pub recording_bytes: u64,
    /// Hours that it is kept.
    pub recording_hours: u32,
    /// Samples of one camera.
    pub samples_per_camera: u64,
    /// Days that samples are kept, by their times; 0 is without end.
    pub sample_days: u32,
    /// The rule beyond `samples_per_camera`: `refuse`, or `delete_oldest`.
    #[schema(value_type = String)]
    pub sample_overflow: SampleOverflow,
    /// Samples of all cameras; more are refused.
    pub samples: u64,
    /// Model versions of one camera; beyond, the oldest that is not active is deleted.
    pub models_per_camera: u32,
    /// Ended training runs of one camera; beyond, the oldest is deleted.
    pub ended_runs_per_camera: u32,
    /// Ended evaluations of all cameras; beyond, the oldest is deleted.
    pub ended_evaluations: u32,
    /// Keys; those that no longer work make room for new ones, else more are refused.
    pub keys: u32,
    /// Entries of the audit log; beyond, the oldest is deleted.
    pub audit_entries: u32,
    /// Answers that are stored under idempotency keys; beyond, the oldest is deleted.
    pub idempotency_keys: u32,
    /// Seconds for which an answer is repeated under its idempotency key.
    pub idempotency_key_s: u32,
    /// Bytes of the database, beyond which nothing is stored; 0 is no limit but the disk's.
    pub database_bytes: u64,
    /// Bytes on the disk that are reserved for deletions when it is full; 0 reserves none.
    pub reserve_bytes: u64,
    /// Seconds in which a server that shuts down ends its open requests and streams.
    pub drain_s: u64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            data: PathBuf::from("data"),
            database: None,
            role: NodeRole::Both,
            advertised_url: None,
            camera_on_other_node: OtherNode::Redirect,
            node_lease_s: 4,
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            metrics_listen: None,
            allowed_hosts: Vec::new(),
            cors_origins: Vec::new(),
            trusted_proxies: Vec::new(),
            insecure: false,
            admin_key: None,
            admin_key_file: None,
            tls: TlsSettings::default(),
            openid: OpenIdSettings::default(),
            api_key: None,
            log_format: LogFormat::Text,
            log_filter: "info".to_owned(),
            trace_endpoint: None,
            training: Workers::default(),
            evaluation: Workers::default(),
            export_folder: None,
            archive: None,
            serial_devices: Vec::new(),
            connections: Vec::new(),
            console: Console::default(),
            limits: Limits::default(),
        }
    }
}

impl Default for Workers {
    fn default() -> Self {
        Self { workers: 1, lease_s: 15 }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            body_bytes: 1 << 20,
            picture_bytes: 2 << 20,
            import_bytes: 64 << 20,
            import_memory_bytes: 4 << 20,
            spool_memory_bytes: 128 << 20,
            spool_disk_bytes: 1 << 30,
            import_streams: 64,
            request_memory_bytes: 256 << 20,
            message_bytes: 4 << 20,
            batch_observations: 1_000,
            page_items: 1_000,
            pairing_rows: 500_000,
            pairings: 1,
            match_tracklets: 20_000,
            match_receivers: 200,
            match_comparisons: 2_000_000,
            rejected_rows: 100,
            header_bytes: 32 << 10,
            header_s: 10,
            idle_s: 30,
            body_grace_s: 20,
            body_bytes_per_s: 500,
            control_frames_per_s: 10_000,
            connections_per_s: 1_000,
            flood_penalty_s: 10,
            refused_bytes_per_s: 1 << 20,
            request_s: 300,
            connections: 10_000,
            streams_per_connection: 256,
            requests: 1_024,
            reserved_requests: 256,
            requests_per_s: 0,
            anonymous_requests_per_s: 200,
            sessions: 10_000,
            sessions_per_key: 16,
            client_share: 0.5,
            event_streams: 256,
            tracks_per_camera: 256,
            track_points: 240,
            history_track_bytes: 256 << 10,
            history_queue: 1_024,
            live_ahead_s: 5,
            live_streams: 2_048,
            live_streams_per_client: 64,
            live_answers: 256,
            live_idle_s: 300,
            live_age_s: 3_600,
            live_runs: 256,
            epochs: 10_000,
            retrain_pause_s: 15,
            samples_per_run: 100_000,
            samples_per_site_run: 100_000,
            cameras_per_site_run: 16,
            boxes_without_fix_per_run: 20_000,
            live_evaluations: 64,
            evaluation_seeds: 20,
            rows_per_evaluation: 100_000,
            truth_line_positions: 1_000,
            cameras: 10_000,
            sites: 1_000,
            places: 20_000,
            place_queue: 65_536,
            place_events: 1_000_000,
            place_minute_days: 7,
            place_hour_days: 400,
            outside_connections: 256,
            connection_message_bytes: 1 << 20,
            connection_queue: 1_024,
            connection_unsettled: 32_768,
            connection_queue_bytes: 8 << 20,
            connection_batch_bytes: 16 << 20,
            connection_clients: 64,
            outbox_messages: 100_000,
            export_files: 256,
            dead_letters: 1_000,
            site_queue: 16_384,
            site_frames: 1_024,
            boxes_per_frame: 256,
            site_wait_ms: 300,
            tracks_per_site: 1_024,
            site_events: 4_096,
            recording_rows: 100_000,
            recording_bytes: 16 << 20,
            recording_hours: 24,
            samples_per_camera: 10_000_000,
            sample_days: 0,
            sample_overflow: SampleOverflow::Refuse,
            samples: 100_000_000,
            models_per_camera: 100,
            ended_runs_per_camera: 100,
            ended_evaluations: 1_000,
            keys: 1_000,
            audit_entries: 100_000,
            idempotency_keys: 100_000,
            idempotency_key_s: 86_400,
            database_bytes: 0,
            reserve_bytes: 32 << 20,
            drain_s: 8,
        }
    }
}

impl Limits {
    /// Checks the length of a batch, before its items are read.
    ///
    /// # Errors
    /// `TooLarge` and, for none at all, `InvalidArgument`, naming the field `observations`.
    pub fn check_batch(&self, observations: usize) -> Result<()> {
        if observations == 0 {
            return Err(Error::invalid("observations", "must be one or more"));
        }
        let most = self.batch_observations;
        if observations > most {
            return Err(Error::field(
                ErrorKind::TooLarge,
                "observations",
                format!("are {observations}, at most {most} go into one request; send several"),
            ));
        }
        Ok(())
    }

    /// The bounds of times that may enter tracks and drift detection.
    #[must_use]
    pub fn live_time_bounds(&self, now: Timestamp) -> TimeBounds {
        TimeBounds::live_at(now, self.live_ahead_s)
    }

    /// Time to send a request's headers.
    #[must_use]
    pub const fn header_time(&self) -> Duration {
        Duration::from_secs(self.header_s)
    }

    /// Time without a request, or without progress of a write, after which a connection is closed.
    #[must_use]
    pub const fn idle_time(&self) -> Duration {
        Duration::from_secs(self.idle_s)
    }

    /// Time over which the least rate of a body is measured.
    #[must_use]
    pub const fn body_grace(&self) -> Duration {
        Duration::from_secs(self.body_grace_s)
    }

    /// Time in which a server that shuts down ends its open requests and streams.
    #[must_use]
    pub const fn drain_time(&self) -> Duration {
        Duration::from_secs(self.drain_s)
    }
}
