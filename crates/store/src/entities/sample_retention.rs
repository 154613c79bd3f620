//! The oldest samples are deleted, where the operator has chosen so: beyond a number for each camera, or an age.

use jiff::Timestamp;

use crate::database::{Backend, Database};
use crate::domain::{Error, Result};
use crate::postgres::start_of_week;
use crate::query::query_scalar;
use crate::rows::samples::{NEWEST_TIME, expired};
use crate::statements::sample_retention::delete_batch;

impl Database {
    pub(crate) async fn newest_sample(&self) -> Result<Option<Timestamp>> {
        let mut reader = self.reader().await?;
        let newest_us: Option<i64> = query_scalar(NEWEST_TIME).fetch_one(&mut reader).await?;
        newest_us.map(Timestamp::from_microsecond).transpose().map_err(Error::fault)
    }

    pub(crate) async fn retain_samples(&self, since: Option<Timestamp>, now: Timestamp) -> Result<u64> {
        let (of_weeks, since) = match &self.backend {
            Backend::Sqlite(_) => (0, since),
            Backend::Postgres(store) => {
                let since = since.map(start_of_week).transpose()?;
                (store.retain_weeks(&self.actor, since, now).await?, since)
            }
        };
        match since {
            Some(since) => Ok(of_weeks + self.delete_before(since, now).await?),
            None => Ok(of_weeks),
        }
    }

    /// Deletes the samples from before an instant, camera by camera and in short transactions.
    async fn delete_before(&self, before: Timestamp, now: Timestamp) -> Result<u64> {
        let before_us = before.as_microsecond();
        let mut reader = self.reader().await?;
        let cameras: Vec<i64> = query_scalar(
            "SELECT camera_key FROM sample_counts AS counts WHERE EXISTS (SELECT 1 FROM samples \
             WHERE samples.camera_key = counts.camera_key AND time_us < $1) \
             OR EXISTS (SELECT 1 FROM samples_without_fix AS boxes WHERE boxes.camera_key = counts.camera_key \
             AND time_us < $1) ORDER BY camera_key",
        )
        .bind(before_us)
        .fetch_all(&mut reader)
        .await?;
        reader.commit().await?;
        let mut deleted = 0;
        for camera_key in cameras {
            loop {
                let mut writer = self.deletion().await?;
                let mut transaction = writer.begin().await?;
                let rows = delete_batch(&mut transaction, camera_key, before_us).await?;
                if deleted == 0 && rows > 0 {
                    self.record(&mut transaction, expired(before), now).await?;
                }
                transaction.commit().await?;
                writer.reclaim().await;
                if rows == 0 {
                    break;
                }
                deleted += rows;
            }
        }
        Ok(deleted)
    }
}
