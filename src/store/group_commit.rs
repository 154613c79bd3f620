//! Group commit of samples: one task commits what many callers have queued in one transaction.
//!
//! A commit costs much more than a row, so every batch that is queued when a transaction begins joins
//! it. Nothing is acknowledged before its commit, and a caller's batch is stored atomically.
//! What never happens here: a caller waits for more callers to come, the queue grows without bound, a
//! cancelled caller disturbs the others.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, LazyLock};

use sqlx::sqlite::SqliteArguments;
use sqlx::{Arguments, AssertSqlSafe, SqliteConnection};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};

use super::errors::{closed, copy_of, failed, no_camera};
use super::space::Space;
use super::writer::{Growth, Writer, WriterGuard};
use crate::domain::{CameraId, CameraKey, Durability, Error, Result, Sample};

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
}

/// Queues batches for the task.
pub(super) struct GroupCommit {
    queue: mpsc::Sender<Request>,
    rows: Arc<Semaphore>,
}

enum Request {
    Insert(Batch),
    /// Everything queued before is committed, then the task ends.
    End(oneshot::Sender<()>),
}

struct Batch {
    camera: CameraId,
    /// The camera must still be this one; `None` for whichever has the id.
    key: Option<CameraKey>,
    samples: Vec<Sample>,
    durability: Durability,
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
        camera: CameraId,
        key: Option<CameraKey>,
        samples: Vec<Sample>,
        durability: Durability,
    ) -> Result<Inserted> {
        let rows = u32::try_from(samples.len()).unwrap_or(u32::MAX).clamp(1, ROWS_IN_FLIGHT);
        let permit = Arc::clone(&self.rows).acquire_many_owned(rows).await.map_err(|_| closed())?;
        let (reply, answer) = oneshot::channel();
        let batch = Batch { camera, key, samples, durability, reply, _permit: permit };
        self.queue.send(Request::Insert(batch)).await.map_err(|_| self.task_ended())?;
        answer.await.map_err(|_| self.task_ended())?
    }

    pub(super) async fn close(&self) {
        self.rows.close();
        let (ended, end) = oneshot::channel();
        if self.queue.send(Request::End(ended)).await.is_ok() {
            // An error means that the task has ended already, which is what is waited for.
            let _ = end.await;
        }
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

async fn run(writer: Arc<Writer>, space: Arc<Space>, mut requests: mpsc::Receiver<Request>) {
    while let Some(first) = requests.recv().await {
        // The writer first: batches that are queued while it is locked for another change join the group.
        let guard = writer.lock(Durability::default(), Growth::Limited).await;
        let (group, end) = gather(first, &mut requests);
        match guard {
            Ok(mut guard) => {
                guard.set_durability(durability_of(&group));
                answer_all(&mut guard, &space, group).await;
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
fn durability_of(group: &[Batch]) -> Durability {
    group.iter().map(|batch| batch.durability).max().unwrap_or_default()
}

/// What is in the queue now, up to the rows of one transaction.
fn gather(
    first: Request,
    requests: &mut mpsc::Receiver<Request>,
) -> (Vec<Batch>, Option<oneshot::Sender<()>>) {
    let mut group = Vec::new();
    let mut rows = 0;
    let mut next = Some(first);
    while let Some(request) = next {
        match request {
            Request::Insert(batch) => {
                rows += batch.samples.len();
                group.push(batch);
            }
            Request::End(ended) => return (group, Some(ended)),
        }
        next = if rows < ROWS_PER_TRANSACTION { requests.try_recv().ok() } else { None };
    }
    (group, None)
}

/// Commits a group and answers each of its callers. If it cannot be stored together, each is tried
/// alone, so that one bad row fails nobody but its caller.
async fn answer_all(guard: &mut WriterGuard<'_>, space: &Space, group: Vec<Batch>) {
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

fn refuse_all(group: Vec<Batch>, error: &Error) {
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
    group: &[Batch],
) -> Result<Vec<Result<Inserted>>, Failure> {
    let committed = try_commit(guard, space, group).await;
    match &committed {
        Ok(outcomes) => space.stored(outcomes.iter().flatten().map(|inserted| inserted.accepted).sum()),
        Err(Failure::Statement(error) | Failure::Transaction(error)) => space.failed(error),
    }
    committed
}

async fn try_commit(
    guard: &mut WriterGuard<'_>,
    space: &Space,
    group: &[Batch],
) -> Result<Vec<Result<Inserted>>, Failure> {
    for counting in [Counting::Together, Counting::Apart] {
        let mut transaction = guard.begin().await.map_err(Failure::Transaction)?;
        let outcomes = store(&mut transaction, space, group, counting).await.map_err(Failure::Statement)?;
        if let Some(outcomes) = outcomes {
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

/// A row with the batch it came from and the key of its camera.
struct Row<'a> {
    batch: usize,
    camera_key: i64,
    sample: &'a Sample,
}

/// `None` if a statement over several batches met duplicates, so that they cannot be attributed.
async fn store(
    connection: &mut SqliteConnection,
    space: &Space,
    group: &[Batch],
    counting: Counting,
) -> Result<Option<Vec<Result<Inserted>>>> {
    let mut cameras = cameras_of(connection, group).await?;
    let mut quota = space.quota();
    let mut outcomes: Vec<Result<Inserted>> = Vec::with_capacity(group.len());
    let mut rows = Vec::with_capacity(group.iter().map(|batch| batch.samples.len()).sum());
    let mut borders = Vec::new();
    for (index, batch) in group.iter().enumerate() {
        let camera = cameras
            .get_mut(batch.camera.as_str())
            .filter(|camera| batch.key.is_none_or(|key| key == CameraKey(camera.key)));
        let admitted = match camera {
            Some(camera) => quota
                .admit(&batch.camera, &mut camera.samples, batch.samples.len() as u64)
                .map(|()| camera.key),
            None => Err(no_camera(&batch.camera)),
        };
        if let Ok(camera_key) = admitted {
            rows.extend(batch.samples.iter().map(|sample| Row { batch: index, camera_key, sample }));
        }
        outcomes.push(admitted.map(|_| Inserted::default()));
        if counting == Counting::Apart {
            borders.push(rows.len());
        }
    }
    borders.push(rows.len());
    let statements = statements(&borders);
    let mut next = statements.first().map(|range| Insert::of(&rows[range.clone()])).transpose()?;
    for (index, range) in statements.iter().enumerate() {
        let Some(insert) = next.take() else { break };
        // The next statement's values are bound while the database executes this one.
        let following = async { statements.get(index + 1).map(|range| Insert::of(&rows[range.clone()])) };
        let (accepted, following) = tokio::join!(insert.execute(connection), following);
        if !count(&mut outcomes, &rows[range.clone()], accepted?) {
            return Ok(None);
        }
        next = following.transpose()?;
    }
    count_stored(connection, &cameras, group, &outcomes).await?;
    Ok(Some(outcomes))
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
    }
}

/// A camera of a group.
struct Known {
    key: i64,
    /// Samples stored, and those of the group that are admitted.
    samples: u64,
}

/// The cameras of a group by their ids, read in its own transaction, so that none can vanish before
/// the commit. One statement for all, since a round trip costs as much as several rows.
async fn cameras_of(connection: &mut SqliteConnection, group: &[Batch]) -> Result<HashMap<String, Known>> {
    let mut ids: Vec<&str> = group.iter().map(|batch| batch.camera.as_str()).collect();
    ids.sort_unstable();
    ids.dedup();
    let ids = serde_json::to_string(&ids).map_err(Error::fault)?;
    let cameras: Vec<(String, i64, i64)> = sqlx::query_as(
        "SELECT id, key, coalesce(samples, 0) FROM cameras LEFT JOIN sample_counts ON camera_key = key \
         WHERE id IN (SELECT value FROM json_each(?))",
    )
    .bind(ids)
    .fetch_all(connection)
    .await
    .map_err(failed)?;
    let known = |(id, key, samples)| (id, Known { key, samples: u64::try_from(samples).unwrap_or_default() });
    Ok(cameras.into_iter().map(known).collect())
}

/// Adds what a group has stored to the counts of its cameras, in one statement.
async fn count_stored(
    connection: &mut SqliteConnection,
    cameras: &HashMap<String, Known>,
    group: &[Batch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    let mut accepted: HashMap<i64, u64> = HashMap::new();
    for (batch, outcome) in group.iter().zip(outcomes) {
        if let (Ok(inserted), Some(camera)) = (outcome, cameras.get(batch.camera.as_str()))
            && inserted.accepted > 0
        {
            *accepted.entry(camera.key).or_default() += inserted.accepted;
        }
    }
    if accepted.is_empty() {
        return Ok(());
    }
    // WHERE true: without it the grammar takes ON CONFLICT for the condition of a join.
    sqlx::query(
        "INSERT INTO sample_counts (camera_key, samples) SELECT CAST(key AS INTEGER), value FROM json_each(?) \
         WHERE true ON CONFLICT (camera_key) DO UPDATE SET samples = samples + excluded.samples",
    )
    .bind(serde_json::to_string(&accepted).map_err(Error::fault)?)
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}

/// Columns bound per row.
const COLUMNS: usize = 14;

/// Rows per statement, largest first. Few sizes, so that each stays prepared.
const SIZES: [usize; 6] = [1000, 250, 50, 10, 3, 1];

static INSERTS: LazyLock<[Arc<str>; SIZES.len()]> = LazyLock::new(|| {
    SIZES.map(|rows| {
        let row = format!("({})", vec!["?"; COLUMNS].join(","));
        let sql = format!(
            "INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
             longitude_deg, latitude_deg, sigma_m, class, score, truth_longitude_deg, truth_latitude_deg) \
             VALUES {} ON CONFLICT DO NOTHING",
            vec![row; rows].join(",")
        );
        sql.into()
    })
});

/// Splits the ranges between borders into statements of the available sizes.
fn statements(borders: &[usize]) -> Vec<Range<usize>> {
    let mut ranges = Vec::new();
    let mut start = 0;
    for &border in borders {
        for size in SIZES {
            while border - start >= size {
                ranges.push(start..start + size);
                start += size;
            }
        }
    }
    ranges
}

/// One statement for as many rows as one of the sizes, with its values.
struct Insert {
    sql: Arc<str>,
    arguments: SqliteArguments,
}

impl Insert {
    fn of(rows: &[Row<'_>]) -> Result<Self> {
        let size = SIZES.iter().position(|&size| size == rows.len());
        let size = size.ok_or_else(|| Error::fault("a statement of an unknown size"))?;
        let mut arguments = SqliteArguments::default();
        arguments.reserve(rows.len() * COLUMNS, 0);
        for row in rows {
            bind(&mut arguments, row).map_err(Error::fault)?;
        }
        Ok(Self { sql: Arc::clone(&INSERTS[size]), arguments })
    }

    /// Returns how many rows were new.
    async fn execute(self, connection: &mut SqliteConnection) -> Result<u64> {
        let query = sqlx::query_with(AssertSqlSafe(self.sql), self.arguments);
        Ok(query.execute(connection).await.map_err(failed)?.rows_affected())
    }
}

fn bind(arguments: &mut SqliteArguments, row: &Row<'_>) -> Result<(), sqlx::error::BoxDynError> {
    let sample = row.sample;
    arguments.add(row.camera_key)?;
    arguments.add(sample.time.as_microsecond())?;
    arguments.add(sample.target_id.as_str())?;
    for side_px in sample.bounding_box.sides_px() {
        arguments.add(side_px)?;
    }
    arguments.add(sample.fix.position.longitude_deg())?;
    arguments.add(sample.fix.position.latitude_deg())?;
    arguments.add(sample.fix.sigma_m.map(crate::domain::SigmaM::metres))?;
    arguments.add(sample.class.as_ref().map(crate::domain::TargetClass::as_str))?;
    arguments.add(sample.score.map(crate::domain::Score::value))?;
    arguments.add(sample.truth.map(crate::geo::Position::longitude_deg))?;
    arguments.add(sample.truth.map(crate::geo::Position::latitude_deg))
}
