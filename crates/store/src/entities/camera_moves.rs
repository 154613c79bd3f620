//! Detected changes of camera poses.

use super::cameras::lock_camera;
use crate::database::Database;
use crate::domain::{CameraId, CameraMoved, Error, JobState, Result, RunId};
use crate::jobs::read_state;
use crate::query::{query, query_scalar};
use crate::rows::models::read_move;

impl Database {
    pub(crate) async fn insert_move(&self, camera: &CameraId, moved: &CameraMoved) -> Result<bool> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        let stored = query(
            "INSERT INTO camera_moves (camera_key, model_number, began_at_us, raised_at_us, shift_east_m, \
             shift_north_m, statistic, targets) VALUES ($1, $2, $3, $4, $5, $6, $7, $8) \
             ON CONFLICT (camera_key, model_number) DO NOTHING",
        )
        .bind(key)
        .bind(moved.model_version)
        .bind(moved.onset_at.as_microsecond())
        .bind(moved.raised_at.as_microsecond())
        .bind(moved.shift_east_m)
        .bind(moved.shift_north_m)
        .bind(moved.statistic)
        .bind(moved.targets)
        .execute(&mut transaction)
        .await?;
        transaction.commit().await?;
        Ok(stored > 0)
    }

    pub(crate) async fn camera_move(
        &self,
        camera: &CameraId,
        model_version: u32,
    ) -> Result<Option<CameraMoved>> {
        let mut reader = self.reader().await?;
        let row = query(
            "SELECT cameras.id, model_number, began_at_us, raised_at_us, shift_east_m, shift_north_m, statistic, \
             targets FROM camera_moves JOIN cameras ON cameras.key = camera_key \
             WHERE cameras.id = $1 AND model_number = $2",
        )
        .bind(camera.as_str())
        .bind(model_version)
        .fetch_optional(&mut reader).await?;
        row.as_ref().map(read_move).transpose()
    }

    pub(crate) async fn retraining_state(
        &self,
        camera: &CameraId,
        model_version: u32,
    ) -> Result<Option<JobState>> {
        let mut reader = self.reader().await?;
        let state: Option<String> = query_scalar(
            "SELECT state FROM camera_moves JOIN cameras ON cameras.key = camera_moves.camera_key \
             JOIN training_runs ON training_runs.id = retraining_run \
             WHERE cameras.id = $1 AND model_number = $2",
        )
        .bind(camera.as_str())
        .bind(model_version)
        .fetch_optional(&mut reader)
        .await?;
        state.as_deref().map(read_state).transpose().map_err(Error::fault)
    }

    pub(crate) async fn note_retraining(
        &self,
        camera: &CameraId,
        model_version: u32,
        run: RunId,
    ) -> Result<()> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        query("UPDATE camera_moves SET retraining_run = $1 WHERE camera_key = $2 AND model_number = $3")
            .bind(run.to_string())
            .bind(key)
            .bind(model_version)
            .execute(&mut transaction)
            .await?;
        transaction.commit().await
    }
}
