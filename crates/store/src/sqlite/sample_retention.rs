//! The oldest samples are deleted, where the operator has chosen so: beyond a number for each camera, or an age.

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, SqliteConnection};

use super::Store;
use super::errors::failed;
use super::sample_table::subtract;
use crate::domain::{Error, Result};
use crate::rows::samples::{NEWEST_TIME, SampleTable, expired};

/// Beyond its limit a camera is cut to this share of it, so that not every import deletes.
const KEPT_PER_MILLE: u64 = 990;
/// Rows of one camera that a transaction deletes by age.
const BATCH: i64 = 10_000;

impl Store {
    pub(crate) async fn newest_sample(&self) -> Result<Option<Timestamp>> {
        let newest_us: Option<i64> =
            sqlx::query_scalar(NEWEST_TIME).fetch_one(self.readers()).await.map_err(failed)?;
        newest_us.map(Timestamp::from_microsecond).transpose().map_err(Error::fault)
    }

    /// A data folder has no clock but that of its process.
    pub(crate) async fn time(&self, now: Timestamp) -> Result<Timestamp> {
        Ok(now)
    }

    pub(crate) async fn retain_samples(&self, since: Option<Timestamp>, now: Timestamp) -> Result<u64> {
        let Some(since) = since else { return Ok(0) };
        let before_us = since.as_microsecond();
        let cameras: Vec<i64> = sqlx::query_scalar(
            "SELECT camera_key FROM sample_counts AS counts WHERE EXISTS (SELECT 1 FROM samples \
             WHERE samples.camera_key = counts.camera_key AND time_us < ?1) \
             OR EXISTS (SELECT 1 FROM samples_without_fix AS boxes WHERE boxes.camera_key = counts.camera_key \
             AND time_us < ?1) ORDER BY camera_key",
        )
        .bind(before_us)
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        let mut deleted = 0;
        for camera_key in cameras {
            loop {
                let mut deletion = self.deletion().await?;
                let mut transaction = deletion.begin().await?;
                let rows = delete_batch(&mut transaction, camera_key, before_us).await?;
                if deleted == 0 && rows > 0 {
                    self.record(&mut transaction, expired(since), now).await?;
                }
                transaction.commit().await.map_err(failed)?;
                deletion.reclaim().await;
                if rows == 0 {
                    break;
                }
                deleted += rows;
            }
        }
        Ok(deleted)
    }
}

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
    delete_upto(connection, camera_key, newest_deleted_us).await?;
    Ok(())
}

/// Deletes the oldest samples of a camera from before an instant, some ten thousand at most; returns how many.
async fn delete_batch(connection: &mut SqliteConnection, camera_key: i64, before_us: i64) -> Result<u64> {
    let newest_of_batch_us: Option<i64> = sqlx::query_scalar(
        "SELECT time_us FROM (SELECT time_us FROM samples WHERE camera_key = ?1 AND time_us < ?2 \
         UNION ALL SELECT time_us FROM samples_without_fix WHERE camera_key = ?1 AND time_us < ?2 \
         ORDER BY time_us) LIMIT 1 OFFSET ?3",
    )
    .bind(camera_key)
    .bind(before_us)
    .bind(BATCH - 1)
    .fetch_optional(&mut *connection)
    .await
    .map_err(failed)?;
    delete_upto(connection, camera_key, newest_of_batch_us.unwrap_or(before_us - 1)).await
}

/// Deletes the samples of a camera up to an instant, and counts them no more; returns how many.
async fn delete_upto(
    connection: &mut SqliteConnection,
    camera_key: i64,
    newest_deleted_us: i64,
) -> Result<u64> {
    let mut all = 0;
    for table in SampleTable::ALL {
        let sql = format!("DELETE FROM {table} WHERE camera_key = ?1 AND time_us <= ?2");
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
