//! One transaction for the samples of a group.

use std::collections::HashMap;
use std::sync::Arc;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use sqlx::pool::PoolConnection;
use sqlx::{Connection as _, PgConnection, PgPool, Postgres};

use super::connection::begin_write_statement;
use super::errors::{Attempts, failed};
use super::sample_table::{delete_replaced, delete_stored, insert};
use crate::domain::{AuditAction, Durability, Error, Result, SampleOverflow};
use crate::group_commit::{
    Committing, Completion, Counting, Failure, Inserted, Known, SampleBatch, SampleWriter, WriteSession,
    admit, as_count, changed_counts, count, must_roll_back, note, outcomes_before, rows_of,
};
use crate::limits::Usage;
use crate::rows::audit::Change;
use crate::rows::samples::{Row, SampleTable};
use crate::statements::audit::record;
use crate::statements::idempotency::insert_answer;
use crate::statements::sample_retention::delete_oldest;

/// Stores samples through the pool.
pub(super) struct GroupWriter {
    pub(super) pool: PgPool,
    pub(super) usage: Arc<Usage>,
}

impl SampleWriter for GroupWriter {
    fn session(&self) -> BoxFuture<'_, Result<Box<dyn WriteSession + '_>>> {
        async move {
            let connection = self.pool.acquire().await.map_err(failed)?;
            Ok(Box::new(Session { connection, usage: &self.usage }) as Box<dyn WriteSession + '_>)
        }
        .boxed()
    }
}

struct Session<'w> {
    connection: PoolConnection<Postgres>,
    usage: &'w Usage,
}

impl WriteSession for Session<'_> {
    fn commit<'a>(&'a mut self, durability: Durability, group: &'a [SampleBatch]) -> Committing<'a> {
        async move {
            let mut attempts = Attempts::default();
            let committed = loop {
                let committed = try_commit(&mut self.connection, self.usage, durability, group).await;
                if !attempts.again(committed.as_ref().err().map(Failure::error)).await {
                    break committed;
                }
            };
            note(self.usage, &committed);
            committed
        }
        .boxed()
    }
}

async fn try_commit(
    connection: &mut PgConnection,
    usage: &Usage,
    durability: Durability,
    group: &[SampleBatch],
) -> Result<Vec<Result<Inserted>>, Failure> {
    for counting in [Counting::Together, Counting::Apart] {
        let mut transaction = connection
            .begin_with(begin_write_statement(durability))
            .await
            .map_err(|error| Failure::Transaction(failed(error)))?;
        let outcomes = store(&mut transaction, usage, group, counting).await.map_err(Failure::Statement)?;
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
    connection: &mut PgConnection,
    usage: &Usage,
    group: &[SampleBatch],
    counting: Counting,
) -> Result<Option<Vec<Result<Inserted>>>> {
    let mut cameras = cameras_of(connection, group).await?;
    let replaced = match group {
        [batch] if batch.replaces() => replace(connection, batch, &mut cameras, usage).await?,
        _ => 0,
    };
    let admitted = admit(&mut cameras, usage, group);
    let mut outcomes = outcomes_before(&admitted, group, replaced);
    // Those with a fix first: of two rows of one key, the one with a fix is stored.
    for table in SampleTable::ALL {
        let (rows, borders) = rows_of(table, group, &admitted, counting);
        if !insert_all(connection, table, (&rows, &borders), &mut outcomes).await? {
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
    if usage.limits.sample_overflow == SampleOverflow::DeleteOldest {
        for camera in cameras.values() {
            delete_oldest(connection, camera.key, usage.limits.samples_per_camera).await?;
        }
    }
    complete(connection, usage, group, &outcomes).await?;
    Ok(Some(outcomes))
}

/// Deletes the stored samples whose place those of a batch take; returns how many.
async fn replace(
    connection: &mut PgConnection,
    batch: &SampleBatch,
    cameras: &mut HashMap<String, Known>,
    usage: &Usage,
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
        record(connection, (&batch.actor, &usage.limits), change, batch.options.now).await?;
    }
    Ok(replaced)
}

/// Stores the answers of the imports that end with a batch of the group.
async fn complete(
    connection: &mut PgConnection,
    usage: &Usage,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    for (batch, outcome) in group.iter().zip(outcomes) {
        if let (Some(Completion { record, answer }), Ok(inserted)) = (&batch.options.completion, outcome) {
            let (actor, now) = (&*batch.actor, batch.options.now);
            insert_answer(connection, &usage.limits, (actor, record), &answer(inserted), now).await?;
        }
    }
    Ok(())
}

/// Inserts rows into a table and counts them, a statement up to each border; false if duplicates cannot be attributed
/// to their batches.
async fn insert_all(
    connection: &mut PgConnection,
    table: SampleTable,
    (rows, borders): (&[Row<'_>], &[usize]),
    outcomes: &mut [Result<Inserted>],
) -> Result<bool> {
    let mut start = 0;
    for &border in borders {
        let rows = &rows[start..border];
        start = border;
        let accepted = insert(connection, table, rows).await?;
        if !rows.is_empty() && !count(outcomes, rows, accepted) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The cameras of a group by their ids, locked in the order of their keys, so that none can vanish before the commit,
/// and two groups that share cameras follow one after another.
async fn cameras_of(connection: &mut PgConnection, group: &[SampleBatch]) -> Result<HashMap<String, Known>> {
    let mut ids: Vec<&str> = group.iter().map(|batch| batch.camera.as_str()).collect();
    ids.sort_unstable();
    ids.dedup();
    let locked: Vec<(String, i64)> =
        sqlx::query_as("SELECT id, key FROM cameras WHERE id = ANY($1) ORDER BY key FOR NO KEY UPDATE")
            .bind(ids)
            .fetch_all(&mut *connection)
            .await
            .map_err(failed)?;
    // A statement of its own: the one that waited for the locks sees what was stored before it began to wait.
    let counts: Vec<(i64, i64, i64)> = sqlx::query_as(
        "SELECT camera_key, samples, without_fix FROM sample_counts WHERE camera_key = ANY($1)",
    )
    .bind(locked.iter().map(|(_, key)| *key).collect::<Vec<_>>())
    .fetch_all(connection)
    .await
    .map_err(failed)?;
    let known = |(id, key): (String, i64)| {
        let counted = counts.iter().find(|counted| counted.0 == key);
        let (with_fix, without_fix) = counted.map_or((0, 0), |count| (as_count(count.1), as_count(count.2)));
        (id, Known { key, samples: with_fix + without_fix, without_fix, replaced: 0 })
    };
    Ok(locked.into_iter().map(known).collect())
}

/// Adds what a group has stored to the counts of its cameras, in one statement.
async fn count_stored(
    connection: &mut PgConnection,
    cameras: &HashMap<String, Known>,
    group: &[SampleBatch],
    outcomes: &[Result<Inserted>],
) -> Result<()> {
    let changes = changed_counts(cameras, group, outcomes);
    if changes.is_empty() {
        return Ok(());
    }
    let signed = |count: u64| i64::try_from(count).unwrap_or(i64::MAX);
    let (mut keys, mut with_fix, mut without_fix) = (Vec::new(), Vec::new(), Vec::new());
    for (key, [added, boxes, replaced]) in changes {
        keys.push(key);
        with_fix.push(signed(added));
        without_fix.push(signed(boxes) - signed(replaced));
    }
    sqlx::query(
        "INSERT INTO sample_counts (camera_key, samples, without_fix) \
         SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::BIGINT[]) \
         ON CONFLICT (camera_key) DO UPDATE SET samples = sample_counts.samples + excluded.samples, \
         without_fix = GREATEST(sample_counts.without_fix + excluded.without_fix, 0)",
    )
    .bind(keys)
    .bind(with_fix)
    .bind(without_fix)
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}
