//! Positions on their way to the outboxes of sinks.
//!
//! The feed of a sink is a log of the positions of its cameras, from the moment they are made until they are in its outbox,
//! however long the database does not answer. Cameras are known by their ids: one that is created later, or comes back from
//! another node, misses nothing. A track does not wait for a sink, and memory has a limit.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use arc_swap::ArcSwap;
use jiff::Timestamp;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::sync::lock;
use super::tracks::TrackPoint;
use crate::domain::{CameraId, ConnectionKey, Observation, OutboxMessage, TargetId, TrackScope};
use crate::exchange::kinds::Topic;
use crate::places::event::PlaceEvent;

/// Positions that wait for the outbox of a sink; beyond, the oldest are lost, and counted.
const MOST_WAITING: usize = 10_000;
/// Targets of a sink whose last position is remembered; beyond, those that are silent are forgotten.
const MOST_TARGETS: usize = 4_096;
/// Silence after which they are.
const SILENT_S: f64 = 60.0;
/// How long a server that ends waits for the outboxes, beyond `limits.drain_s`, and how often it looks.
const END_TIME: Duration = Duration::from_secs(1);
const END_PAUSE: Duration = Duration::from_millis(5);

/// A position that a sink is to have.
pub struct SinkPosition {
    /// Its place in the log, from 1.
    pub number: u64,
    /// The camera that tracks the target.
    pub camera: CameraId,
    /// The observation from which the position was computed.
    pub observation: Observation,
    /// The track with it.
    pub point: Arc<TrackPoint>,
}

/// The positions that a sink requests.
#[derive(Debug, Clone)]
pub struct WantedPositions {
    pub key: ConnectionKey,
    /// Only positions of these cameras.
    pub cameras: Vec<CameraId>,
    /// The least time between two positions of a target, s.
    pub min_interval_s: f64,
}

/// The events of places that a sink requests.
#[derive(Debug, Clone)]
pub struct WantedEvents {
    pub key: ConnectionKey,
    /// Only events of places of these cameras and sites.
    pub scopes: HashSet<TrackScope>,
    pub topic: Topic,
}

/// The log of positions of one sink.
pub struct SinkFeed {
    waiting: Mutex<Waiting>,
    added: Notify,
}

#[derive(Default)]
struct Waiting {
    positions: VecDeque<Arc<SinkPosition>>,
    /// Number of the latest position; 0 before the first.
    latest: u64,
    lost: u64,
    min_interval_s: f64,
    last_sent_s: HashMap<CameraId, HashMap<TargetId, f64>>,
}

impl SinkFeed {
    fn new() -> Arc<Self> {
        Arc::new(Self { waiting: Mutex::default(), added: Notify::new() })
    }

    fn push(&self, camera: &CameraId, observation: &Observation, point: &Arc<TrackPoint>) {
        let mut waiting = lock(&self.waiting);
        if !waiting.is_due(camera, point) {
            return;
        }
        if waiting.positions.len() >= MOST_WAITING {
            waiting.positions.pop_front();
            waiting.lost += 1;
        }
        waiting.latest += 1;
        let (number, camera) = (waiting.latest, camera.clone());
        let position =
            SinkPosition { number, camera, observation: observation.clone(), point: point.clone() };
        waiting.positions.push_back(Arc::new(position));
        drop(waiting);
        self.added.notify_one();
    }

    /// Waits until positions wait; how many.
    pub async fn waiting(&self) -> usize {
        loop {
            match lock(&self.waiting).positions.len() {
                0 => {}
                count => return count,
            }
            self.added.notified().await;
        }
    }

    /// The oldest positions that wait; they stay until they are settled.
    #[must_use]
    pub fn oldest(&self, most: usize) -> Vec<Arc<SinkPosition>> {
        lock(&self.waiting).positions.iter().take(most).cloned().collect()
    }

    /// Forgets the positions up to a number, which are in the outbox.
    pub fn settle(&self, number: u64) {
        let positions = &mut lock(&self.waiting).positions;
        let settled = positions.partition_point(|position| position.number <= number);
        positions.drain(..settled);
    }

    /// Number of positions lost since the last call, for the outbox took none for too long.
    #[must_use]
    pub fn take_lost(&self) -> u64 {
        std::mem::take(&mut lock(&self.waiting).lost)
    }

    fn is_settled(&self) -> bool {
        lock(&self.waiting).positions.is_empty()
    }
}

impl Waiting {
    /// True if a target's last position was taken long enough ago.
    fn is_due(&mut self, camera: &CameraId, point: &TrackPoint) -> bool {
        let (interval_s, time_s) = (self.min_interval_s, point.state.time.as_microsecond() as f64 * 1e-6);
        if !self.last_sent_s.contains_key(camera) {
            self.last_sent_s.insert(camera.clone(), HashMap::new());
        }
        let Some(targets) = self.last_sent_s.get_mut(camera) else { return true };
        match targets.get_mut(&point.target_id) {
            // A time that steps back is another run of the same target.
            Some(sent_s) if (0.0..interval_s).contains(&(time_s - *sent_s)) => return false,
            Some(sent_s) => *sent_s = time_s,
            None => {
                if targets.len() >= MOST_TARGETS {
                    targets.retain(|_, sent_s| time_s - *sent_s < SILENT_S.max(interval_s));
                }
                targets.insert(point.target_id.clone(), time_s);
            }
        }
        true
    }
}

/// The logs of all sinks.
pub struct SinkFeeds {
    log: Uuid,
    feeds: ArcSwap<Feeds>,
    closed: CancellationToken,
}

#[derive(Default)]
struct Feeds {
    by_sink: HashMap<ConnectionKey, Arc<SinkFeed>>,
    by_camera: HashMap<CameraId, Vec<Arc<SinkFeed>>>,
    of_events: Vec<WantedEvents>,
}

impl SinkFeeds {
    /// `log` names the logs of this run of the server.
    pub(in crate::app) fn new(log: Uuid) -> Self {
        Self { log, feeds: ArcSwap::default(), closed: CancellationToken::new() }
    }

    /// Names the logs of this run of the server.
    #[must_use]
    pub const fn log(&self) -> Uuid {
        self.log
    }

    /// From now on these sinks get positions, and those get events. What waits for others stays, as long as they are among
    /// `sinks`.
    pub fn feed(
        &self,
        sinks: &HashSet<ConnectionKey>,
        wanted: &[WantedPositions],
        of_events: Vec<WantedEvents>,
    ) {
        let by_sink = self.feeds.load().by_sink.clone();
        let mut feeds = Feeds { by_sink, of_events, ..Feeds::default() };
        feeds.by_sink.retain(|key, _| sinks.contains(key));
        for WantedPositions { key, cameras, min_interval_s } in wanted {
            let feed = feeds.by_sink.entry(*key).or_insert_with(SinkFeed::new);
            lock(&feed.waiting).min_interval_s = *min_interval_s;
            for camera in cameras {
                feeds.by_camera.entry(camera.clone()).or_default().push(feed.clone());
            }
        }
        self.feeds.store(Arc::new(feeds));
    }

    /// The log of a sink, once it has one.
    #[must_use]
    pub fn of(&self, sink: ConnectionKey) -> Option<Arc<SinkFeed>> {
        self.feeds.load().by_sink.get(&sink).cloned()
    }

    /// A target was measured.
    pub(super) fn push(&self, camera: &CameraId, observation: &Observation, point: &Arc<TrackPoint>) {
        for feed in self.feeds.load().by_camera.get(camera).into_iter().flatten() {
            feed.push(camera, observation, point);
        }
    }

    /// The messages that sinks are to have of an event.
    pub(in crate::app) fn messages_of_event(
        &self,
        scope: &TrackScope,
        event: &PlaceEvent,
        content: &str,
        now: Timestamp,
    ) -> Vec<(ConnectionKey, OutboxMessage)> {
        let feeds = self.feeds.load();
        let sinks = feeds.of_events.iter().filter(|sink| sink.scopes.contains(scope));
        let message = |sink: &WantedEvents| OutboxMessage {
            number: 0,
            message_id: event.id.clone(),
            subject: sink.topic.of_event(&event.place_id, event.kind.as_str()),
            payload: content.as_bytes().to_vec(),
            created_at: now,
        };
        sinks.map(|sink| (sink.key, message(sink))).collect()
    }

    /// Waits until nothing is to come any more.
    pub async fn closed(&self) {
        self.closed.cancelled().await;
    }

    /// Waits until all positions are in their outboxes, for a second at most; the sinks of which that is so.
    pub(in crate::app) async fn close(&self) -> Vec<ConnectionKey> {
        let feeds = self.feeds.load_full();
        let drained = async {
            while feeds.by_sink.values().any(|feed| !feed.is_settled()) {
                tokio::time::sleep(END_PAUSE).await;
            }
        };
        // Elapsed is no failure: the others stay noted as lost.
        let _ = tokio::time::timeout(END_TIME, drained).await;
        self.closed.cancel();
        feeds.by_sink.iter().filter(|(_, feed)| feed.is_settled()).map(|(key, _)| *key).collect()
    }
}
