//! Recordings of cameras that learn.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{CameraKey, Error, RecordingBounds, RecordingPart, Result};
use crate::query::{query, query_scalar};

impl Database {
    pub(crate) async fn append_recording(
        &self,
        camera: CameraKey,
        part: &RecordingPart,
        bounds: RecordingBounds,
    ) -> Result<()> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        query(
            "INSERT INTO recording_parts (camera_key, recorded_at_us, row_count, content) \
             SELECT key, $1, $2, $3 FROM cameras WHERE key = $4",
        )
        .bind(part.recorded_at.as_microsecond())
        .bind(part.rows)
        .bind(&*part.content)
        .bind(camera.0)
        .execute(&mut transaction)
        .await?;
        // Beyond a number of rows or bytes, counted from the newest.
        query(
            "DELETE FROM recording_parts WHERE camera_key = $1 AND number IN (SELECT number FROM \
             (SELECT number, SUM(row_count) OVER newest AS row_sum, SUM(LENGTH(content)) OVER newest AS byte_sum \
             FROM recording_parts WHERE camera_key = $1 WINDOW newest AS (ORDER BY number DESC)) AS summed \
             WHERE row_sum > $2 OR byte_sum > $3)",
        )
        .bind(camera.0)
        .bind(i64::try_from(bounds.rows).map_err(Error::fault)?)
        .bind(i64::try_from(bounds.bytes).map_err(Error::fault)?)
        .execute(&mut transaction)
        .await?;
        transaction.commit().await
    }

    pub(crate) async fn recording(&self, camera: CameraKey) -> Result<Vec<Vec<u8>>> {
        let mut reader = self.reader().await?;
        query_scalar("SELECT content FROM recording_parts WHERE camera_key = $1 ORDER BY number")
            .bind(camera.0)
            .fetch_all(&mut reader)
            .await
    }

    pub(crate) async fn retain_recordings(&self, since: Timestamp) -> Result<u64> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        let deleted = query(
            "DELETE FROM recording_parts WHERE recorded_at_us < $1 OR camera_key IN \
             (SELECT key FROM cameras WHERE active_model IS NOT NULL OR NOT learn_automatically)",
        )
        .bind(since.as_microsecond())
        .execute(&mut transaction)
        .await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(deleted)
    }
}
