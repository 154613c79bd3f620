//! A task per connection.

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::credentials::PeerError;
use super::deliver::Delivery;
use super::intake::Intake;
use super::open;
use super::publish::Publisher;
use super::source::SourceIdentity;
use crate::app::{App, ConnectionState, LiveConnection, connection_settings};
use crate::backoff::Backoff;
use crate::domain::{Connection, ConnectionId, ConnectionKey, Result, Revision};
use crate::exchange::{Secrets, SinkSettings, SourceSettings};
use crate::shutdown::Shutdown;

/// How often connections are looked for that another process has changed.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// How often unsettled messages are looked at.
const SETTLE_EVERY: Duration = Duration::from_millis(20);
/// Connections read at a time.
const PAGE: u32 = 256;

/// A connection's task, by what it was started for.
struct RunningTask {
    key: ConnectionKey,
    revision: Revision,
    cancel: CancellationToken,
    handle: JoinHandle<()>,
}

/// Runs all connections that are not paused, until the server shuts down.
pub async fn run(app: App, shutdown: Shutdown) {
    let mut running: HashMap<ConnectionId, RunningTask> = HashMap::new();
    let tasks = TaskTracker::new();
    while !shutdown.is_draining() {
        match all_connections(&app).await {
            Ok(connections) => adjust(&app, &mut running, connections, &tasks),
            Err(error) => tracing::error!(%error, "cannot look for changed connections"),
        }
        tokio::select! {
            () = shutdown.draining() => {}
            () = app.connection_board.changed() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
    running.values().for_each(|task| task.cancel.cancel());
    tasks.close();
    tasks.wait().await;
}

async fn all_connections(app: &App) -> Result<Vec<Connection>> {
    let mut connections: Vec<Connection> = Vec::new();
    loop {
        let page = app.connections(connections.last().map(Connection::id), PAGE).await?;
        connections.extend(page.items);
        if page.next.is_none() {
            return Ok(connections);
        }
    }
}

/// Starts and ends tasks, so that they are those of the stored connections.
fn adjust(
    app: &App,
    running: &mut HashMap<ConnectionId, RunningTask>,
    connections: Vec<Connection>,
    tasks: &TaskTracker,
) {
    let wanted: HashMap<ConnectionId, Connection> = connections
        .into_iter()
        .filter(|connection| !connection.profile.paused)
        .map(|connection| (connection.id().clone(), connection))
        .collect();
    let is_wanted = |id: &ConnectionId, task: &RunningTask| {
        wanted.get(id).is_some_and(|it| (it.key, it.revision) == (task.key, task.revision))
    };
    let mut ending: HashMap<_, _> = running.extract_if(|id, task| !is_wanted(id, task)).collect();
    ending.values().for_each(|task| task.cancel.cancel());
    for (id, connection) in wanted {
        if running.contains_key(&id) {
            continue;
        }
        let (key, revision) = (connection.key, connection.revision);
        let cancel = CancellationToken::new();
        // A port or a session that the one before holds must be free.
        let before = ending.remove(&id).map(|task| task.handle);
        let handle = tasks.spawn(run_connection(app.clone(), connection, before, cancel.clone()));
        running.insert(id, RunningTask { key, revision, cancel, handle });
    }
}

async fn run_connection(
    app: App,
    connection: Connection,
    before: Option<JoinHandle<()>>,
    cancel: CancellationToken,
) {
    if let Some(before) = before {
        // A task that panicked has ended, too.
        let _ = before.await;
    }
    let live = app.live_connection(&connection);
    tokio::select! {
        () = cancel.cancelled() => {}
        () = keep_open(&app, &connection, &live) => {}
    }
    live.enter(ConnectionState::Paused, app.clock.now());
}

/// Runs a connection again and again, with growing pauses while it fails.
async fn keep_open(app: &App, connection: &Connection, live: &Arc<LiveConnection>) {
    let (settings, secrets) = match connection_settings(connection) {
        Ok(read) => read,
        Err(error) => {
            tracing::error!(connection = %connection.id(), %error, "the stored settings cannot be read");
            return std::future::pending().await;
        }
    };
    match (&settings.source, &settings.sink) {
        (Some(source), _) => {
            retried(app, connection, live, Work::Source { settings: source, secrets: &secrets }).await;
        }
        (None, Some(sink)) => run_sink(app, connection, sink, &secrets, live).await,
        (None, None) => std::future::pending().await,
    }
}

/// What a connection does again after each failure.
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
        let progressed = AtomicBool::new(false);
        let attempt = match &work {
            Work::Source { settings, secrets } => {
                run_source(app, connection, settings, secrets, live, &progressed).await
            }
            Work::Delivery(delivery) => delivery.run(&progressed).await,
        };
        let Err(error) = attempt;
        let has_progressed = progressed.into_inner();
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
        tokio::time::sleep(backoff.next_delay().unwrap_or(LOOK_EVERY)).await;
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
    progressed: &AtomicBool,
) -> Result<Infallible, PeerError> {
    let identity = SourceIdentity { client_id: client_id(connection), is_lasting: true };
    let mut source = open::source(app, connection, settings, secrets, &identity, live).await?;
    let mut intake = Intake::new(app.clone(), connection.id().clone(), live.clone(), settings)?;
    live.enter(ConnectionState::Running, app.clock.now());
    live.update(|status| status.connects += 1);
    loop {
        tokio::select! {
            message = source.next(), if intake.pending() < app.limits.connection_queue => {
                intake.take(message?).await?;
                progressed.store(true, Ordering::Relaxed);
            }
            () = tokio::time::sleep(SETTLE_EVERY), if intake.pending() > 0 => {}
        }
        let settled = intake.settled()?;
        if settled.is_empty() {
            continue;
        }
        let count = settled.len() as u64;
        source.settle(settled).await?;
        live.update(|status| status.acknowledged += count);
    }
}

async fn run_sink(
    app: &App,
    connection: &Connection,
    settings: &SinkSettings,
    secrets: &Secrets,
    live: &Arc<LiveConnection>,
) {
    let (key, queued) = (connection.key, Notify::new());
    let client_id = client_id(connection);
    let publisher = Publisher { app, key, settings, live, queued: &queued };
    let delivery = Delivery {
        app,
        id: connection.id(),
        key,
        settings,
        secrets,
        client_id: &client_id,
        live,
        queued: &queued,
    };
    tokio::select! {
        Err(error) = publisher.run() => {
            tracing::error!(connection = %connection.id(), %error, "positions cannot be queued");
        }
        () = retried(app, connection, live, Work::Delivery(delivery)) => {}
    }
}
