//! Group commit of samples: one task commits what many callers have queued in one transaction.
//!
//! A commit costs much more than a row, so every batch that is queued when a transaction begins joins
//! it. Nothing is acknowledged before its commit, and a caller's batch is stored atomically.
//! What never happens here: a caller waits for more callers to come, the queue grows without bound, a
//! cancelled caller disturbs the others.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;

use jiff::Timestamp;
use sqlx::SqliteConnection;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};

use super::audit::{Change, record};
use super::errors::{closed, copy_of, failed, no_camera};
use super::idempotency::{IdempotencyRecord, insert_answer};
use super::sample_retention::delete_oldest;
use super::sample_table::{Insert, Row, SampleTable, delete_replaced, delete_stored, keep_last, statements};
use super::space::Space;
use super::writer::{Growth, Writer, WriterGuard};
use crate::domain::{
    Actor, AuditAction, CameraId, CameraKey, Durability, Error, OnConflict, Result, SampleOverflow,
    StoredSample,
};

/// A transaction takes no further caller beyond so many rows.
const ROWS_PER_TRANSACTION: usize = 4_096;

/// Rows that wait or are being committed; further callers wait to queue theirs.
const ROWS_IN_FLIGHT: u32 = 65_536;

/// Callers that wait; each has at least one row, so more never wait.
const QUEUE: usize = 16_384;

/// What became of the samples of one call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Inserted {
    /// Stored now.
    pub accepted: u64,
    /// Stored before, under the same camera, target and time.
    pub duplicate: u64,
    /// Of the accepted ones, those without a fix.
    pub without_fix: u64,
    /// Of the accepted ones, those that took the place of a stored sample on request.
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
    /// What becomes of samples that are stored already.
    pub on_conflict: OnConflict,
    /// For the last batch of an import that its client may repeat.
    pub completion: Option<Completion>,
    /// The time now.
    pub now: Timestamp,
}

impl From<Durability> for InsertOptions {
    /// A batch of which nothing is recorded.
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

struct SampleBatch {
    camera: CameraId,
    /// The camera must still be this one; `None` for whichever has the id.
    key: Option<CameraKey>,
    samples: Vec<StoredSample>,
    options: InsertOptions,
    /// Samples that were left out because a later one of the batch takes their place.
    repeated: u64,
    /// On whose behalf.
    actor: Arc<Actor>,
    reply: oneshot::Sender<Result<Inserted>>,
    /// Limits the rows in flight; released when the batch is done.
    _permit: OwnedSemaphorePermit,
}

impl GroupCommit {
    pub(super) fn start(writer: Arc<Writer>, space: Arc<Space>) -> Self {
        let (queue, requests) = mpsc::channel(QUEUE);
        tokio::spawn(run(writer, space, requests));
        Self { queue, rows: Arc::new(Semaphore::new(ROWS_IN_FLIGHT as usize)) }
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

async fn run(writer: Arc<Writer>, space: Arc<Space>, mut requests: mpsc::Receiver<WriteRequest>) {
    while let Some(first) = requests.recv().await {
        // The writer first: batches that are queued while it is locked for another change join the group.
        let guard = writer.lock(Durability::default(), Growth::Limited).await;
        let (group, end) = gather(first, &mut requests);
        match guard {
            Ok(mut guard) => {
                guard.set_durability(durability_of(&group));
                for group in transactions(group) {
                    answer_all(&mut guard, &space, group).await;
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
    fn replaces(&self) -> bool {
        self.options.on_conflict == OnConflict::Replace
    }
}

/// What is in the queue now, up to the rows of one transaction.
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
async fn answer_all(guard: &mut WriterGuard<'_>, space: &Space, group: Vec<SampleBatch>) {
    match commit(guard, space, &group).await {
        Ok(outcomes) => {
            for (batch, outcome) in group.into_iter().zip(outcomes) {
                // A cancelled caller needs no answer.
                let _ = batch.reply.send(outcome);
            }
        }
        Err(Failure::Statement(_)) if group.len() > 1 => {
            for batch in group {
                let alone = commit(guard, space, std::slice::from_ref(&batch)).await;
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

enum Failure {
    /// A statement failed; the group's other callers may do better.
    Statement(Error),
    /// The transaction could not begin or commit; nobody would do better.
    Transaction(Error),
}

/// One transaction for all batches, with an outcome for each, in their order.
async fn commit(
    guard: &mut WriterGuard<'_>,
    space: &Space,
    group: &[SampleBatch],
) -> Result<Vec<Result<Inserted>>, Failure> {
    let committed = try_commit(guard, space, group).await;
    match &committed {
        Ok(outcomes) => space
            .stored(outcomes.iter().flatten().map(|inserted| inserted.accepted - inserted.replaced).sum()),
        Err(Failure::Statement(error) | Failure::Transaction(error)) => space.failed(error),
    }
    committed
}

async fn try_commit(
    guard: &mut WriterGuard<'_>,
    space: &Space,
    group: &[SampleBatch],
) -> Result<Vec<Result<Inserted>>, Failure> {
    for counting in [Counting::Together, Counting::Apart] {
        let mut transaction = guard.begin().await.map_err(Failure::Transaction)?;
        let outcomes = store(&mut transaction, space, group, counting).await.map_err(Failure::Statement)?;
        if let Some(outcomes) = outcomes {
            if group.iter().zip(&outcomes).any(|(batch, outcome)| batch.replaces() && outcome.is_err()) {
                // What was to be replaced stays.
                return Ok(outcomes);
            }
            transaction.commit().await.map_err(|error| Failure::Transaction(failed(error)))?;
            return Ok(outcomes);
        }
        transaction.rollback().await.map_err(|error| Failure::Transaction(failed(error)))?;
    }
    Err(Failure::Statement(Error::fault("stored samples could not be counted")))
}

/// How statements and batches go together.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Counting {
    /// Statements span batches: fast, and countable as long as all rows of each are new, or none.
    Together,
    /// No statement spans batches.
    Apart,
}

/// `None` if a statement over several batches met duplicates, so that they cannot be attributed.
async fn store(
    connection: &mut SqliteConnection,
    space: &Space,
    group: &[SampleBatch],
    counting: Counting,
) -> Result<Option<Vec<Result<Inserted>>>> {
    let mut cameras = cameras_of(connection, group).await?;
    let replaced = match group {
        [batch] if batch.replaces() => replace(connection, batch, &mut cameras, space).await?,
        _ => 0,
    };
    let admitted = admit(&mut cameras, space, group);
    let mut outcomes: Vec<Result<Inserted>> = admitted
        .iter()
        .zip(group)
        .map(|(camera, batch)| {
            let begun = Inserted { replaced, duplicate: batch.repeated, ..Inserted::default() };
            camera.as_ref().map(|_| begun).map_err(copy_of)
        })
        .collect();
    // Those with a fix first: of two rows of one key, the one with a fix is stored.
    for table in [SampleTable::WithFix, SampleTable::WithoutFix] {
        let (rows, borders) = rows_of(table, group, &admitted, counting);
        if !insert(connection, table, (&rows, &borders), &mut outcomes).await? {
            return Ok(None);
        }
        if table == SampleTable::WithFix {
            let has_boxes = |key| cameras.values().any(|camera| camera.key == key && camera.without_fix > 0);
            let replaced = delete_replaced(connection, &rows, has_boxes).await?;
            for camera in cameras.values_mut() {
                camera.replaced = replaced.get(&camera.key).copied().unwrap_or_default();
            }
        }
    }
    count_stored(connection, &cameras, group, &outcomes).await?;
    if space.limits.sample_overflow == SampleOverflow::DeleteOldest {
        for camera in cameras.values() {
            delete_oldest(connection, camera.key, space.limits.samples_per_camera).await?;
        }
    }
    complete(connection, space, group, &outcomes).await?;
    Ok(Some(outcomes))
}

/// Deletes the stored samples whose place those of a batch take; returns how many.
async fn replace(
    connection: &mut SqliteConnection,
    batch: &SampleBatch,
    cameras: &mut HashMap<String, Known>,
    space: &Space,
) -> Result<u64> {
    let Some(camera) = cameras.get_mut(batch.camera.as_str()) else { return Ok(0) };
    let with_fix = delete_stored(connection, SampleTable::WithFix, camera.key, &batch.samples).await?;
    let without_fix = delete_stored(connection, SampleTable::WithoutFix, camera.key, &batch.samples).await?;
    let replaced = with_fix + without_fix;
    camera.samples = camera.samples.saturating_sub(replaced);
    camera.without_fix = camera.without_fix.saturating_sub(without_fix);
    if replaced > 0 {
        let subject = Some(format!("{replaced} samples"));
        let change = Change::of_camera(AuditAction::SamplesReplaced, &batch.camera, subject);
        record(connection, (&batch.actor, &space.limits), change, batch.options.now).await?;
    }
    Ok(replaced)
}

/// Stores the answers of the imports that end with a batch of the group.
async fn complete(
    connection: &mut SqliteConnection,
    space: &Space,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    for (batch, outcome) in group.iter().zip(outcomes) {
        if let (Some(Completion { record, answer }), Ok(inserted)) = (&batch.options.completion, outcome) {
            let (actor, now) = (&*batch.actor, batch.options.now);
            insert_answer(connection, &space.limits, (actor, record), &answer(inserted), now).await?;
        }
    }
    Ok(())
}

/// The key of each batch's camera, or why the batch is not stored.
fn admit(cameras: &mut HashMap<String, Known>, space: &Space, group: &[SampleBatch]) -> Vec<Result<i64>> {
    let mut quota = space.quota();
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
fn rows_of<'a>(
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

/// Inserts rows into a table and counts them; false if duplicates cannot be attributed to their batches.
async fn insert(
    connection: &mut SqliteConnection,
    table: SampleTable,
    (rows, borders): (&[Row<'_>], &[usize]),
    outcomes: &mut [Result<Inserted>],
) -> Result<bool> {
    let statements = statements(borders);
    let mut next = statements.first().map(|range| Insert::of(table, &rows[range.clone()])).transpose()?;
    for (index, range) in statements.iter().enumerate() {
        let Some(insert) = next.take() else { break };
        // The next statement's values are bound while the database executes this one.
        let following =
            async { statements.get(index + 1).map(|range| Insert::of(table, &rows[range.clone()])) };
        let (accepted, following) = tokio::join!(insert.execute(connection), following);
        if !count(outcomes, &rows[range.clone()], accepted?) {
            return Ok(false);
        }
        next = following.transpose()?;
    }
    Ok(true)
}

/// Adds a statement's count to its batches; false if its duplicates cannot be attributed to one.
fn count(outcomes: &mut [Result<Inserted>], rows: &[Row<'_>], accepted: u64) -> bool {
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
struct Known {
    key: i64,
    /// Samples stored, and those of the group that are admitted.
    samples: u64,
    /// Samples without a fix that are stored.
    without_fix: u64,
    /// Of these, those whose place samples of the group have taken.
    replaced: u64,
}

/// The cameras of a group by their ids, read in its own transaction, so that none can vanish before
/// the commit. One statement for all, since a round trip costs as much as several rows.
async fn cameras_of(
    connection: &mut SqliteConnection,
    group: &[SampleBatch],
) -> Result<HashMap<String, Known>> {
    let mut ids: Vec<&str> = group.iter().map(|batch| batch.camera.as_str()).collect();
    ids.sort_unstable();
    ids.dedup();
    let ids = serde_json::to_string(&ids).map_err(Error::fault)?;
    let cameras: Vec<(String, i64, i64, i64)> = sqlx::query_as(
        "SELECT id, key, coalesce(samples, 0), coalesce(without_fix, 0) \
         FROM cameras LEFT JOIN sample_counts ON camera_key = key WHERE id IN (SELECT value FROM json_each(?))",
    )
    .bind(ids)
    .fetch_all(connection)
    .await
    .map_err(failed)?;
    let known = |(id, key, with_fix, without_fix)| {
        let (with_fix, without_fix) = (as_count(with_fix), as_count(without_fix));
        (id, Known { key, samples: with_fix + without_fix, without_fix, replaced: 0 })
    };
    Ok(cameras.into_iter().map(known).collect())
}

fn as_count(stored: i64) -> u64 {
    u64::try_from(stored).unwrap_or_default()
}

/// Adds what a group has stored to the counts of its cameras, in one statement.
async fn count_stored(
    connection: &mut SqliteConnection,
    cameras: &HashMap<String, Known>,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    // Per camera: added with a fix, added without, replaced.
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
    if changes.is_empty() {
        return Ok(());
    }
    // WHERE true: without it the grammar takes ON CONFLICT for the condition of a join.
    sqlx::query(
        "INSERT INTO sample_counts (camera_key, samples, without_fix) \
         SELECT CAST(key AS INTEGER), value ->> 0, (value ->> 1) - (value ->> 2) FROM json_each(?) WHERE true \
         ON CONFLICT (camera_key) DO UPDATE SET samples = samples + excluded.samples, \
         without_fix = max(without_fix + excluded.without_fix, 0)",
    )
    .bind(serde_json::to_string(&changes).map_err(Error::fault)?)
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}
