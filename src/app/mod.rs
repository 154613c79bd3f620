//! The use cases, without a transport: both REST and gRPC call these and nothing below them.
//!
//! Does not contain SQL, status codes or wire formats, and does not read the wall clock.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

pub mod access;
mod active_cameras;
mod audit;
mod camera_statuses;
mod cameras;
mod cluster;
mod connections;
mod demonstration;
mod evaluations;
mod fusion;
mod history;
mod idempotency;
mod inference;
mod keys;
mod learning;
mod live;
mod matching;
mod models;
mod paired_import;
mod pictures;
mod places;
mod recording;
mod registry;
mod retention;
mod samples;
mod sessions;
mod site_registry;
mod site_training;
mod sites;
mod spool;
mod swapped_columns;
mod training;

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use tokio::sync::{Notify, Semaphore};
use tokio_util::task::TaskTracker;

use self::access::{Access, Caller};
use crate::admission::Quotas;
use crate::clock::{Clock, Randomness};
use crate::config::{Config, Limits, Secret};
use crate::store::{Location, Store, StoreLimits};
use crate::telemetry::Metrics;

pub use audit::AuditLog;
pub use camera_statuses::{CameraStatus, CameraStatuses};
pub use cameras::Cameras;
pub use cluster::{
    CameraLease, Cluster, ConnectionLease, DatabaseHistory, NodeSettings, NodeStatus, Nodes, Watch,
};
pub use connections::{
    ConnectionBoard, ConnectionNode, ConnectionRequest, ConnectionState, ConnectionStatus, Connections,
    CountedReason, LastMessage, LiveConnection, Outboxes, PushedMessage, ReportedStatuses, connection_groups,
    connection_settings,
};
pub use demonstration::{Demonstration, DemonstrationParts};
pub use evaluations::{DEFAULT_TEST_SHARE, EvaluationRequest, Evaluations};
pub use fusion::Fusion;
pub use history::{ArchivedHistory, HeatCell, HeatMap, History, HistoryRows, HistorySelection};
pub use inference::{BOX_COLUMNS, BOXES, Inference, Inferred, OutputTensor};
pub use keys::Keys;
pub use learning::{Learning, LearningState, Recordings};
pub use live::{
    Acknowledgement, CameraActivity, CameraEvent, CameraEvents, ChangeNotices, EventId, ItemResult, Live,
    LiveStream, LossReason, LostEvents, LostSiteEvents, NotStored, NotStoredReason, Retraining, SinkFeed,
    SinkFeeds, SinkPosition, SiteClocks, SiteEvent, SiteEventKind, SiteEvents, SiteTracks, StoredSiteEvent,
    TargetUpdate, TrackPoint, UnplacedBox, WantedEvents, WantedPositions, WorldSighting, WorldTrackPoint,
    WorldTracks,
};
pub use matching::{
    Associations, GroupMember, MatchReport, MatchRequest, MatchedPair, MatchedRecording, SharedReceiver,
};
pub use models::{GnssErrorEstimate, Models};
pub use paired_import::{PairedImport, PairedReport};
pub use pictures::Pictures;
pub use places::{
    PlaceEvents, PlaceMonitor, PlaceStatistics, Places, StatisticsInterval, StatisticsRequest,
    StatisticsStep, StoredEvent, event_kind, place_settings,
};
pub use recording::{PairingCounts, Part, Recording, RecordingLimits, RejectedParts, of_part};
pub use registry::{ActiveCamera, ModelFault, ModelSummary, Registry};
pub use retention::{ClockDoubt, Retention, retention_doubt};
pub use samples::{ImportOptions, ImportReport, RejectedRow, Samples};
pub use sessions::Sessions;
pub use site_registry::{ActiveSite, SiteRegistry};
pub use site_training::SiteRunRequest;
pub use sites::Sites;
pub use spool::{Content, Spool, SpoolLeases, Spooled};
pub use training::{RunRequest, Trainable, Training, TrainingQueues};

/// The application: everything a request needs, on behalf of its caller. Cheap to clone.
#[derive(Clone)]
pub struct App {
    parts: Arc<Parts>,
    /// Everything that lasts; changes are recorded as those of the caller.
    pub store: Store,
    caller: Caller,
}

/// The parts from which an [`App`] is made.
pub struct Parts {
    opened_store: Store,
    /// Profiles and active models, ready to answer.
    pub registry: Arc<Registry>,
    /// Sites, ready to track.
    pub site_registry: SiteRegistry,
    /// The status of connections with other systems.
    pub connection_board: ConnectionBoard,
    /// Positions that wait for the outboxes of their sinks.
    pub sink_feeds: SinkFeeds,
    /// The way of finished tracks to the archive.
    pub archived_history: ArchivedHistory,
    /// Where their sinks write files, if they may: set by the server at its start.
    pub export_folder: OnceLock<PathBuf>,
    /// Serial devices that their sources may read: set by the server at its start.
    pub serial_devices: OnceLock<Vec<PathBuf>>,
    /// Keys and sessions, ready to answer.
    pub access: Access,
    pub clock: Clock,
    /// Ids and seeds.
    pub randomness: Randomness,
    /// The limits of everything that an outside client can make large.
    pub limits: Limits,
    /// How much of each bounded resource clients may hold at a time.
    pub quotas: Arc<Quotas>,
    /// Counters and times.
    pub metrics: Metrics,
    /// Places for recordings that are paired in memory.
    pub pairings: Arc<Semaphore>,
    /// Notifies workers of queued training runs.
    pub training_queues: TrainingQueues,
    /// Notifies workers of queued evaluations.
    pub evaluation_queue: JobQueue,
    /// When the snapshot addresses of cameras were asked last.
    snapshot_times: pictures::SnapshotTimes,
    /// The demonstration, if one is shown.
    pub demonstration: Demonstration,
    /// Which nodes there are, and what this one owns.
    cluster: Cluster,
    /// Open live streams.
    stream_slots: live::StreamSlots,
    /// Rounds of live matching.
    matching_slot: live::MatchingSlot,
    /// Places, and the tracks there.
    place_monitor: Arc<PlaceMonitor>,
    /// The way to the drift detectors.
    residuals: live::ResidualQueue,
    /// When moved cameras are trained again.
    retrain_schedule: live::RetrainSchedule,
    /// Tasks that answers hand work to; [`App::close`] waits for them.
    tasks: TaskTracker,
}

/// Time that handed-over work gets when the application is closed.
const CLOSE_TIME: Duration = Duration::from_secs(2);

impl App {
    /// An application over an opened store. Cameras are loaded when they are asked for, or all by [`Registry::refresh`].
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn new(
        store: Store,
        clock: Clock,
        randomness: Randomness,
        limits: Limits,
        metrics: Metrics,
    ) -> crate::domain::Result<Self> {
        let mut run_id = [0; 8];
        randomness.fill(&mut run_id);
        let registry = Arc::new(Registry::of_run(u64::from_le_bytes(run_id)));
        let site_registry = SiteRegistry::new(randomness.clone(), limits.site_events);
        let access = Access::default();
        access.refresh(&store, &clock).await?;
        let pairings = Arc::new(Semaphore::new(limits.pairings));
        let (residuals, waiting) = live::residual_queue();
        let (archived_history, finished_tracks) = ArchivedHistory::new(&limits, metrics.clone());
        let max_tracks = limits.tracks_per_camera.max(limits.tracks_per_site);
        let (place_monitor, measured) = PlaceMonitor::new(limits.place_queue, max_tracks, metrics.clone());
        let quotas = Arc::new(Quotas::new(&limits));
        let parts = Parts {
            opened_store: store,
            registry,
            site_registry,
            connection_board: ConnectionBoard::default(),
            sink_feeds: SinkFeeds::new(randomness.uuid_v7(clock.now())),
            archived_history,
            export_folder: OnceLock::new(),
            serial_devices: OnceLock::new(),
            access,
            clock,
            randomness,
            limits,
            quotas,
            metrics,
            pairings,
            training_queues: TrainingQueues::default(),
            evaluation_queue: JobQueue::default(),
            snapshot_times: pictures::SnapshotTimes::default(),
            demonstration: Demonstration::default(),
            cluster: Cluster::default(),
            stream_slots: live::StreamSlots::default(),
            matching_slot: live::MatchingSlot::default(),
            place_monitor,
            residuals,
            retrain_schedule: live::RetrainSchedule::default(),
            tasks: TaskTracker::new(),
        };
        let app = Self::of_program(Arc::new(parts), "sightfix");
        app.tasks.spawn(waiting.run(Arc::downgrade(&app.parts)));
        app.tasks.spawn(measured.run(Arc::downgrade(&app.parts)));
        tokio::spawn(history::write_finished_tracks(finished_tracks, Arc::downgrade(&app.parts)));
        Ok(app)
    }

    /// The application as a part of the program uses it by itself.
    fn of_program(parts: Arc<Parts>, name: &str) -> Self {
        let caller = Caller::program(name);
        Self { store: parts.opened_store.on_behalf_of(caller.actor().clone()), parts, caller }
    }

    /// The same application on behalf of a caller.
    #[must_use]
    pub fn on_behalf_of(&self, caller: Caller) -> Self {
        let store = self.store.on_behalf_of(caller.actor().clone());
        Self { parts: self.parts.clone(), store, caller }
    }

    /// On whose behalf it works.
    #[must_use]
    pub const fn caller(&self) -> &Caller {
        &self.caller
    }

    /// Waits for the work that answers have handed over, then closes the store. Streams must have ended.
    pub async fn close(&self) {
        if let Err(error) = self.access.store_last_uses(&self.store).await {
            tracing::warn!(%error, "when keys were used last could not be stored");
        }
        self.residuals.close();
        self.site_registry.close();
        self.place_monitor.close();
        self.tasks.close();
        if tokio::time::timeout(CLOSE_TIME, self.tasks.wait()).await.is_err() {
            tracing::warn!("samples or residuals of live streams were still under way at the end");
        }
        self.history().finish().await;
        self.outboxes().close_logs().await;
        self.store.close().await;
    }
}

/// Wakes a worker when a job was queued, so that it need not wait until it polls the store.
#[derive(Default)]
pub struct JobQueue(Notify);

impl JobQueue {
    /// Tells that a job was queued.
    pub fn notify(&self) {
        self.0.notify_one();
    }

    /// Waits until a job was queued; one notification is kept until somebody waits.
    pub async fn queued(&self) {
        self.0.notified().await;
    }
}

impl std::ops::Deref for App {
    type Target = Parts;

    fn deref(&self) -> &Parts {
        &self.parts
    }
}

/// The part of the limits that the store enforces.
#[must_use]
pub const fn store_limits(limits: &Limits) -> StoreLimits {
    StoreLimits {
        cameras: limits.cameras,
        sites: limits.sites,
        places: limits.places,
        place_events: limits.place_events,
        place_minute_days: limits.place_minute_days,
        place_hour_days: limits.place_hour_days,
        outside_connections: limits.outside_connections,
        outbox_messages: limits.outbox_messages,
        dead_letters: limits.dead_letters,
        samples_per_camera: limits.samples_per_camera,
        sample_overflow: limits.sample_overflow,
        samples: limits.samples,
        models_per_camera: limits.models_per_camera,
        ended_runs_per_camera: limits.ended_runs_per_camera,
        ended_evaluations: limits.ended_evaluations,
        keys: limits.keys,
        audit_entries: limits.audit_entries,
        idempotency_keys: limits.idempotency_keys,
        idempotency_key_s: limits.idempotency_key_s,
        database_bytes: match limits.database_bytes {
            0 => None,
            bytes => Some(bytes),
        },
        reserve_bytes: limits.reserve_bytes,
    }
}

/// Where the settings say that the store is: in a database if they name one, else in the data folder.
///
/// # Errors
/// The setting `database` is no URL of a PostgreSQL database.
pub fn store_location(config: &Config) -> crate::domain::Result<Location> {
    Location::new(&config.data, config.database.as_ref().map(Secret::reveal))
}

/// One page of a list, and the cursor after which the next begins.
#[derive(Debug, Clone)]
pub struct Page<T, C> {
    /// The items, in the list's order.
    pub items: Vec<T>,
    /// Where the next page begins; `None` on the last.
    pub next: Option<C>,
}

/// Cuts a page from one item more than it holds.
fn page_of<T, C>(mut items: Vec<T>, limit: u32, cursor: impl Fn(&T) -> C) -> Page<T, C> {
    let limit = limit as usize;
    let more = items.len() > limit;
    items.truncate(limit);
    let next = if more { items.last().map(cursor) } else { None };
    Page { items, next }
}
