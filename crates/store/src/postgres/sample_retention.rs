//! The oldest samples are deleted, where the operator has chosen so: beyond a number for each camera, or an age.

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, PgConnection};

use super::errors::failed;
use super::sample_table::subtract;
use super::{Store, database_now_us};
use crate::domain::{Error, Result};
use crate::rows::samples::{NEWEST_TIME, SampleTable};

/// Beyond its limit a camera is cut to this share of it, so that not every import deletes.
const KEPT_PER_MILLE: u64 = 990;
/// Rows of one camera that a transaction deletes by age.
const BATCH: i64 = 10_000;

impl Store {
    pub(crate) async fn newest_sample(&self) -> Result<Option<Timestamp>> {
        let mut reader = self.reader().await?;
        let newest_us: Option<i64> =
            sqlx::query_scalar(NEWEST_TIME).fetch_one(&mut *reader).await.map_err(failed)?;
        newest_us.map(Timestamp::from_microsecond).transpose().map_err(Error::fault)
    }

    /// The processes of a database agree on its server's clock, not on their own.
    pub(crate) async fn time(&self, _now: Timestamp) -> Result<Timestamp> {
        let mut reader = self.reader().await?;
        let now_us: i64 = sqlx::query_scalar(concat!("SELECT ", database_now_us!()))
            .fetch_one(&mut *reader)
            .await
            .map_err(failed)?;
        Timestamp::from_microsecond(now_us).map_err(Error::fault)
    }
}

/// Deletes the oldest samples of a camera that has more than `limit`. Samples of one instant stay or go together.
pub(super) async fn delete_oldest(connection: &mut PgConnection, camera_key: i64, limit: u64) -> Result<()> {
    let stored: Option<i64> =
        sqlx::query_scalar("SELECT samples + without_fix FROM sample_counts WHERE camera_key = $1")
            .bind(camera_key)
            .fetch_optional(&mut *connection)
            .await
            .map_err(failed)?;
    let stored = stored.map_or(0, i64::unsigned_abs);
    if stored <= limit {
        return Ok(());
    }
    let kept = limit - limit * (1_000 - KEPT_PER_MILLE) / 1_000;
    let newest_deleted_us =
        oldest_time(connection, camera_key, i64::MAX, i64::try_from(stored - kept).unwrap_or(i64::MAX))
            .await?;
    let Some(newest_deleted_us) = newest_deleted_us else { return Ok(()) };
    delete_upto(connection, camera_key, newest_deleted_us).await?;
    Ok(())
}

/// Deletes the oldest samples of a camera from before an instant, some ten thousand at most; returns how many.
pub(super) async fn delete_batch(
    connection: &mut PgConnection,
    camera_key: i64,
    before_us: i64,
) -> Result<u64> {
    let newest_of_batch_us = oldest_time(connection, camera_key, before_us, BATCH).await?;
    delete_upto(connection, camera_key, newest_of_batch_us.unwrap_or(before_us - 1)).await
}

/// Time of the sample of a camera that has one less than `count` before it, of those before an instant. Each table is read
/// in the order of its primary key, and no further than needed.
async fn oldest_time(
    connection: &mut PgConnection,
    camera_key: i64,
    before_us: i64,
    count: i64,
) -> Result<Option<i64>> {
    let oldest = SampleTable::ALL.map(|table| {
        format!(
            "(SELECT time_us FROM {table} WHERE camera_key = $1 AND time_us < $2 ORDER BY time_us LIMIT $3)"
        )
    });
    let sql = format!("{} ORDER BY time_us LIMIT 1 OFFSET $3 - 1", oldest.join(" UNION ALL "));
    sqlx::query_scalar(AssertSqlSafe(sql))
        .bind(camera_key)
        .bind(before_us)
        .bind(count)
        .fetch_optional(connection)
        .await
        .map_err(failed)
}

/// Deletes the samples of a camera up to an instant, and counts them no more; returns how many.
async fn delete_upto(connection: &mut PgConnection, camera_key: i64, newest_deleted_us: i64) -> Result<u64> {
    let mut all = 0;
    for table in SampleTable::ALL {
        let sql = format!("DELETE FROM {table} WHERE camera_key = $1 AND time_us <= $2");
        let deleted = sqlx::query(AssertSqlSafe(sql))
            .bind(camera_key)
            .bind(newest_deleted_us)
            .execute(&mut *connection)
            .await
            .map_err(failed)?
            .rows_affected();
        subtract(connection, table, camera_key, deleted).await?;
        all += deleted;
    }
    Ok(all)
}
