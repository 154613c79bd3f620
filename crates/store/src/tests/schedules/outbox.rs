//! Positions of a camera that changes nodes and comes back, on their way to the outbox of a sink and to its receiver.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::runtime::Runtime;
use uuid::Uuid;

use super::{fixture, runtime};
use crate::domain::{ConnectionKey, OutboxLog, OutboxMessage};
use crate::tests::{Fixture, at, connections};
use sightfix_schedules::{below, explore, explore_planted, pause};

const NODES: usize = 2;
/// Positions of a schedule, and of one transaction.
const POSITIONS: usize = 12;
const BATCH: usize = 3;

/// An error of a node.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Planted {
    None,
    /// The numbers of its log begin again when a camera comes back to it: positions are lost at fail-back.
    NumbersBeginAgain,
    /// A receiver's acknowledgement counts for all that wait.
    SettlesUnread,
}

struct Case {
    fixture: Fixture,
    sink: ConnectionKey,
    runtime: Runtime,
    schedules: AtomicUsize,
}

/// A node's log of positions that wait for the outbox.
#[derive(Default)]
struct Feed {
    waiting: VecDeque<(i64, usize)>,
    latest: i64,
}

struct Nodes {
    feeds: [Mutex<Feed>; NODES],
    all_made: AtomicBool,
    all_appended: AtomicUsize,
    /// How often the receiver got each position.
    received: Mutex<BTreeMap<String, usize>>,
}

impl Case {
    fn new() -> Arc<Self> {
        let runtime = runtime();
        let fixture = fixture(&runtime);
        let sink = runtime.block_on(connections::insert(&fixture.store, "sink")).key;
        Arc::new(Self { fixture, sink, runtime, schedules: AtomicUsize::new(0) })
    }

    fn call<T>(&self, call: impl Future<Output = crate::domain::Result<T>>) -> T {
        self.runtime.block_on(call).expect("the store works")
    }
}

/// Tracks the camera on one node after another; each position is acknowledged to its client.
async fn track(nodes: Arc<Nodes>, planted: Planted) {
    let mut owner = 0;
    for position in 0..POSITIONS {
        pause().await;
        if below(3) == 0 {
            owner = (owner + 1) % NODES;
            if planted == Planted::NumbersBeginAgain {
                nodes.feeds[owner].lock().expect("no panic").latest = 0;
            }
        }
        let mut feed = nodes.feeds[owner].lock().expect("no panic");
        feed.latest += 1;
        let number = feed.latest;
        feed.waiting.push_back((number, position));
    }
    nodes.all_made.store(true, Ordering::Release);
}

/// Brings a node's positions into the outbox; an answer of the database may get lost.
async fn publish(case: Arc<Case>, nodes: Arc<Nodes>, log: OutboxLog, node: usize) {
    loop {
        pause().await;
        let is_last = nodes.all_made.load(Ordering::Acquire);
        let oldest: Vec<_> =
            nodes.feeds[node].lock().expect("no panic").waiting.iter().take(BATCH).copied().collect();
        if oldest.is_empty() && is_last {
            break;
        }
        let message = |&(number, position): &(i64, usize)| OutboxMessage {
            number,
            message_id: position.to_string(),
            subject: "yard".to_owned(),
            payload: Vec::new(),
            created_at: at(0),
        };
        let messages: Vec<_> = oldest.iter().map(message).collect();
        case.call(case.fixture.store.append_to_outbox(case.sink, &log, &messages));
        if below(4) == 0 {
            // The answer got lost: the same is offered again, with what has come since.
            continue;
        }
        pause().await;
        nodes.feeds[node].lock().expect("no panic").waiting.drain(..oldest.len());
    }
    nodes.all_appended.fetch_add(1, Ordering::AcqRel);
}

/// Delivers what is in the outbox. A process that was stopped goes on beside the next one.
async fn deliver(case: Arc<Case>, nodes: Arc<Nodes>, planted: Planted) {
    let store = &case.fixture.store;
    loop {
        pause().await;
        let is_last = nodes.all_appended.load(Ordering::Acquire) == NODES;
        let messages = case.call(store.outbox(case.sink, BATCH as u32));
        if messages.is_empty() && is_last {
            return;
        }
        pause().await;
        let taken = below(messages.len() + 1);
        for message in &messages[..taken] {
            *nodes.received.lock().expect("no panic").entry(message.message_id.clone()).or_default() += 1;
        }
        let settled = if planted == Planted::SettlesUnread { &messages[..] } else { &messages[..taken] };
        let outcomes: Vec<_> = settled.iter().map(|message| (message.number, Ok(()))).collect();
        pause().await;
        case.call(store.settle_outbox(case.sink, &outcomes));
    }
}

fn scenario(case: &Arc<Case>, planted: Planted) {
    let number = case.schedules.fetch_add(1, Ordering::Relaxed);
    let nodes = Arc::new(Nodes {
        feeds: Default::default(),
        all_made: AtomicBool::new(false),
        all_appended: AtomicUsize::new(0),
        received: Mutex::default(),
    });
    sightfix_schedules::block_on(async {
        let mut tasks = vec![sightfix_schedules::spawn(track(Arc::clone(&nodes), planted))];
        for node in 0..NODES {
            let log = OutboxLog { id: Uuid::from_u128((number * NODES + node + 1) as u128), node: None };
            tasks.push(sightfix_schedules::spawn(publish(Arc::clone(case), Arc::clone(&nodes), log, node)));
            tasks.push(sightfix_schedules::spawn(deliver(Arc::clone(case), Arc::clone(&nodes), planted)));
        }
        for task in tasks {
            task.await.expect("no panic");
        }
    });
    let received = nodes.received.lock().expect("no panic");
    let expected: Vec<_> = (0..POSITIONS).map(|position| position.to_string()).collect();
    let lost: Vec<_> = expected.iter().filter(|position| !received.contains_key(*position)).collect();
    assert!(lost.is_empty(), "acknowledged and never delivered: {lost:?}");
    assert_eq!(received.len(), POSITIONS, "delivered and never made");
    case.runtime.block_on(case.fixture.tamper("DELETE FROM outbox; DELETE FROM outbox_logs"));
}

#[test]
fn each_position_is_delivered_whatever_node_made_it() {
    let case = Case::new();
    explore(move || scenario(&case, Planted::None));
}

#[test]
fn positions_lost_at_fail_back_are_found() {
    let case = Case::new();
    explore_planted("acknowledged and never delivered", move || scenario(&case, Planted::NumbersBeginAgain));
}

#[test]
fn a_message_that_is_settled_unread_is_found() {
    let case = Case::new();
    explore_planted("acknowledged and never delivered", move || scenario(&case, Planted::SettlesUnread));
}
