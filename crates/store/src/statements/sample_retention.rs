//! Deletion of the oldest samples of a camera, which are subtracted from the counts.

use sqlx::AssertSqlSafe;

use super::sample_counts::subtract;
use crate::domain::Result;
use crate::query::{Session, query, query_scalar};
use crate::rows::samples::{SampleTable, ordered_union};

/// Beyond its limit a camera is cut to this share of it, so that not every import deletes.
const KEPT_PER_MILLE: u64 = 990;
/// Rows of one camera that a transaction deletes by age.
const BATCH: i64 = 10_000;

/// Deletes the oldest samples of a camera that has more than `limit`. Samples of one instant stay or go together.
pub(crate) async fn delete_oldest(session: &mut dyn Session, camera_key: i64, limit: u64) -> Result<()> {
    let stored: Option<i64> =
        query_scalar("SELECT samples + without_fix FROM sample_counts WHERE camera_key = $1")
            .bind(camera_key)
            .fetch_optional(session)
            .await?;
    let stored = stored.map_or(0, i64::unsigned_abs);
    if stored <= limit {
        return Ok(());
    }
    let kept = limit - limit * (1_000 - KEPT_PER_MILLE) / 1_000;
    let excess = i64::try_from(stored - kept).unwrap_or(i64::MAX);
    let newest_deleted_us = oldest_time(session, camera_key, i64::MAX, excess).await?;
    let Some(newest_deleted_us) = newest_deleted_us else { return Ok(()) };
    delete_upto(session, camera_key, newest_deleted_us).await?;
    Ok(())
}

/// Deletes the oldest samples of a camera from before an instant, some ten thousand at most; returns how many.
pub(crate) async fn delete_batch(session: &mut dyn Session, camera_key: i64, before_us: i64) -> Result<u64> {
    let newest_of_batch_us = oldest_time(session, camera_key, before_us, BATCH).await?;
    delete_upto(session, camera_key, newest_of_batch_us.unwrap_or(before_us - 1)).await
}

/// Time of the sample of a camera that has one less than `count` before it, of those before an instant. Each table is
/// read in the order of its primary key, and no further than needed.
async fn oldest_time(
    session: &mut dyn Session,
    camera_key: i64,
    before_us: i64,
    count: i64,
) -> Result<Option<i64>> {
    let oldest = SampleTable::ALL.map(|table| {
        format!(
            "SELECT time_us FROM {table} WHERE camera_key = $1 AND time_us < $2 ORDER BY time_us LIMIT $3"
        )
    });
    let sql = ordered_union(&oldest, "ORDER BY time_us LIMIT 1 OFFSET $3 - 1");
    query_scalar(AssertSqlSafe(sql))
        .bind(camera_key)
        .bind(before_us)
        .bind(count)
        .fetch_optional(session)
        .await
}

/// Deletes the samples of a camera up to an instant, and subtracts them from the counts; returns how many.
async fn delete_upto(session: &mut dyn Session, camera_key: i64, newest_deleted_us: i64) -> Result<u64> {
    let mut all = 0;
    for table in SampleTable::ALL {
        let sql = format!("DELETE FROM {table} WHERE camera_key = $1 AND time_us <= $2");
        let delete = query(AssertSqlSafe(sql)).bind(camera_key).bind(newest_deleted_us);
        let deleted = delete.execute(session).await?;
        subtract(session, table, camera_key, deleted).await?;
        all += deleted;
    }
    Ok(all)
}
