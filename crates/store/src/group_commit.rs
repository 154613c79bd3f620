//! Group commit of samples: one task commits what many callers have queued in one transaction.
//!
//! A commit costs much more than a row, so every batch that is queued when a transaction begins joins
//! it. Nothing is acknowledged before its commit, and a caller's batch is stored atomically.
//! A caller does not wait for more callers to come, the queue has a limit, and a cancelled caller does not disturb the
//! others.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;

use futures_util::future::BoxFuture;
use jiff::Timestamp;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};

use super::limits::Usage;
use super::refusals::{closed, copy_of, no_camera};
use super::rows::idempotency::IdempotencyRecord;
use super::rows::samples::{Row, SampleTable, keep_last};
use crate::domain::{Actor, CameraId, CameraKey, Durability, Error, OnConflict, Result, StoredSample};

/// A transaction takes no further caller beyond this number of rows.
const ROWS_PER_TRANSACTION: usize = 4_096;

/// Rows that wait or are being committed; further callers wait to queue theirs.
const ROWS_IN_FLIGHT: u32 = 65_536;

/// Callers that wait; each has at least one row, so more never wait.
const QUEUE: usize = 16_384;

/// The outcome of the samples of one call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Inserted {
    /// Samples stored now.
    pub accepted: u64,
    /// Stored before, under the same camera, target and time.
    pub duplicate: u64,
    /// Number of accepted samples without a fix.
    pub without_fix: u64,
    /// Number of accepted samples that replaced a stored sample on request.
    pub replaced: u64,
}

/// How the last batch of an import is completed.
#[derive(Clone)]
pub struct Completion {
    /// Under which key the answer is stored.
    pub record: IdempotencyRecord,
    /// Writes the answer, from what became of the last batch.
    pub answer: Arc<dyn Fn(&Inserted) -> String + Send + Sync>,
}

impl fmt::Debug for Completion {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.record.fmt(out)
    }
}

/// How a batch of samples is stored.
#[derive(Debug, Clone)]
pub struct InsertOptions {
    /// When it is acknowledged.
    pub durability: Durability,
    /// The rule for samples that are stored already.
    pub on_conflict: OnConflict,
    /// For the last batch of an import that its client may repeat.
    pub completion: Option<Completion>,
    /// The time now.
    pub now: Timestamp,
}

impl From<Durability> for InsertOptions {
    /// A batch without an operation to be recorded.
    fn from(durability: Durability) -> Self {
        Self { durability, on_conflict: OnConflict::Keep, completion: None, now: Timestamp::UNIX_EPOCH }
    }
}

/// Queues batches for the task.
pub(super) struct GroupCommit {
    queue: mpsc::Sender<WriteRequest>,
    rows: Arc<Semaphore>,
}

enum WriteRequest {
    Insert(SampleBatch),
    /// Everything queued before is committed, then the task ends.
    End(oneshot::Sender<()>),
}

pub(super) struct SampleBatch {
    pub(super) camera: CameraId,
    /// The camera must still be this one; `None` for whichever has the id.
    pub(super) key: Option<CameraKey>,
    pub(super) samples: Vec<StoredSample>,
    pub(super) options: InsertOptions,
    /// Samples that were left out because a later one of the batch takes their place.
    pub(super) repeated: u64,
    /// On whose behalf.
    pub(super) actor: Arc<Actor>,
    reply: oneshot::Sender<Result<Inserted>>,
    /// Limits the rows in flight; released when the batch is done.
    _permit: OwnedSemaphorePermit,
}

impl GroupCommit {
    pub(super) fn start(writer: Arc<dyn SampleWriter>) -> Self {
        let (queue, task) = Self::new(writer);
        tokio::spawn(task);
        queue
    }

    /// The queue, and the task that empties it.
    pub(super) fn new(writer: Arc<dyn SampleWriter>) -> (Self, impl Future<Output = ()> + Send + 'static) {
        let (queue, requests) = mpsc::channel(QUEUE);
        let rows = Arc::new(Semaphore::new(ROWS_IN_FLIGHT as usize));
        (Self { queue, rows }, run(writer, requests))
    }

    pub(super) async fn insert(
        &self,
        (camera, key): (CameraId, Option<CameraKey>),
        mut samples: Vec<StoredSample>,
        options: InsertOptions,
        actor: Arc<Actor>,
    ) -> Result<Inserted> {
        let repeated = match options.on_conflict {
            OnConflict::Keep => 0,
            OnConflict::Replace => keep_last(&mut samples),
        };
        let rows = u32::try_from(samples.len()).unwrap_or(u32::MAX).clamp(1, ROWS_IN_FLIGHT);
        let permit = Arc::clone(&self.rows).acquire_many_owned(rows).await.map_err(|_| closed())?;
        let (reply, answer) = oneshot::channel();
        let batch = SampleBatch { camera, key, samples, options, repeated, actor, reply, _permit: permit };
        self.queue.send(WriteRequest::Insert(batch)).await.map_err(|_| self.task_ended())?;
        answer.await.map_err(|_| self.task_ended())?
    }

    pub(super) async fn close(&self) {
        self.rows.close();
        let (ended, end) = oneshot::channel();
        if self.queue.send(WriteRequest::End(ended)).await.is_ok() {
            // An error means that the task has ended already, which is what is waited for.
            let _ = end.await;
        }
    }

    /// Rows that wait or are being committed.
    pub(super) fn queued_rows(&self) -> u32 {
        ROWS_IN_FLIGHT.saturating_sub(u32::try_from(self.rows.available_permits()).unwrap_or(u32::MAX))
    }

    pub(super) fn has_ended(&self) -> bool {
        self.queue.is_closed()
    }

    /// Callers whose batches are still queued.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.queue.max_capacity() - self.queue.capacity()
    }

    /// Why the task has ended: closed, or failed.
    fn task_ended(&self) -> Error {
        if self.rows.is_closed() { closed() } else { Error::fault("the task that stores samples has ended") }
    }
}

/// The right of a backend to write, for one group.
pub(super) trait WriteSession: Send {
    /// One transaction for all batches, with an outcome for each, in their order.
    fn commit<'a>(&'a mut self, durability: Durability, group: &'a [SampleBatch]) -> Committing<'a>;
}

/// The outcomes of a group.
pub(super) type Committing<'a> = BoxFuture<'a, Result<Vec<Result<Inserted>>, Failure>>;

/// Stores the groups of a backend.
pub(super) trait SampleWriter: Send + Sync {
    /// Waits for the right to write.
    fn session(&self) -> BoxFuture<'_, Result<Box<dyn WriteSession + '_>>>;
}

async fn run(writer: Arc<dyn SampleWriter>, mut requests: mpsc::Receiver<WriteRequest>) {
    while let Some(first) = requests.recv().await {
        // The writer first: batches that are queued while it is locked for another change join the group.
        let session = writer.session().await;
        let (group, end) = gather(first, &mut requests);
        match session {
            Ok(mut session) => {
                let durability = durability_of(&group);
                for group in transactions(group) {
                    answer_all(&mut *session, durability, group).await;
                }
            }
            Err(error) => refuse_all(group, &error),
        }
        if let Some(ended) = end {
            // The caller may have been cancelled.
            let _ = ended.send(());
            return;
        }
    }
}

/// The strongest that a caller of the group asks for: one flush is enough for all of them.
fn durability_of(group: &[SampleBatch]) -> Durability {
    group.iter().map(|batch| batch.options.durability).max().unwrap_or_default()
}

/// Splits a group, in its order, into those of one transaction each: a batch that replaces samples must find
/// what the batches before it have stored, so it has its own.
fn transactions(group: Vec<SampleBatch>) -> Vec<Vec<SampleBatch>> {
    let mut transactions: Vec<Vec<SampleBatch>> = Vec::new();
    for batch in group {
        match transactions.last_mut() {
            Some(last) if !batch.replaces() && !last.iter().any(SampleBatch::replaces) => last.push(batch),
            _ => transactions.push(vec![batch]),
        }
    }
    transactions
}

impl SampleBatch {
    pub(super) fn replaces(&self) -> bool {
        self.options.on_conflict == OnConflict::Replace
    }
}

/// Takes what is in the queue now, up to the rows of one transaction.
fn gather(
    first: WriteRequest,
    requests: &mut mpsc::Receiver<WriteRequest>,
) -> (Vec<SampleBatch>, Option<oneshot::Sender<()>>) {
    let mut group = Vec::new();
    let mut rows = 0;
    let mut next = Some(first);
    while let Some(request) = next {
        match request {
            WriteRequest::Insert(batch) => {
                rows += batch.samples.len();
                group.push(batch);
            }
            WriteRequest::End(ended) => return (group, Some(ended)),
        }
        next = if rows < ROWS_PER_TRANSACTION { requests.try_recv().ok() } else { None };
    }
    (group, None)
}

/// Commits a group and answers each of its callers. If it cannot be stored together, each is tried
/// alone, so that one bad row fails nobody but its caller.
async fn answer_all(session: &mut dyn WriteSession, durability: Durability, group: Vec<SampleBatch>) {
    match session.commit(durability, &group).await {
        Ok(outcomes) => {
            for (batch, outcome) in group.into_iter().zip(outcomes) {
                // A cancelled caller needs no answer.
                let _ = batch.reply.send(outcome);
            }
        }
        Err(Failure::Statement(_)) if group.len() > 1 => {
            for batch in group {
                let alone = session.commit(durability, std::slice::from_ref(&batch)).await;
                let outcome = match alone {
                    Ok(mut outcomes) => outcomes.swap_remove(0),
                    Err(Failure::Statement(error) | Failure::Transaction(error)) => Err(error),
                };
                let _ = batch.reply.send(outcome);
            }
        }
        Err(Failure::Statement(error) | Failure::Transaction(error)) => refuse_all(group, &error),
    }
}

fn refuse_all(group: Vec<SampleBatch>, error: &Error) {
    for batch in group {
        let _ = batch.reply.send(Err(copy_of(error)));
    }
}

pub(super) enum Failure {
    /// A statement failed; the group's other callers may do better.
    Statement(Error),
    /// The transaction could not begin or commit; nobody would do better.
    Transaction(Error),
}

impl Failure {
    pub(super) const fn error(&self) -> &Error {
        match self {
            Self::Statement(error) | Self::Transaction(error) => error,
        }
    }
}

/// How statements and batches go together.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Counting {
    /// Statements span batches: fast, and countable as long as all rows of each are new, or none.
    Together,
    /// No statement spans batches.
    Apart,
}

/// The key of each batch's camera, or why the batch is not stored.
pub(super) fn admit(
    cameras: &mut HashMap<String, Known>,
    usage: &Usage,
    group: &[SampleBatch],
) -> Vec<Result<i64>> {
    let mut quota = usage.quota();
    let admitted = group.iter().map(|batch| {
        let camera = cameras
            .get_mut(batch.camera.as_str())
            .filter(|camera| batch.key.is_none_or(|key| key == CameraKey(camera.key)));
        let camera = camera.ok_or_else(|| no_camera(&batch.camera))?;
        quota.admit(&batch.camera, &mut camera.samples, batch.samples.len() as u64)?;
        Ok(camera.key)
    });
    admitted.collect()
}

/// The rows of admitted batches that a table takes, and where statements must end.
pub(super) fn rows_of<'a>(
    table: SampleTable,
    group: &'a [SampleBatch],
    admitted: &[Result<i64>],
    counting: Counting,
) -> (Vec<Row<'a>>, Vec<usize>) {
    let (mut rows, mut borders) = (Vec::new(), Vec::new());
    for (index, (batch, camera_key)) in group.iter().zip(admitted).enumerate() {
        if let Ok(camera_key) = *camera_key {
            let of_table = batch.samples.iter().filter(|sample| SampleTable::of(sample) == table);
            rows.extend(of_table.map(|sample| Row { batch: index, camera_key, sample }));
        }
        if counting == Counting::Apart {
            borders.push(rows.len());
        }
    }
    borders.push(rows.len());
    (rows, borders)
}

/// Adds a statement's count to its batches; false if its duplicates cannot be attributed to one.
pub(super) fn count(outcomes: &mut [Result<Inserted>], rows: &[Row<'_>], accepted: u64) -> bool {
    let all = rows.len() as u64;
    if accepted == all || accepted == 0 {
        for row in rows {
            add(outcomes, row, u64::from(accepted > 0), u64::from(accepted == 0));
        }
        return true;
    }
    match (rows.first(), rows.last()) {
        (Some(first), Some(last)) if first.batch == last.batch => {
            add(outcomes, first, accepted, all - accepted);
            true
        }
        _ => false,
    }
}

fn add(outcomes: &mut [Result<Inserted>], row: &Row<'_>, accepted: u64, duplicate: u64) {
    if let Some(Ok(inserted)) = outcomes.get_mut(row.batch) {
        inserted.accepted += accepted;
        inserted.duplicate += duplicate;
        inserted.without_fix += if row.sample.fix.is_none() { accepted } else { 0 };
    }
}

/// A camera of a group.
pub(super) struct Known {
    pub(super) key: i64,
    /// Samples stored, and those of the group that are admitted.
    pub(super) samples: u64,
    /// Samples without a fix that are stored.
    pub(super) without_fix: u64,
    /// Number of these whose place samples of the group have taken.
    pub(super) replaced: u64,
}

pub(super) fn as_count(stored: i64) -> u64 {
    u64::try_from(stored).unwrap_or_default()
}

/// The changes of a group per camera, by its key: samples with a fix, samples without, and boxes whose place
/// samples with a fix have taken.
pub(super) fn changed_counts(
    cameras: &HashMap<String, Known>,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> HashMap<i64, [u64; 3]> {
    let mut changes: HashMap<i64, [u64; 3]> = HashMap::new();
    for (batch, outcome) in group.iter().zip(outcomes) {
        if let (Ok(inserted), Some(camera)) = (outcome, cameras.get(batch.camera.as_str()))
            && inserted.accepted > 0
        {
            let [with_fix, without_fix, replaced] = changes.entry(camera.key).or_default();
            *with_fix += inserted.accepted - inserted.without_fix;
            *without_fix += inserted.without_fix;
            *replaced = camera.replaced;
        }
    }
    changes
}

/// The outcomes of a group before any of its rows is stored: of those that were not admitted, why.
pub(super) fn outcomes_before(
    admitted: &[Result<i64>],
    group: &[SampleBatch],
    replaced: u64,
) -> Vec<Result<Inserted>> {
    let begin = |(camera, batch): (&Result<i64>, &SampleBatch)| {
        let begun = Inserted { replaced, duplicate: batch.repeated, ..Inserted::default() };
        camera.as_ref().map(|_| begun).map_err(copy_of)
    };
    admitted.iter().zip(group).map(begin).collect()
}

/// True if a group must be rolled back although its statements worked: what was to be replaced stays where the
/// batch was refused.
pub(super) fn must_roll_back(group: &[SampleBatch], outcomes: &[Result<Inserted>]) -> bool {
    group.iter().zip(outcomes).any(|(batch, outcome)| batch.replaces() && outcome.is_err())
}

/// Notes in the usage what became of a group.
pub(super) fn note(usage: &Usage, committed: &Result<Vec<Result<Inserted>>, Failure>) {
    match committed {
        Ok(outcomes) => usage
            .stored(outcomes.iter().flatten().map(|inserted| inserted.accepted - inserted.replaced).sum()),
        Err(failure) => usage.failed(failure.error()),
    }
}
