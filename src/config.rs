//! Settings and limits: defaults < file < `SIGHTFIX_*` < flags.

use std::io::Read as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use crate::domain::{CameraId, Role, SampleOverflow, Scope};

/// Everything that can be set.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Folder of the database, created at the first start.
    pub data: PathBuf,
    /// Address of the one port for REST and gRPC.
    pub listen: SocketAddr,
    /// Address of a second port, for probes and metrics alone, without keys and without TLS; none if left out.
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
    pub admin_key: Option<Secret>,
    /// File that contains that secret instead.
    pub admin_key_file: Option<PathBuf>,
    /// Encryption of the port.
    pub tls: TlsSettings,
    /// Secret of the key that `replay` sends to a server.
    pub api_key: Option<Secret>,
    /// `text` or `json` lines in the log.
    pub log_format: LogFormat,
    /// What is logged, as `tracing`'s env filter reads it.
    pub log_filter: String,
    /// Collector of OpenTelemetry traces (OTLP over gRPC), such as `http://localhost:4317`; needs the cargo feature
    /// `otel`.
    pub trace_endpoint: Option<String>,
    /// Workers of training runs.
    pub training: Workers,
    /// Workers of evaluations.
    pub evaluation: Workers,
    /// Connections with other systems, as `POST /v1/connections` takes them; created or changed at the start.
    pub connections: Vec<DeclaredConnection>,
    /// The operator's console.
    pub console: Console,
    /// What an outside client may make large.
    pub limits: Limits,
}

/// Encryption of the port.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TlsSettings {
    /// File with the server's certificate chain (PEM); plain HTTP without.
    pub certificate: Option<PathBuf>,
    /// File with its private key (PEM).
    pub key: Option<PathBuf>,
    /// File with the authority of client certificates (PEM); none are asked for without.
    pub client_ca: Option<PathBuf>,
    /// What holders of client certificates may do: `viewer` if left out, `edge`, `operator`, `admin`.
    pub client_role: Option<String>,
    /// The cameras that the role `edge` is restricted to.
    pub client_camera_ids: Vec<String>,
}

impl TlsSettings {
    /// The files of the certificate and of its key; `None` for plain HTTP.
    ///
    /// # Errors
    /// Names the setting that is missing.
    pub fn certificate_and_key(&self) -> anyhow::Result<Option<(&Path, &Path)>> {
        match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => Ok(Some((certificate, key))),
            (None, None) if self.client_ca.is_none() => Ok(None),
            _ => anyhow::bail!(
                "tls.certificate and tls.key must be given together, tls.client_ca only with them"
            ),
        }
    }

    /// What holders of client certificates may do.
    ///
    /// # Errors
    /// Names the setting that cannot be used.
    pub fn client_scope(&self) -> anyhow::Result<Scope> {
        let role = self.client_role.as_deref().map_or(Ok(Role::Viewer), str::parse);
        let role = role.context("the setting tls.client_role")?;
        let cameras = self.client_camera_ids.iter().map(|id| CameraId::new(id));
        let cameras = cameras.collect::<Result<_, _>>().context("the setting tls.client_camera_ids")?;
        Scope::new(role, cameras).context("the setting tls.client_camera_ids")
    }
}

/// A setting that is never shown.
#[derive(Clone, PartialEq, Eq, Deserialize)]
#[serde(transparent)]
pub struct Secret(String);

impl Secret {
    /// The text.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

const HIDDEN: &str = "(hidden)";

impl std::fmt::Debug for Secret {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str(HIDDEN)
    }
}

impl Serialize for Secret {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(HIDDEN)
    }
}

/// A connection with another system, by the JSON of its description. Its secrets are never shown.
#[derive(Clone, PartialEq, Deserialize)]
#[serde(transparent)]
pub struct DeclaredConnection(serde_json::Map<String, serde_json::Value>);

impl DeclaredConnection {
    /// The description as JSON, with its secrets.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn json(&self) -> serde_json::Result<Vec<u8>> {
        serde_json::to_vec(&self.0)
    }

    fn without_secrets(&self) -> serde_json::Map<String, serde_json::Value> {
        let mut shown = self.0.clone();
        if let Some(secrets) = shown.get_mut("secrets") {
            *secrets = HIDDEN.into();
        }
        shown
    }
}

impl std::fmt::Debug for DeclaredConnection {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Debug::fmt(&self.without_secrets(), out)
    }
}

impl Serialize for DeclaredConnection {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.without_secrets().serialize(serializer)
    }
}

/// Form of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    Text,
    /// For machines.
    Json,
}

/// Workers of one kind of background job.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Workers {
    /// Jobs carried out at the same time, each on a thread of its own at the lowest priority.
    pub workers: usize,
    /// Seconds after which another worker claims the job of a silent one.
    pub lease_s: u32,
}

/// What the operator's console shows beside the server's own values.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Console {
    /// Map tiles under the cameras, with `{z}`, `{x}` and `{y}`; without it the map is a plain plane and the
    /// console asks no other server.
    pub tile_url: Option<String>,
    /// A PMTiles file of map tiles that the server itself offers; instead of `tile_url`.
    pub tile_file: Option<PathBuf>,
    /// What the provider of the tiles asks to be shown on the map.
    pub tile_attribution: Option<String>,
}

/// Everything that an outside client can make large has its limit here.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Bytes of a request body, other than an import.
    pub body_bytes: usize,
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
    /// Seconds that a request may take, its body included, until its answer begins.
    pub request_s: u64,
    /// Open connections.
    pub connections: usize,
    /// Streams per HTTP/2 connection.
    pub streams_per_connection: u32,
    /// Requests worked on at a time; one counts from the end of its body to the begin of its answer.
    pub requests: usize,
    /// How many of `requests` are reserved for fusions.
    pub reserved_requests: usize,
    /// Requests per second of one client, which is a key, or an address without one; 0 is no limit.
    pub requests_per_s: u32,
    /// Share of each limit on requests, streams and bytes that one client (a key, or an address without
    /// one) may hold, and of the limit on connections that one address may hold; above 0 and up to 1.
    pub client_share: f64,
    /// Event streams open at a time.
    pub event_streams: usize,
    /// Targets followed at a time, per camera.
    pub tracks_per_camera: usize,
    /// Points of a target's track that are kept, half a second or more apart.
    pub track_points: usize,
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
    /// Training runs that have not ended, over all cameras.
    pub live_runs: u32,
    /// Passes of one training run.
    pub epochs: u32,
    /// Seconds until a retraining after a camera was moved is tried again, if it could not start, failed or
    /// was not promoted; doubled with each attempt, up to 64 times as long.
    pub retrain_pause_s: u32,
    /// Samples with a fix of one training run; the latest are taken.
    pub samples_per_run: u32,
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
    /// Connections with other systems; more are refused.
    pub outside_connections: u32,
    /// Bytes of one message of a connection; a larger one is skipped.
    pub connection_message_bytes: usize,
    /// Messages of one source that are not settled yet; beyond, no more are read.
    pub connection_queue: usize,
    /// Messages of one sink that wait for their receiver; beyond, the oldest is dropped.
    pub outbox_messages: u32,
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
    /// Events of one site that a reader may continue behind; a slower one loses the oldest.
    pub site_events: usize,
    /// Samples of one camera.
    pub samples_per_camera: u64,
    /// What happens beyond `samples_per_camera`: `refuse`, or `delete_oldest`.
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

/// How a PMTiles file of version 3 begins.
const PMTILES_MAGIC: &[u8; 8] = b"PMTiles\x03";

impl Console {
    fn check(&self) -> anyhow::Result<()> {
        if let Some(url) = &self.tile_url {
            anyhow::ensure!(
                tile_origin(url).is_some() && ["{z}", "{x}", "{y}"].iter().all(|part| url.contains(part)),
                "console.tile_url must be a URL like https://tiles.example.org/{{z}}/{{x}}/{{y}}.png"
            );
        }
        let Some(file) = &self.tile_file else { return Ok(()) };
        anyhow::ensure!(self.tile_url.is_none(), "give console.tile_url or console.tile_file, not both");
        let mut magic = [0; PMTILES_MAGIC.len()];
        std::fs::File::open(file)
            .and_then(|mut opened| opened.read_exact(&mut magic))
            .with_context(|| format!("console.tile_file: cannot read {}", file.display()))?;
        anyhow::ensure!(
            magic == *PMTILES_MAGIC,
            "console.tile_file must be a PMTiles file of version 3; {} is none",
            file.display()
        );
        Ok(())
    }

    /// The origin of the tiles' server (`https://tiles.example.org`), for the console's security policy;
    /// `None` for tiles of this server.
    #[must_use]
    pub fn tile_origin(&self) -> Option<&str> {
        self.tile_url.as_deref().and_then(tile_origin).filter(|origin| !origin.is_empty())
    }
}

/// The origin of tiles; empty for a path of this server.
fn tile_origin(url: &str) -> Option<&str> {
    if url.starts_with('/') && !url.starts_with("//") { Some("") } else { url_origin(url) }
}

/// Scheme and host of a URL, which end up in a header.
fn url_origin(url: &str) -> Option<&str> {
    let host_at = url.find("://")? + 3;
    let host = url[host_at..].split('/').next()?;
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b".-:[]".contains(&byte);
    let is_usable =
        matches!(&url[..host_at], "http://" | "https://") && !host.is_empty() && host.bytes().all(is_plain);
    is_usable.then(|| &url[..host_at + host.len()])
}

impl Default for Config {
    fn default() -> Self {
        Self {
            data: PathBuf::from("data"),
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            metrics_listen: None,
            allowed_hosts: Vec::new(),
            cors_origins: Vec::new(),
            trusted_proxies: Vec::new(),
            insecure: false,
            admin_key: None,
            admin_key_file: None,
            tls: TlsSettings::default(),
            api_key: None,
            log_format: LogFormat::Text,
            log_filter: "info".to_owned(),
            trace_endpoint: None,
            training: Workers::default(),
            evaluation: Workers::default(),
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
            rejected_rows: 100,
            header_bytes: 32 << 10,
            header_s: 10,
            idle_s: 30,
            body_grace_s: 20,
            body_bytes_per_s: 500,
            control_frames_per_s: 10_000,
            request_s: 300,
            connections: 10_000,
            streams_per_connection: 256,
            requests: 1_024,
            reserved_requests: 256,
            requests_per_s: 0,
            client_share: 0.5,
            event_streams: 256,
            tracks_per_camera: 256,
            track_points: 240,
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
            boxes_without_fix_per_run: 20_000,
            live_evaluations: 64,
            evaluation_seeds: 20,
            rows_per_evaluation: 100_000,
            truth_line_positions: 1_000,
            cameras: 10_000,
            sites: 1_000,
            outside_connections: 256,
            connection_message_bytes: 1 << 20,
            connection_queue: 1_024,
            outbox_messages: 100_000,
            dead_letters: 1_000,
            site_queue: 16_384,
            site_frames: 1_024,
            boxes_per_frame: 256,
            site_wait_ms: 300,
            tracks_per_site: 1_024,
            site_events: 4_096,
            samples_per_camera: 10_000_000,
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

/// Values from the command line, which win over all others.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// `--data`
    pub data: Option<PathBuf>,
    /// `--listen`
    pub listen: Option<SocketAddr>,
    /// `--insecure`
    pub insecure: bool,
    /// `--admin-key-file`
    pub admin_key_file: Option<PathBuf>,
    /// `--tls-cert`
    pub tls_certificate: Option<PathBuf>,
    /// `--tls-key`
    pub tls_key: Option<PathBuf>,
    /// `--tls-client-ca`
    pub tls_client_ca: Option<PathBuf>,
}

impl Config {
    /// Reads file and environment over the defaults, and lays the flags on top.
    ///
    /// Without a path, `sightfix.toml` in the working folder is read if it is there. Nested settings
    /// are set by two underscores: `SIGHTFIX_LIMITS__BODY_BYTES=65536`.
    ///
    /// # Errors
    /// Names the file or variable with a value that cannot be used, and unknown settings.
    pub fn load(file: Option<&Path>, overrides: Overrides) -> anyhow::Result<Self> {
        let source = match file {
            Some(path) => config::File::from(path).required(true),
            None => config::File::new("sightfix.toml", config::FileFormat::Toml).required(false),
        };
        let environment = config::Environment::with_prefix("SIGHTFIX")
            .prefix_separator("_")
            .separator("__")
            .list_separator(",")
            .with_list_parse_key("allowed_hosts")
            .with_list_parse_key("cors_origins")
            .with_list_parse_key("trusted_proxies")
            .with_list_parse_key("tls.client_camera_ids")
            .try_parsing(true);
        let mut loaded: Self = config::Config::builder()
            .add_source(source)
            .add_source(environment)
            .build()
            .and_then(config::Config::try_deserialize)
            .context("cannot read the settings")?;
        if let Some(data) = overrides.data {
            loaded.data = data;
        }
        if let Some(listen) = overrides.listen {
            loaded.listen = listen;
        }
        for (setting, flag) in [
            (&mut loaded.admin_key_file, overrides.admin_key_file),
            (&mut loaded.tls.certificate, overrides.tls_certificate),
            (&mut loaded.tls.key, overrides.tls_key),
            (&mut loaded.tls.client_ca, overrides.tls_client_ca),
        ] {
            if flag.is_some() {
                *setting = flag;
            }
        }
        loaded.insecure |= overrides.insecure;
        loaded.check()?;
        Ok(loaded)
    }

    /// The secret of the administrator's key, from the setting itself or the file that it names.
    ///
    /// # Errors
    /// Names the file that cannot be read.
    pub fn admin_key(&self) -> anyhow::Result<Option<Secret>> {
        let Some(path) = &self.admin_key_file else { return Ok(self.admin_key.clone()) };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the admin key from {}", path.display()))?;
        Ok(Some(Secret(text.trim().to_owned())))
    }

    fn check(&self) -> anyhow::Result<()> {
        let limits = &self.limits;
        anyhow::ensure!(
            self.admin_key.is_none() || self.admin_key_file.is_none(),
            "give admin_key or admin_key_file, not both"
        );
        self.tls.certificate_and_key()?;
        self.tls.client_scope()?;
        for origin in &self.cors_origins {
            anyhow::ensure!(
                url_origin(origin) == Some(origin.as_str()),
                "cors_origins must be origins like https://maps.example.org, without a path; `{origin}` is none"
            );
        }
        anyhow::ensure!(limits.keys >= 1, "limits.keys must be at least 1");
        self.console.check()?;
        anyhow::ensure!(limits.pairings >= 1, "limits.pairings must be at least 1");
        anyhow::ensure!(
            limits.reserved_requests < limits.requests,
            "limits.reserved_requests must be below limits.requests"
        );
        anyhow::ensure!(
            limits.client_share > 0.0 && limits.client_share <= 1.0,
            "limits.client_share must be above 0 and at most 1"
        );
        for (name, seconds) in [
            ("header_s", limits.header_s),
            ("idle_s", limits.idle_s),
            ("body_grace_s", limits.body_grace_s),
            ("drain_s", limits.drain_s),
        ] {
            anyhow::ensure!(seconds >= 1, "limits.{name} must be at least 1");
        }
        anyhow::ensure!(limits.control_frames_per_s >= 1, "limits.control_frames_per_s must be at least 1");
        for (name, workers) in [("training", &self.training), ("evaluation", &self.evaluation)] {
            anyhow::ensure!(workers.workers >= 1, "{name}.workers must be at least 1");
            anyhow::ensure!(workers.lease_s >= 3, "{name}.lease_s must be at least 3");
        }
        for (name, limit) in [
            ("connection_message_bytes", limits.connection_message_bytes),
            ("connection_queue", limits.connection_queue),
            ("site_queue", limits.site_queue),
            ("site_frames", limits.site_frames),
            ("boxes_per_frame", limits.boxes_per_frame),
            ("tracks_per_site", limits.tracks_per_site),
            ("site_events", limits.site_events),
        ] {
            anyhow::ensure!(limit >= 1, "limits.{name} must be at least 1");
        }
        anyhow::ensure!(self.limits.page_items >= 1, "limits.page_items must be at least 1");
        // One active version and the one that a training run adds.
        anyhow::ensure!(self.limits.models_per_camera >= 2, "limits.models_per_camera must be at least 2");
        Ok(())
    }
}
