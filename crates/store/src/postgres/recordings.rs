//! Recordings of cameras that learn.

use jiff::Timestamp;

use super::Store;
use super::errors::failed;
use crate::domain::{CameraKey, Error, RecordingBounds, RecordingPart, Result};
use crate::rows::recordings::{APPEND, DELETE_UNWANTED, READ, TRIM};

impl Store {
    pub(crate) async fn append_recording(
        &self,
        camera: CameraKey,
        part: &RecordingPart,
        bounds: RecordingBounds,
    ) -> Result<()> {
        let mut transaction = self.writer().await?;
        sqlx::query(APPEND)
            .bind(part.recorded_at.as_microsecond())
            .bind(i64::from(part.rows))
            .bind(&part.content)
            .bind(camera.0)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        sqlx::query(TRIM)
            .bind(camera.0)
            .bind(i64::try_from(bounds.rows).map_err(Error::fault)?)
            .bind(i64::try_from(bounds.bytes).map_err(Error::fault)?)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    pub(crate) async fn recording(&self, camera: CameraKey) -> Result<Vec<Vec<u8>>> {
        let mut reader = self.reader().await?;
        sqlx::query_scalar(READ).bind(camera.0).fetch_all(&mut *reader).await.map_err(failed)
    }

    pub(crate) async fn retain_recordings(&self, since: Timestamp) -> Result<u64> {
        let mut transaction = self.writer().await?;
        let deleted = sqlx::query(DELETE_UNWANTED)
            .bind(since.as_microsecond())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(deleted.rows_affected())
    }
}
