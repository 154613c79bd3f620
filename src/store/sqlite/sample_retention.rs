//! The oldest samples of a camera give way to new ones, where the operator has chosen so.

use sqlx::{AssertSqlSafe, SqliteConnection};

use super::errors::failed;
use crate::domain::Result;
use crate::store::rows::samples::SampleTable;

/// Beyond its limit a camera is cut to this share of it, so that not every import deletes.
const KEPT_PER_MILLE: u64 = 990;

/// Deletes the oldest samples of a camera that has more than `limit`. Samples of one instant stay or go together.
pub(super) async fn delete_oldest(
    connection: &mut SqliteConnection,
    camera_key: i64,
    limit: u64,
) -> Result<()> {
    let stored: Option<i64> =
        sqlx::query_scalar("SELECT samples + without_fix FROM sample_counts WHERE camera_key = ?")
            .bind(camera_key)
            .fetch_optional(&mut *connection)
            .await
            .map_err(failed)?;
    let stored = stored.map_or(0, i64::unsigned_abs);
    if stored <= limit {
        return Ok(());
    }
    let kept = limit - limit * (1_000 - KEPT_PER_MILLE) / 1_000;
    // Both tables are read in the order of their primary keys, and no further than needed.
    let newest_deleted_us: Option<i64> = sqlx::query_scalar(
        "SELECT time_us FROM (SELECT time_us FROM samples WHERE camera_key = ?1 \
         UNION ALL SELECT time_us FROM samples_without_fix WHERE camera_key = ?1 ORDER BY time_us) LIMIT 1 OFFSET ?2",
    )
    .bind(camera_key)
    .bind(i64::try_from(stored - kept - 1).unwrap_or(i64::MAX))
    .fetch_optional(&mut *connection)
    .await
    .map_err(failed)?;
    let Some(newest_deleted_us) = newest_deleted_us else { return Ok(()) };
    for table in [SampleTable::WithFix, SampleTable::WithoutFix] {
        let sql = format!("DELETE FROM {table} WHERE camera_key = ? AND time_us <= ?");
        let deleted = sqlx::query(AssertSqlSafe(sql))
            .bind(camera_key)
            .bind(newest_deleted_us)
            .execute(&mut *connection)
            .await
            .map_err(failed)?
            .rows_affected();
        let counter = table.counter();
        let sql = format!("UPDATE sample_counts SET {counter} = max({counter} - ?, 0) WHERE camera_key = ?");
        sqlx::query(AssertSqlSafe(sql))
            .bind(i64::try_from(deleted).unwrap_or(i64::MAX))
            .bind(camera_key)
            .execute(&mut *connection)
            .await
            .map_err(failed)?;
    }
    Ok(())
}
