//! One transaction for the samples of a group.

use std::collections::HashMap;
use std::sync::Arc;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use sqlx::SqliteConnection;

use super::errors::failed;
use super::sample_table::{Insert, delete_replaced, delete_stored, statements};
use super::space::Space;
use super::writer::{Growth, Writer, WriterGuard};
use crate::domain::{AuditAction, Durability, Error, Result, SampleOverflow};
use crate::group_commit::{
    Committing, Completion, Counting, Failure, Inserted, Known, SampleBatch, SampleWriter, WriteSession,
    admit, as_count, changed_counts, count, must_roll_back, note, outcomes_before, rows_of,
};
use crate::rows::audit::Change;
use crate::rows::samples::{Row, SampleTable};
use crate::statements::audit::record;
use crate::statements::idempotency::insert_answer;
use crate::statements::sample_retention::delete_oldest;

/// Stores samples through the one writing connection.
pub(super) struct GroupWriter {
    pub(super) writer: Arc<Writer>,
    pub(super) space: Arc<Space>,
}

impl SampleWriter for GroupWriter {
    fn session(&self) -> BoxFuture<'_, Result<Box<dyn WriteSession + '_>>> {
        async move {
            let guard = self.writer.lock(Durability::default(), Growth::Limited).await?;
            Ok(Box::new(LockedWriter { guard, space: &self.space }) as Box<dyn WriteSession + '_>)
        }
        .boxed()
    }
}

struct LockedWriter<'w> {
    guard: WriterGuard<'w>,
    space: &'w Space,
}

impl WriteSession for LockedWriter<'_> {
    fn commit<'a>(&'a mut self, durability: Durability, group: &'a [SampleBatch]) -> Committing<'a> {
        async move {
            self.guard.set_durability(durability);
            let committed = try_commit(&mut self.guard, self.space, group).await;
            note(&self.space.usage, &committed);
            committed
        }
        .boxed()
    }
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
            if must_roll_back(group, &outcomes) {
                return Ok(outcomes);
            }
            transaction.commit().await.map_err(|error| Failure::Transaction(failed(error)))?;
            return Ok(outcomes);
        }
        transaction.rollback().await.map_err(|error| Failure::Transaction(failed(error)))?;
    }
    Err(Failure::Statement(Error::fault("stored samples could not be counted")))
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
    let admitted = admit(&mut cameras, &space.usage, group);
    let mut outcomes = outcomes_before(&admitted, group, replaced);
    // Those with a fix first: of two rows of one key, the one with a fix is stored.
    for table in SampleTable::ALL {
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
    if space.usage.limits.sample_overflow == SampleOverflow::DeleteOldest {
        for camera in cameras.values() {
            delete_oldest(connection, camera.key, space.usage.limits.samples_per_camera).await?;
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
        record(connection, (&batch.actor, &space.usage.limits), change, batch.options.now).await?;
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
            insert_answer(connection, &space.usage.limits, (actor, record), &answer(inserted), now).await?;
        }
    }
    Ok(())
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

/// Adds what a group has stored to the counts of its cameras, in one statement.
async fn count_stored(
    connection: &mut SqliteConnection,
    cameras: &HashMap<String, Known>,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    let changes = changed_counts(cameras, group, outcomes);
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
