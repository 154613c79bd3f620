//! Pairing of what streams bring, and recording it as samples.
//!
//! All streams of a camera share one pairing, for boxes and fixes may come from two devices. An item is
//! acknowledged when it is committed as part of a sample or can no longer become one; one task per camera
//! ([`super::sample_committer`]) commits in the order of the decisions. For want of room items are decided
//! early, never lost.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::acknowledgements::{AckTracker, PendingAck};
use super::sync::lock;
use crate::domain::{Detection, Error, ErrorKind, Fix, Result, Sample, TargetId};
use crate::fusion::pairing::{ItemOutcome, PairedItems, Pairer, PairingSettings, Released};

/// Decisions that wait for their commit; streams beyond wait. At 2,000 items a second a disk may take 4 s for a flush before
/// positions wait for it.
const QUEUE: usize = 8_192;
/// Items of one camera that may wait for their decision; beyond, all of them are decided early.
const MOST_PENDING: usize = 16_384;

/// Samples and the items that are acknowledged with their commit.
pub(super) type Commit = PairedItems<PendingAck>;

/// A box or a fix that looks for its partner.
pub(super) enum UnpairedItem {
    Box(Detection),
    Fix(TargetId, Timestamp, Fix),
}

/// The shared pairing of one camera's streams; dropped with the last of them.
pub(super) struct SampleRecorder {
    pending: Mutex<PendingItems>,
    commits: mpsc::Sender<Commit>,
    settings: PairingSettings,
}

/// Items that wait for their decision.
struct PendingItems {
    pairer: Pairer<PendingAck>,
    last_push: HashMap<TargetId, Instant>,
    items: usize,
}

impl SampleRecorder {
    /// A recorder and the queue of what it has decided.
    pub(super) fn new() -> (Arc<Self>, mpsc::Receiver<Commit>) {
        let settings =
            PairingSettings { items_per_target: 1_024, targets: 256, ..PairingSettings::default() };
        let (commits, queue) = mpsc::channel(QUEUE);
        let pending = PendingItems { pairer: Pairer::new(settings), last_push: HashMap::new(), items: 0 };
        (Arc::new(Self { pending: Mutex::new(pending), commits, settings }), queue)
    }

    /// True if nothing more can be recorded: a commit has failed.
    pub(super) fn has_failed(&self) -> bool {
        self.commits.is_closed()
    }

    /// How late items may come and still find their partner.
    pub(super) fn allowed_lateness(&self) -> Duration {
        self.settings.allowed_lateness.unsigned_abs()
    }

    /// Takes a whole sample.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn push_sample(
        &self,
        tracker: &Arc<AckTracker>,
        seq: u64,
        sample: Sample,
    ) -> Result<()> {
        let room = self.commits.reserve().await.map_err(|_| stopped(tracker))?;
        let released = Released { tag: tracker.pending(seq), outcome: ItemOutcome::Paired };
        room.send(Commit { samples: vec![sample], released: vec![released], ..Commit::default() });
        Ok(())
    }

    /// Takes a box or a fix that looks for its partner.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn push_unpaired(
        &self,
        tracker: &Arc<AckTracker>,
        seq: u64,
        item: UnpairedItem,
    ) -> Result<()> {
        // First the place in the queue, then the lock until the send, so that decisions are queued in the
        // order they are made.
        let room = self.commits.reserve().await.map_err(|_| stopped(tracker))?;
        let mut pending = lock(&self.pending);
        let commit = pending.push(tracker.pending(seq), item);
        if !commit.is_empty() {
            room.send(commit);
        }
        Ok(())
    }

    /// Decides all targets that a stream's items wait for.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn end_stream(&self, tracker: &Arc<AckTracker>) -> Result<()> {
        let room = self.commits.reserve().await.map_err(|_| stopped(tracker))?;
        let mut pending = lock(&self.pending);
        let targets = pending.pairer.targets_with(|ack| ack.belongs_to(tracker));
        room.send(pending.end(&targets));
        Ok(())
    }

    /// Decides the targets of which nothing came for the allowed lateness. `is_idle` says whether the queue
    /// is empty: a decision must not overtake one that waits in it.
    pub(super) fn end_silent_targets(&self, is_idle: impl FnOnce() -> bool) -> Commit {
        let mut pending = lock(&self.pending);
        if !is_idle() {
            return Commit::default();
        }
        let is_silent = |since: &Instant| since.elapsed() >= self.allowed_lateness();
        let silent = pending.last_push.iter().filter(|(_, since)| is_silent(since));
        let silent: Vec<TargetId> = silent.map(|(target_id, _)| target_id.clone()).collect();
        pending.end(&silent)
    }

    /// Ends every stream with a pending item; none of them is acknowledged.
    pub(super) fn fail(&self, kind: ErrorKind) {
        lock(&self.pending).pairer.tags().for_each(|ack| ack.fail(kind));
    }
}

/// While a stream holds the recorder, only a commit that failed closes the queue: a
/// stream that had nothing in that commit must end too, or it would acknowledge what is not stored.
fn stopped(tracker: &AckTracker) -> Error {
    tracker.fail(ErrorKind::Internal)
}

impl PendingItems {
    fn push(&mut self, ack: PendingAck, item: UnpairedItem) -> Commit {
        let target_id = match &item {
            UnpairedItem::Box(detection) => &detection.target_id,
            UnpairedItem::Fix(target_id, ..) => target_id,
        };
        match self.last_push.get_mut(target_id) {
            Some(since) => *since = Instant::now(),
            None => drop(self.last_push.insert(target_id.clone(), Instant::now())),
        }
        self.items += 1;
        let mut commit = match item {
            UnpairedItem::Box(detection) => self.pairer.push_detection(detection, ack),
            UnpairedItem::Fix(target_id, time, fix) => self.pairer.push_fix(&target_id, time, fix, ack),
        };
        self.items -= commit.released.len();
        if self.items > MOST_PENDING {
            let all = self.pairer.targets_with(|_| true);
            commit.append(self.end(&all));
        }
        commit
    }

    fn end(&mut self, targets: &[TargetId]) -> Commit {
        let mut commit = Commit::default();
        for target_id in targets {
            commit.append(self.pairer.end(target_id));
            self.last_push.remove(target_id);
        }
        self.items -= commit.released.len();
        commit
    }
}
