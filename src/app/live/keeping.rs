//! What streams bring, paired in time and kept as samples, with a receipt for every item.
//!
//! All streams of a camera share one pairing, for boxes and fixes may come from two devices. An item
//! is settled when it is committed as part of a sample or can no longer become one; one task per
//! camera commits in the order of the decisions. What never happens here: an item settled before the
//! commit, or lost for want of room (then it is decided early).

use std::collections::{BTreeSet, HashMap};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{Notify, mpsc};
use tokio::time::Instant;

use super::lock;
use crate::domain::{CameraId, Detection, Durability, Error, ErrorKind, Fix, Result, Sample, TargetId};
use crate::fusion::pairing::{Decided, Pairer, PairingSettings};
use crate::store::Store;
use crate::telemetry::Metrics;

/// Decisions that wait for their commit; streams beyond wait.
const QUEUE: usize = 256;
/// Items of one camera that may wait for their decision; beyond, all of them are decided early.
const MOST_WAITING: usize = 16_384;
/// How often targets are looked for that have fallen silent.
const TICK: Duration = Duration::from_secs(1);

/// What one stream has handed in and what of it is settled.
#[derive(Default)]
pub(super) struct Ledger {
    entries: Mutex<Entries>,
    changed: Notify,
    /// When the stream's samples are acknowledged.
    durability: Durability,
}

#[derive(Default)]
struct Entries {
    outstanding: BTreeSet<u64>,
    highest: u64,
    failed: Option<ErrorKind>,
}

impl Ledger {
    pub(super) fn beginning_after(seq: u64, durability: Durability) -> Arc<Self> {
        let entries = Entries { highest: seq, ..Entries::default() };
        Arc::new(Self { entries: Mutex::new(entries), changed: Notify::new(), durability })
    }

    pub(super) const fn durability(&self) -> Durability {
        self.durability
    }

    /// An item that is settled as it comes: nothing of it is ever kept.
    pub(super) fn pass(&self, seq: u64) {
        let mut entries = lock(&self.entries);
        entries.highest = entries.highest.max(seq);
    }

    fn receipt(self: &Arc<Self>, seq: u64) -> Receipt {
        let mut entries = lock(&self.entries);
        entries.highest = entries.highest.max(seq);
        entries.outstanding.insert(seq);
        Receipt { ledger: self.clone(), seq }
    }

    /// The seq up to which everything is settled.
    pub(super) fn settled(&self) -> u64 {
        let entries = lock(&self.entries);
        entries.outstanding.first().map_or(entries.highest, |first| first - 1)
    }

    /// Whether nothing is outstanding.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) fn is_settled(&self) -> Result<bool> {
        let entries = lock(&self.entries);
        match entries.failed {
            None => Ok(entries.outstanding.is_empty()),
            Some(kind) => Err(not_kept(kind)),
        }
    }

    /// Waits for a change since the last wait.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Nothing more is acknowledged. The first reason stays.
    fn fail(&self, kind: ErrorKind) -> Error {
        let kind = *lock(&self.entries).failed.get_or_insert(kind);
        self.changed.notify_one();
        not_kept(kind)
    }
}

fn not_kept(kind: ErrorKind) -> Error {
    match kind {
        ErrorKind::CameraNotFound => Error::refused(kind, "the camera was deleted"),
        ErrorKind::InsufficientStorage => Error::refused(
            kind,
            "there is no space for more samples; open the stream again behind the last acknowledged seq when \
             some has been freed",
        ),
        _ => Error::refused(
            ErrorKind::Overloaded,
            "samples could not be stored; open the stream again behind the last acknowledged seq",
        ),
    }
}

/// One item's place in its stream's ledger.
struct Receipt {
    ledger: Arc<Ledger>,
    seq: u64,
}

impl Receipt {
    fn settle(self) {
        lock(&self.ledger.entries).outstanding.remove(&self.seq);
        self.ledger.changed.notify_one();
    }
}

/// Part of an item that looks for its partner.
pub(super) enum Half {
    Box(Detection),
    Fix(TargetId, Timestamp, Fix),
}

/// What is decided together.
#[derive(Default)]
struct Commit {
    samples: Vec<Sample>,
    receipts: Vec<Receipt>,
}

/// The shared pairing of one camera's streams; dropped with the last of them.
pub(super) struct Keeping {
    waiting: Mutex<Waiting>,
    commits: mpsc::Sender<Commit>,
    settings: PairingSettings,
}

struct Waiting {
    pairer: Pairer,
    targets: HashMap<TargetId, Unsettled>,
    items: usize,
}

struct Unsettled {
    receipts: Vec<(Timestamp, Receipt)>,
    touched: Instant,
}

impl Keeping {
    /// Begins to keep samples of a camera, by a task that ends when the last holder is gone.
    pub(super) fn start(id: CameraId, store: Store, metrics: Metrics) -> Arc<Self> {
        let settings =
            PairingSettings { items_per_target: 1_024, targets: 256, ..PairingSettings::default() };
        let (commits, queue) = mpsc::channel(QUEUE);
        let keeping = Arc::new(Self {
            waiting: Mutex::new(Waiting { pairer: Pairer::new(settings), targets: HashMap::new(), items: 0 }),
            commits,
            settings,
        });
        tokio::spawn(commit_all(Arc::downgrade(&keeping), queue, id, store, metrics));
        keeping
    }

    /// Whether nothing more can be kept: a commit has failed.
    pub(super) fn has_failed(&self) -> bool {
        self.commits.is_closed()
    }

    /// How late items may come and still find their partner.
    pub(super) fn lateness(&self) -> Duration {
        self.settings.lateness.unsigned_abs()
    }

    /// Takes a whole sample.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn whole(&self, ledger: &Arc<Ledger>, seq: u64, sample: Sample) -> Result<()> {
        let room = self.commits.reserve().await.map_err(|_| stopped(ledger))?;
        room.send(Commit { samples: vec![sample], receipts: vec![ledger.receipt(seq)] });
        Ok(())
    }

    /// Takes a box or a fix that looks for its partner.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn half(&self, ledger: &Arc<Ledger>, seq: u64, half: Half) -> Result<()> {
        // The place in the queue first and the lock held to the end, so that decisions are queued in
        // the order they are made.
        let room = self.commits.reserve().await.map_err(|_| stopped(ledger))?;
        let mut waiting = lock(&self.waiting);
        let commit = waiting.take(ledger, seq, half);
        if !commit.samples.is_empty() || !commit.receipts.is_empty() {
            room.send(commit);
        }
        Ok(())
    }

    /// Decides all targets that a stream's items wait for.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn end(&self, ledger: &Arc<Ledger>) -> Result<()> {
        let room = self.commits.reserve().await.map_err(|_| stopped(ledger))?;
        let mut waiting = lock(&self.waiting);
        room.send(waiting.end(|unsettled| {
            unsettled.receipts.iter().any(|(_, receipt)| Arc::ptr_eq(&receipt.ledger, ledger))
        }));
        Ok(())
    }
}

/// The queue is closed by a commit that failed, and never else while a stream holds the keeping: a
/// stream that had nothing in that commit must end too, or it would acknowledge what nobody keeps.
fn stopped(ledger: &Ledger) -> Error {
    ledger.fail(ErrorKind::Internal)
}

impl Waiting {
    fn take(&mut self, ledger: &Arc<Ledger>, seq: u64, half: Half) -> Commit {
        let (target_id, time) = match &half {
            Half::Box(detection) => (&detection.target_id, detection.time),
            Half::Fix(target_id, time, _) => (target_id, *time),
        };
        let now = Instant::now();
        if !self.targets.contains_key(target_id) {
            self.targets.insert(target_id.clone(), Unsettled { receipts: Vec::new(), touched: now });
        }
        if let Some(unsettled) = self.targets.get_mut(target_id) {
            unsettled.touched = now;
            unsettled.receipts.push((time, ledger.receipt(seq)));
        }
        self.items += 1;
        let decided = match half {
            Half::Box(detection) => self.pairer.push_detection(detection),
            Half::Fix(target_id, time, fix) => self.pairer.push_fix(&target_id, time, fix),
        };
        let mut commit = self.commit(decided);
        if self.items > MOST_WAITING {
            let early = self.end(|_| true);
            commit.samples.extend(early.samples);
            commit.receipts.extend(early.receipts);
        }
        commit
    }

    /// Ends the targets that a rule names.
    fn end(&mut self, named: impl Fn(&Unsettled) -> bool) -> Commit {
        let named = self.targets.iter().filter(|(_, unsettled)| named(unsettled));
        let targets: Vec<TargetId> = named.map(|(target_id, _)| target_id.clone()).collect();
        let decided = targets
            .into_iter()
            .map(|target_id| {
                let nothing = || Decided {
                    target_id: target_id.clone(),
                    samples: Vec::new(),
                    settled_before: Timestamp::MAX,
                };
                self.pairer.end(&target_id).unwrap_or_else(nothing)
            })
            .collect();
        self.commit(decided)
    }

    fn commit(&mut self, decided: Vec<Decided>) -> Commit {
        let mut commit = Commit::default();
        for Decided { target_id, samples, settled_before } in decided {
            commit.samples.extend(samples);
            let Some(unsettled) = self.targets.get_mut(&target_id) else { continue };
            let settled = unsettled.receipts.extract_if(.., |(time, _)| *time < settled_before);
            let before = commit.receipts.len();
            commit.receipts.extend(settled.map(|(_, receipt)| receipt));
            self.items -= commit.receipts.len() - before;
            if unsettled.receipts.is_empty() {
                self.targets.remove(&target_id);
            }
        }
        commit
    }
}

/// Commits what is decided, in order, until the last stream is gone.
async fn commit_all(
    keeping: Weak<Keeping>,
    mut queue: mpsc::Receiver<Commit>,
    id: CameraId,
    store: Store,
    metrics: Metrics,
) {
    let mut tick = tokio::time::interval(TICK);
    loop {
        let mut commit = tokio::select! {
            commit = queue.recv() => match commit {
                Some(commit) => commit,
                None => return,
            },
            _ = tick.tick() => {
                let Some(keeping) = keeping.upgrade() else { continue };
                // With the queue empty: a decision must not overtake one that waits in it.
                if !queue.is_empty() {
                    continue;
                }
                let lateness = keeping.lateness();
                let mut waiting = lock(&keeping.waiting);
                if !queue.is_empty() {
                    continue;
                }
                waiting.end(|unsettled| unsettled.touched.elapsed() >= lateness)
            }
        };
        while let Ok(more) = queue.try_recv() {
            commit.samples.extend(more.samples);
            commit.receipts.extend(more.receipts);
        }
        if let Err(error) = store_all(&store, &id, commit, &metrics).await {
            fail(&keeping, &mut queue, &id, &error);
            return;
        }
    }
}

async fn store_all(store: &Store, id: &CameraId, commit: Commit, metrics: &Metrics) -> Result<()> {
    let Commit { samples, receipts } = commit;
    if !samples.is_empty() {
        // Streams share a commit: the strongest of their demands holds for all of it.
        let durability = receipts.iter().map(|receipt| receipt.ledger.durability).max().unwrap_or_default();
        match store.insert_samples(id, samples, durability).await {
            Ok(inserted) => metrics.imported(inserted.accepted, inserted.duplicate, 0),
            Err(error) => {
                receipts.iter().for_each(|receipt| drop(receipt.ledger.fail(error.kind())));
                return Err(error);
            }
        }
    }
    receipts.into_iter().for_each(Receipt::settle);
    Ok(())
}

/// Tells every stream with something outstanding; none of it is acknowledged.
fn fail(keeping: &Weak<Keeping>, queue: &mut mpsc::Receiver<Commit>, id: &CameraId, error: &Error) {
    if matches!(error, Error::Fault(_)) {
        tracing::error!(camera.id = %id, %error, "the samples of a stream cannot be stored");
    }
    queue.close();
    while let Ok(commit) = queue.try_recv() {
        commit.receipts.iter().for_each(|receipt| drop(receipt.ledger.fail(error.kind())));
    }
    if let Some(keeping) = keeping.upgrade() {
        for unsettled in lock(&keeping.waiting).targets.values() {
            unsettled.receipts.iter().for_each(|(_, receipt)| drop(receipt.ledger.fail(error.kind())));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::{Options, simulate};

    #[tokio::test]
    async fn a_failed_commit_ends_every_stream_and_acknowledges_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let nowhere = CameraId::new("nowhere").expect("a slug");
        let keeping = Keeping::start(nowhere, store, Metrics::new());
        let samples = simulate(&Options { samples: 2, ..Options::demo() }).training_samples();
        let (first, second) = (
            Ledger::beginning_after(0, Durability::default()),
            Ledger::beginning_after(7, Durability::default()),
        );
        keeping.whole(&first, 1, samples[0].clone()).await.expect("handed in");
        while first.is_settled().is_ok() {
            first.changed().await;
        }
        assert_eq!(first.settled(), 0);
        assert!(keeping.has_failed());
        // The other stream had nothing in the commit that failed.
        assert!(second.is_settled().is_ok());
        keeping.whole(&second, 8, samples[1].clone()).await.expect_err("kept by nobody");
        second.is_settled().expect_err("must end");
        assert_eq!(second.settled(), 7);
    }
}
