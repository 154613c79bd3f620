//! The present status of connections: state, counts, the last message. In memory, since the server was started.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;
use tokio::sync::{Notify, SetOnce, mpsc, oneshot, watch};

use crate::app::live::sync::lock;
use crate::domain::{ConnectionId, ConnectionKey};

/// Bytes of a message that are shown.
const SHOWN_BYTES: usize = 4_096;

/// State of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, IntoStaticStr, Serialize, Deserialize)]
#[strum(serialize_all = "snake_case")]
#[serde(rename_all = "snake_case")]
pub enum ConnectionState {
    /// At rest, as the operator wants it.
    #[default]
    Paused,
    /// Tries to reach its peer.
    Connecting,
    /// Takes or gives messages.
    Running,
    /// Failed; tries again after a pause.
    Waiting,
}

/// A message as it came or went, with what was read from it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastMessage {
    /// The time of the message.
    pub time: Timestamp,
    /// Its topic, or the address of its sender.
    pub subject: String,
    /// The beginning of the payload, as text.
    pub text: String,
    /// Its items, what was skipped, or why it cannot be read.
    pub reading: Vec<String>,
}

impl LastMessage {
    /// Makes the last message of a payload and keeps its first 4 KiB.
    #[must_use]
    pub fn new(time: Timestamp, subject: String, payload: &[u8], reading: Vec<String>) -> Self {
        let shown = &payload[..payload.len().min(SHOWN_BYTES)];
        Self { time, subject, text: String::from_utf8_lossy(shown).into_owned(), reading }
    }
}

/// Why messages, or parts of them, were not taken.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CountedReason {
    /// The reason, of the latest of them.
    pub reason: String,
    /// Number of messages or parts.
    pub count: u64,
    /// The latest example: an item in words, or the beginning of the message.
    pub example: String,
    /// When that came.
    pub last_at: Timestamp,
}

/// Reasons that are told apart; more are counted together.
const MAX_REASONS: usize = 16;
/// Characters of a reason, and of an example.
const REASON_CHARACTERS: usize = 200;
const OTHER_REASONS: &str = "other reasons";

/// A reason without its numbers, which differ from message to message.
fn without_numbers(reason: &str) -> impl Iterator<Item = char> {
    reason.chars().filter(|own| !own.is_ascii_digit())
}

/// The status of a connection.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct ConnectionStatus {
    pub state: ConnectionState,
    /// The time of the latest change of the state.
    pub since: Option<Timestamp>,
    /// The last error and its time.
    pub last_error: Option<(Timestamp, String)>,
    /// The last message.
    pub last_message: Option<LastMessage>,
    /// Messages that came, or were delivered.
    pub messages: u64,
    /// Detections and fixes that were taken, or positions that were queued.
    pub items: u64,
    /// Detections and fixes that could not be taken, and parts of messages without any.
    pub skipped: u64,
    /// Messages that could not be read, or that the receiver refused.
    pub rejected: u64,
    /// Positions that were dropped since the outbox was full; one for each server that was killed and may have lost some.
    pub dropped: u64,
    /// Messages that were acknowledged to the peer.
    pub acknowledged: u64,
    /// Connections to the peer that were opened.
    pub connects: u64,
    /// Messages of a source that were dropped unread: too long, or sent without a promise faster than they are taken.
    pub lost: u64,
    /// Clients that are connected to a listening source now.
    pub clients: u64,
    /// Clients that were refused or closed because there were too many.
    pub refused_clients: u64,
    /// Boxes and fixes of a source, and messages without any, that wait until what is to be stored is stored.
    pub unsettled: u64,
    /// Why messages, or parts of them, were not taken.
    pub reasons: Vec<CountedReason>,
    /// Age of the last item when it came, s; of the oldest waiting message of a sink.
    pub lag_s: Option<f64>,
}

impl ConnectionStatus {
    /// Counts what was not taken, under its reason. Reasons that differ in numbers alone are one.
    pub fn count_reason(&mut self, now: Timestamp, reason: &str, example: &str) {
        let cut = |text: &str| text.chars().take(REASON_CHARACTERS).collect::<String>();
        let is_same =
            |known: &CountedReason| without_numbers(&known.reason).eq(without_numbers(&cut(reason)));
        let at = self.reasons.iter().position(is_same).or_else(|| {
            let is_full = self.reasons.len() >= MAX_REASONS;
            is_full.then(|| self.reasons.iter().position(|known| known.reason == OTHER_REASONS)).flatten()
        });
        let reason = match self.reasons.len() {
            0..MAX_REASONS => reason,
            _ if at.is_some_and(|at| self.reasons[at].reason != OTHER_REASONS) => reason,
            _ => OTHER_REASONS,
        };
        let count = at.map_or(0, |at| self.reasons[at].count) + 1;
        let counted = CountedReason { reason: cut(reason), count, example: cut(example), last_at: now };
        match at {
            Some(at) => self.reasons[at] = counted,
            None => self.reasons.push(counted),
        }
    }

    /// Makes the counts the sums of what several nodes have counted.
    pub(super) fn set_counts<'a>(&mut self, all: impl Iterator<Item = &'a Self> + Clone) {
        let sum = |count: fn(&Self) -> u64| -> u64 { all.clone().map(count).sum() };
        self.messages = sum(|it| it.messages);
        self.items = sum(|it| it.items);
        self.skipped = sum(|it| it.skipped);
        self.rejected = sum(|it| it.rejected);
        self.dropped = sum(|it| it.dropped);
        self.acknowledged = sum(|it| it.acknowledged);
        self.connects = sum(|it| it.connects);
        self.lost = sum(|it| it.lost);
        self.clients = sum(|it| it.clients);
        self.refused_clients = sum(|it| it.refused_clients);
    }
}

/// A message that a client hands to a connection, with the way back.
pub struct PushedMessage {
    /// Who sends it.
    pub sender: String,
    pub payload: Bytes,
    /// Answered when what was to be stored is stored: the error of a message that cannot be read.
    pub settled: oneshot::Sender<Result<(), String>>,
}

/// One connection in memory.
#[derive(Default)]
pub struct LiveConnection {
    status: Mutex<ConnectionStatus>,
    /// The way to the running source, where it takes pushed messages.
    inlet: watch::Sender<Option<mpsc::Sender<PushedMessage>>>,
    /// Tells that the outbox of a sink has something new.
    pub queued: Notify,
    /// Set once this process reads the tracks of a sink's cameras.
    pub publishing: SetOnce<()>,
}

impl LiveConnection {
    /// Returns the present status.
    #[must_use]
    pub fn status(&self) -> ConnectionStatus {
        lock(&self.status).clone()
    }

    /// Changes what is known of it.
    pub fn update(&self, change: impl FnOnce(&mut ConnectionStatus)) {
        change(&mut lock(&self.status));
    }

    /// Enters a state.
    pub fn enter(&self, state: ConnectionState, now: Timestamp) {
        self.update(|status| {
            if status.state != state {
                (status.state, status.since) = (state, Some(now));
            }
        });
    }

    /// Opens or closes the way for pushed messages.
    pub fn set_inlet(&self, inlet: Option<mpsc::Sender<PushedMessage>>) {
        self.inlet.send_replace(inlet);
    }

    pub(in crate::app) fn inlet(&self) -> Option<mpsc::Sender<PushedMessage>> {
        self.inlet.borrow().clone()
    }

    /// The same once it is open; `None` if it is not within that time.
    pub(in crate::app) async fn opened_inlet(&self, within: Duration) -> Option<mpsc::Sender<PushedMessage>> {
        let mut inlet = self.inlet.subscribe();
        let opened = tokio::time::timeout(within, inlet.wait_for(Option::is_some)).await;
        opened.ok()?.ok()?.clone()
    }
}

/// All connections in memory.
#[derive(Default)]
pub struct ConnectionBoard {
    live: Mutex<HashMap<ConnectionId, (ConnectionKey, Arc<LiveConnection>)>>,
    changed: Notify,
}

impl ConnectionBoard {
    /// The live part of a connection.
    pub fn live(&self, id: &ConnectionId, key: ConnectionKey) -> Arc<LiveConnection> {
        let mut live = lock(&self.live);
        let known = live.get(id).filter(|(known, _)| *known == key);
        match known {
            Some((_, connection)) => connection.clone(),
            None => {
                let connection = Arc::new(LiveConnection::default());
                live.insert(id.clone(), (key, connection.clone()));
                connection
            }
        }
    }

    /// All that are known, with what they do.
    pub(super) fn all(&self) -> Vec<(ConnectionId, ConnectionKey, ConnectionStatus)> {
        let live = lock(&self.live);
        live.iter().map(|(id, (key, connection))| (id.clone(), *key, connection.status())).collect()
    }

    /// Returns the status of each connection.
    pub(super) fn statuses(&self) -> HashMap<ConnectionKey, ConnectionStatus> {
        lock(&self.live).values().map(|(key, connection)| (*key, connection.status())).collect()
    }

    pub(super) fn forget(&self, id: &ConnectionId) {
        lock(&self.live).remove(id);
    }

    /// Tells that connections were created, changed or deleted.
    pub(super) fn notify(&self) {
        self.changed.notify_one();
    }

    /// Waits for such a change.
    pub async fn changed(&self) {
        self.changed.notified().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_are_counted_with_their_latest_example() {
        let (mut status, at) = (ConnectionStatus::default(), Timestamp::from_second);
        for second in [1, 2, 3] {
            let now = at(second).expect("a time");
            status.count_reason(now, &format!("{second} s since 1970 is too old"), &format!("fix {second}"));
        }
        let now = at(4).expect("a time");
        status.count_reason(now, "is not JSON", "<xml>");
        let [old, json] = &status.reasons[..] else { panic!("two reasons: {status:?}") };
        assert_eq!((&*old.reason, old.count, &*old.example), ("3 s since 1970 is too old", 3, "fix 3"));
        assert_eq!((json.count, json.last_at), (1, now));
        // A sender that finds ever new reasons fills nothing.
        for letter in ('a'..='z').chain('A'..='Z') {
            status.count_reason(now, &format!("reason {letter}"), &"long ".repeat(100));
        }
        assert_eq!(status.reasons.len(), MAX_REASONS + 1);
        assert!(status.reasons.iter().all(|known| known.example.len() <= REASON_CHARACTERS));
        assert_eq!(status.reasons.iter().map(|known| known.count).sum::<u64>(), 3 + 1 + 52);
    }
}
