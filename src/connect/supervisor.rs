//! Tasks of connections.
//!
//! A source has one task, on the node that owns it. A sink has two: its publisher runs on every node, for each publishes the
//! tracks of the cameras that it owns, and its delivery on the node that owns the sink, so that nobody gets a message
//! twice.

use std::collections::{HashMap, HashSet};
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::credentials::PeerError;
use super::deliver::{Attempt, Delivery};
use super::intake::Intake;
use super::kinds;
use super::publish::Publisher;
use super::source::SourceIdentity;
use crate::app::{
    App, ConnectionLease, ConnectionState, LiveConnection, ReportedStatuses, WantedEvents, WantedPositions,
    connection_groups, connection_settings,
};
use crate::backoff::Backoff;
use crate::domain::{CameraId, Connection, ConnectionId, ConnectionKey, Result, Revision, TrackScope};
use crate::exchange::kinds::SinkContent;
use crate::exchange::{ConnectionSettings, Secrets, SourceSettings};
use crate::shutdown::Shutdown;

/// How often connections are looked for that another process has changed, or has ceased to run.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How often unsettled messages are looked at.
const SETTLE_EVERY: Duration = Duration::from_millis(20);
/// Least time between two positions of a target where a sink does not say, s.
const DEFAULT_INTERVAL_S: f64 = 1.0;
/// Connections read at a time.
const PAGE: u32 = 256;

/// The part of a connection that a task runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Part {
    /// Reads the source.
    Intake,
    /// Fills the outbox.
    Publisher,
    /// Empties the outbox.
    Delivery,
}

/// The version of the settings with which a task was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct TaskVersion {
    key: ConnectionKey,
    revision: Revision,
    fence: i64,
}

struct RunningTask {
    version: TaskVersion,
    cancel: CancellationToken,
    handle: JoinHandle<()>,
}

/// A connection that is not paused, with its settings.
struct ActiveConnection {
    connection: Connection,
    settings: ConnectionSettings,
    secrets: Secrets,
}

/// A task that should be running, and the right to what it does.
struct WantedTask {
    active: Arc<ActiveConnection>,
    part: Part,
    lease: ConnectionLease,
}

/// Runs the parts of all connections that a node has to run.
pub struct Supervisor {
    app: App,
    running: HashMap<(ConnectionId, Part), RunningTask>,
    /// Those that end when the server begins to shut down.
    tasks: TaskTracker,
    /// The connections as they were when the sinks among them were last told apart by cameras.
    fed: Vec<(ConnectionKey, Revision)>,
    /// Connections whose settings could not be read, which is logged once.
    unreadable: HashSet<(ConnectionKey, Revision)>,
    reported: ReportedStatuses,
}

impl Supervisor {
    /// Starts the connections; no position of a camera that is measured afterwards is missing in its sinks.
    pub async fn start(app: App) -> Self {
        let mut supervisor = Self {
            app,
            running: HashMap::new(),
            tasks: TaskTracker::new(),
            fed: Vec::new(),
            unreadable: HashSet::new(),
            reported: ReportedStatuses::default(),
        };
        supervisor.try_look().await;
        supervisor
    }

    /// Goes on until the server shuts down. Publishers go on after it, for as long as positions are made.
    pub async fn run(mut self, shutdown: Shutdown) {
        while !shutdown.is_draining() {
            tokio::select! {
                () = shutdown.draining() => break,
                () = self.app.connection_board.changed() => {}
                () = tokio::time::sleep(LOOK_EVERY) => {}
            }
            self.try_look().await;
        }
        let ends_now = |((_, part), _): &(&(ConnectionId, Part), &RunningTask)| *part != Part::Publisher;
        self.running.iter().filter(ends_now).for_each(|(_, task)| task.cancel.cancel());
        self.tasks.close();
        self.tasks.wait().await;
    }

    async fn try_look(&mut self) {
        if let Err(error) = self.look().await {
            tracing::error!(%error, "cannot look for changed connections");
        }
    }

    /// Starts and ends tasks, so that they are those of the stored connections, and tells other nodes what they do.
    async fn look(&mut self) -> Result<()> {
        let connections = all_connections(&self.app).await?;
        let all: Vec<_> =
            connections.iter().map(|connection| (connection.key, connection.revision)).collect();
        let active: Vec<_> = connections
            .iter()
            .filter(|connection| !connection.profile.paused)
            .filter_map(|connection| self.read(connection.clone()).map(Arc::new))
            .collect();
        // Before anything is written, which a full disk refuses: from here on no position is missed.
        self.feed(all, &active);
        self.count_lost(&connections).await?;
        let site_of = |camera: &CameraId| self.app.registry.get(camera).and_then(|known| known.site.clone());
        let keyed = active.iter().map(|active| (active.connection.key, &active.settings));
        let groups = connection_groups(keyed, site_of);
        let leases = self.app.nodes().own_connections(&groups).await?;
        self.adjust(active.into_iter().flat_map(|active| wanted_tasks(active, &leases)).collect());
        self.app.connections().report(&mut self.reported).await
    }

    /// Counts what processes may have lost that ended before their positions were in the outboxes.
    async fn count_lost(&self, connections: &[Connection]) -> Result<()> {
        for key in self.app.outboxes().lost_logs().await? {
            let Some(connection) = connections.iter().find(|connection| connection.key == key) else {
                continue;
            };
            let message = "a server ended before its last positions were queued; some may be missing";
            tracing::warn!(connection = %connection.id(), message);
            let error = Some((self.app.clock.now(), message.to_owned()));
            self.app.connections().live(connection).update(|status| {
                // The number of positions is not known.
                status.dropped += 1;
                status.last_error = error;
            });
        }
        Ok(())
    }

    /// Lets the sinks get the positions of their cameras, after anything has changed.
    fn feed(&mut self, all: Vec<(ConnectionKey, Revision)>, active: &[Arc<ActiveConnection>]) {
        if self.fed == all {
            return;
        }
        let sinks = || {
            active.iter().filter_map(|active| Some((active.connection.key, active.settings.sink.as_ref()?)))
        };
        let wanted = sinks().filter(|(_, sink)| sink.content == SinkContent::Positions);
        let wanted = wanted.filter_map(|(key, sink)| {
            let min_interval_s = sink.min_interval_s.unwrap_or(DEFAULT_INTERVAL_S);
            Some(WantedPositions { key, cameras: sink.cameras().ok()?, min_interval_s })
        });
        let wanted: Vec<_> = wanted.collect();
        let of_events = sinks().filter(|(_, sink)| sink.content == SinkContent::PlaceEvents);
        let of_events = of_events.filter_map(|(key, sink)| {
            let cameras = sink.cameras().ok()?.into_iter().map(TrackScope::Camera);
            let scopes = cameras.chain(sink.sites().ok()?.into_iter().map(TrackScope::Site)).collect();
            Some(WantedEvents { key, scopes, topic: sink.topic().ok()? })
        });
        let of_events = of_events.collect();
        self.app.sink_feeds.feed(&all.iter().map(|(key, _)| *key).collect(), &wanted, of_events);
        self.fed = all;
    }

    fn read(&mut self, connection: Connection) -> Option<ActiveConnection> {
        match connection_settings(&connection) {
            Ok((settings, secrets)) => Some(ActiveConnection { connection, settings, secrets }),
            Err(error) => {
                if self.unreadable.insert((connection.key, connection.revision)) {
                    tracing::error!(connection = %connection.id(), %error, "the stored settings cannot be read");
                }
                None
            }
        }
    }

    fn adjust(&mut self, wanted: Vec<WantedTask>) {
        let versions: HashMap<_, _> = wanted.iter().map(|task| (task.id(), task.version())).collect();
        let is_wanted = |id: &(ConnectionId, Part), task: &RunningTask| {
            versions.get(id) == Some(&task.version) && !task.handle.is_finished()
        };
        let mut ending: HashMap<_, _> = self.running.extract_if(|id, task| !is_wanted(id, task)).collect();
        ending.values().for_each(|task| task.cancel.cancel());
        for task in wanted {
            let id = task.id();
            if self.running.contains_key(&id) {
                continue;
            }
            let (version, cancel) = (task.version(), CancellationToken::new());
            // A port or a session that the one before holds must be free.
            let before = ending.remove(&id).map(|task| task.handle);
            let running = run_task(self.app.clone(), task, before, cancel.clone());
            let handle = match id.1 {
                Part::Publisher => tokio::spawn(running),
                Part::Intake | Part::Delivery => self.tasks.spawn(running),
            };
            self.running.insert(id, RunningTask { version, cancel, handle });
        }
    }
}

impl WantedTask {
    fn id(&self) -> (ConnectionId, Part) {
        (self.active.connection.id().clone(), self.part)
    }

    fn version(&self) -> TaskVersion {
        let Connection { key, revision, .. } = self.active.connection;
        TaskVersion { key, revision, fence: self.lease.fence() }
    }
}

async fn all_connections(app: &App) -> Result<Vec<Connection>> {
    let mut connections: Vec<Connection> = Vec::new();
    loop {
        let page = app.connections().list(connections.last().map(Connection::id), PAGE).await?;
        connections.extend(page.items);
        if page.next.is_none() {
            return Ok(connections);
        }
    }
}

/// The tasks of a connection on a node with these leases.
fn wanted_tasks(
    active: Arc<ActiveConnection>,
    leases: &HashMap<ConnectionKey, ConnectionLease>,
) -> Vec<WantedTask> {
    let owned = if active.settings.source.is_some() { Part::Intake } else { Part::Delivery };
    let lease = leases.get(&active.connection.key).cloned();
    let publisher = (owned == Part::Delivery).then_some((Part::Publisher, ConnectionLease::of_every_node()));
    let parts = lease.map(|lease| (owned, lease)).into_iter().chain(publisher);
    parts.map(|(part, lease)| WantedTask { active: active.clone(), part, lease }).collect()
}

async fn run_task(app: App, task: WantedTask, before: Option<JoinHandle<()>>, cancel: CancellationToken) {
    if let Some(before) = before {
        // A task that panicked has ended, too.
        let _ = before.await;
    }
    let live = app.connections().live(&task.active.connection);
    tokio::select! {
        () = cancel.cancelled() => {}
        () = task.lease.ended(&app.clock) => {}
        () = run_part(&app, &task, &live) => {}
    }
    if task.part != Part::Publisher {
        live.enter(ConnectionState::Paused, app.clock.now());
    }
}

async fn run_part(app: &App, task: &WantedTask, live: &Arc<LiveConnection>) {
    let ActiveConnection { connection, settings, secrets } = &*task.active;
    match (task.part, &settings.source, &settings.sink) {
        (Part::Intake, Some(settings), _) => {
            retried(app, connection, live, Work::Source { settings, secrets }).await;
        }
        (Part::Publisher, _, Some(settings)) => {
            // What is wrong with settings is shown by the delivery.
            let Ok(topic) = settings.topic() else { return };
            Publisher { app, key: connection.key, settings, topic, live }.run().await;
        }
        (Part::Delivery, _, Some(settings)) => {
            let client_id = client_id(connection);
            let delivery = Delivery {
                app,
                id: connection.id(),
                key: connection.key,
                settings,
                secrets,
                client_id: &client_id,
                live,
                lease: &task.lease,
            };
            retried(app, connection, live, Work::Delivery(delivery)).await;
        }
        _ => std::future::pending().await,
    }
}

/// The work that a connection repeats after each failure.
enum Work<'a> {
    Source { settings: &'a SourceSettings, secrets: &'a Secrets },
    Delivery(Delivery<'a>),
}

/// Makes attempts for ever. The pause is short again after an attempt that made progress.
async fn retried(app: &App, connection: &Connection, live: &Arc<LiveConnection>, work: Work<'_>) {
    let mut seed = [0; 32];
    app.randomness.fill(&mut seed);
    let mut backoff = Backoff::new(u32::MAX, ChaCha8Rng::from_seed(seed));
    let mut was_failing = false;
    loop {
        live.enter(ConnectionState::Connecting, app.clock.now());
        let attempt = Attempt::default();
        let ended = match &work {
            Work::Source { settings, secrets } => {
                run_source(app, connection, settings, secrets, live, &attempt).await
            }
            Work::Delivery(delivery) => delivery.run(&attempt).await,
        };
        let Err(error) = ended;
        let has_progressed = attempt.progressed.into_inner();
        if has_progressed {
            backoff.reset();
        }
        // Once per outage, and the status has the rest.
        if !was_failing || has_progressed {
            tracing::warn!(connection = %connection.id(), %error, "a connection failed; it is tried again");
        }
        was_failing = true;
        let now = app.clock.now();
        live.update(|status| status.last_error = Some((now, error.to_string())));
        live.enter(ConnectionState::Waiting, now);
        let asked = attempt.retry_after.into_inner().unwrap_or_default();
        tokio::time::sleep(backoff.next_delay().unwrap_or(LOOK_EVERY).max(asked)).await;
    }
}

/// The name of a connection to its peers, which no other connection has.
fn client_id(connection: &Connection) -> String {
    format!("sightfix-{}-{:x}", connection.id(), connection.created_at.as_microsecond())
}

async fn run_source(
    app: &App,
    connection: &Connection,
    settings: &SourceSettings,
    secrets: &Secrets,
    live: &Arc<LiveConnection>,
    attempt: &Attempt,
) -> Result<Infallible, PeerError> {
    let identity = SourceIdentity { client_id: client_id(connection), is_lasting: true };
    let mut source = kinds::source(app, connection, settings, secrets, &identity, live).await?;
    let mut intake = Intake::new(app.clone(), connection.id().clone(), live.clone(), settings)?;
    live.enter(ConnectionState::Running, app.clock.now());
    live.update(|status| status.connects += 1);
    loop {
        tokio::select! {
            message = source.next(), if intake.pending() < app.limits.connection_unsettled => {
                intake.take(message?).await?;
                attempt.progressed.store(true, Ordering::Relaxed);
            }
            () = tokio::time::sleep(SETTLE_EVERY), if intake.pending() > 0 => {}
        }
        let settled = intake.settled()?;
        let unsettled = intake.pending() as u64;
        live.update(|status| status.unsettled = unsettled);
        if settled.is_empty() {
            continue;
        }
        let count = settled.len() as u64;
        source.settle(settled).await?;
        live.update(|status| status.acknowledged += count);
    }
}
