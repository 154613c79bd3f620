//! The task of one site: takes what waits, tracks it, and lets time pass where nothing comes.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::item::SiteItem;
use super::places::SitePlaces;
use super::rounds::Rounds;
use super::state::SiteLive;
use super::tracker::SiteTracker;
use crate::app::history::queue::HistoryQueue;
use crate::app::live::alarms::FindingQueue;
use crate::app::live::identification::MatchingSlot;
use crate::clock::Clock;
use crate::config::Limits;
use crate::telemetry::Metrics;

/// How often frames that have waited long enough are looked for.
const TICK: Duration = Duration::from_millis(50);
/// Items that are taken together, if they are there.
const BATCH: usize = 256;

/// The parts of the application that the task needs.
pub(super) struct SiteResources {
    pub(super) clock: Clock,
    pub(super) limits: Limits,
    pub(super) metrics: Metrics,
    pub(super) places: SitePlaces,
    pub(super) history: HistoryQueue,
    pub(super) matching_slot: MatchingSlot,
    pub(super) findings: FindingQueue,
}

/// Feeds the tracker until the site is deleted or the server ends.
pub(super) async fn run(live: Arc<SiteLive>, mut queue: mpsc::Receiver<SiteItem>, resources: SiteResources) {
    let clock = resources.clock.clone();
    let SiteResources { limits, metrics, places, history, matching_slot, findings, .. } = resources;
    let mut rounds = Rounds::new(matching_slot, clock.clone());
    let mut tracker = SiteTracker::new(live.clone(), limits, metrics, Some(places), history.clone());
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut items = Vec::with_capacity(BATCH);
    loop {
        tokio::select! {
            biased;
            () = live.ended.cancelled() => break,
            taken = queue.recv_many(&mut items, BATCH) => if taken == 0 { break },
            _ = tick.tick(), if tracker.is_busy() => {}
        }
        let now = clock.monotonic();
        for item in items.drain(..) {
            tracker.push(item, now);
        }
        tracker.advance(now);
        for finding in tracker.take_findings() {
            findings.send(finding).await;
        }
        rounds.advance(&mut tracker, now).await;
        // Other tasks on this thread get their turn.
        tokio::task::yield_now().await;
    }
    history.send_all(tracker.end()).await;
}
