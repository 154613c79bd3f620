//! Model versions with their checksums and held-out errors, and which version is active.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::Store;
use super::cameras::{camera_key, find_camera};
use super::errors::failed;
use super::retention::prune_models;
use crate::domain::{
    AuditAction, Camera, CameraId, Error, HeldOutSampleError, ModelMetadata, ModelVersion, Result, RunId,
    model_sha256,
};
use crate::refusals::no_model;
use crate::row_decoder::RowDecoder;
use crate::rows::audit::{Change, version};
use crate::rows::models::{
    NewModel, StoredContent, StoredHeldOutError, read_content, read_held_out_error, read_model,
    roll_back_target, select_models as select, write_metadata,
};

impl Store {
    pub(crate) async fn insert_model(
        &self,
        camera: &CameraId,
        metadata: &ModelMetadata,
        weights: &[u8],
        now: Timestamp,
    ) -> Result<ModelVersion> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        let model = NewModel { metadata, weights, held_out: &[] };
        let number = add_model(&mut transaction, key, None, &model, now).await?;
        prune_models(&mut transaction, key, self.limits().models_per_camera).await?;
        let change = Change::of_camera(AuditAction::ModelImported, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let version = find_model(&mut transaction, camera, number).await?;
        transaction.commit().await.map_err(failed)?;
        version.ok_or_else(|| no_model(camera, number))
    }

    pub(crate) async fn model(&self, camera: &CameraId, number: u32) -> Result<ModelVersion> {
        camera_key(self.readers(), camera).await?;
        let mut reader = self.readers().acquire().await.map_err(failed)?;
        find_model(&mut reader, camera, number).await?.ok_or_else(|| no_model(camera, number))
    }

    pub(crate) async fn model_content(
        &self,
        camera: &CameraId,
        number: u32,
    ) -> Result<(ModelMetadata, Vec<u8>)> {
        let key = camera_key(self.readers(), camera).await?;
        let content: StoredContent = sqlx::query_as(
            "SELECT CAST(metadata AS BLOB), weights, sha256 FROM models WHERE camera_key = ? AND number = ?",
        )
        .bind(key)
        .bind(number)
        .fetch_optional(self.readers())
        .await
        .map_err(failed)?;
        read_content(camera, number, content)
    }

    pub(crate) async fn held_out_errors(
        &self,
        camera: &CameraId,
        number: u32,
    ) -> Result<Vec<StoredHeldOutError>> {
        let key = camera_key(self.readers(), camera).await?;
        let rows = sqlx::query(
            "SELECT errors.camera_key, errors.time_us, errors.target_id, errors.distance_m, left_px, top_px, \
             width_px, height_px, longitude_deg, latitude_deg \
             FROM held_out_errors AS errors LEFT JOIN samples USING (camera_key, time_us, target_id) \
             WHERE errors.camera_key = ? AND errors.model_number = ? ORDER BY errors.time_us, errors.target_id",
        )
        .bind(key)
        .bind(number)
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        rows.iter().map(read_held_out_error).collect()
    }

    pub(crate) async fn models(
        &self,
        camera: &CameraId,
        before: Option<u32>,
        limit: u32,
    ) -> Result<Vec<ModelVersion>> {
        let key = camera_key(self.readers(), camera).await?;
        let rows = sqlx::query(select!(
            "WHERE models.camera_key = ? AND models.number < ? ORDER BY models.number DESC LIMIT ?"
        ))
        .bind(key)
        .bind(before.map_or(i64::MAX, i64::from))
        .bind(limit)
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        rows.iter().map(read_model).collect()
    }

    pub(crate) async fn activate_model(
        &self,
        camera: &CameraId,
        number: u32,
        now: Timestamp,
    ) -> Result<Camera> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        if find_model(&mut transaction, camera, number).await?.is_none() {
            return Err(no_model(camera, number));
        }
        activate(&mut transaction, key, number, now).await?;
        let change = Change::of_camera(AuditAction::ModelActivated, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let camera = find_camera(&mut *transaction, camera).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(camera)
    }

    pub(crate) async fn roll_back(&self, camera: &CameraId, now: Timestamp) -> Result<Camera> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        let latest: Vec<(i64, i64)> = sqlx::query_as(
            "SELECT position, model_number FROM activations \
             WHERE camera_key = ? AND rolled_back_at_us IS NULL ORDER BY position DESC LIMIT 2",
        )
        .bind(key)
        .fetch_all(&mut *transaction)
        .await
        .map_err(failed)?;
        let (position, number) = roll_back_target(camera, &latest)?;
        sqlx::query("UPDATE activations SET rolled_back_at_us = ? WHERE camera_key = ? AND position = ?")
            .bind(now.as_microsecond())
            .bind(key)
            .bind(position)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        set_active(&mut transaction, key, number).await?;
        let change = Change::of_camera(AuditAction::ModelRolledBack, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let camera = find_camera(&mut *transaction, camera).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(camera)
    }

    pub(crate) async fn active_models(&self) -> Result<Vec<(CameraId, u32)>> {
        let rows =
            sqlx::query("SELECT id, active_model FROM cameras WHERE active_model IS NOT NULL ORDER BY id")
                .fetch_all(self.readers())
                .await
                .map_err(failed)?;
        let read = |row| {
            let mut fields = RowDecoder::new("cameras", row);
            Ok((fields.parse(CameraId::new)?, fields.count()?))
        };
        rows.iter().map(read).collect()
    }
}

/// Adds the next version of a camera; returns its number, which no version had before.
pub(super) async fn add_model(
    connection: &mut SqliteConnection,
    camera_key: i64,
    run: Option<RunId>,
    model: &NewModel<'_>,
    now: Timestamp,
) -> Result<u32> {
    let NewModel { metadata, weights, held_out } = model;
    let metadata = write_metadata(metadata)?;
    let number: i64 = sqlx::query_scalar(
        "UPDATE cameras SET last_model_number = 1 + max(last_model_number, \
         (SELECT coalesce(max(number), 0) FROM models WHERE camera_key = ?1)) WHERE key = ?1 \
         RETURNING last_model_number",
    )
    .bind(camera_key)
    .fetch_one(&mut *connection)
    .await
    .map_err(failed)?;
    sqlx::query(
        "INSERT INTO models (camera_key, number, run_id, created_at_us, sha256, metadata, weights) \
         VALUES (?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(camera_key)
    .bind(number)
    .bind(run.map(|run| run.to_string()))
    .bind(now.as_microsecond())
    .bind(model_sha256(metadata.as_bytes(), weights))
    .bind(metadata)
    .bind(*weights)
    .execute(&mut *connection)
    .await
    .map_err(failed)?;
    add_held_out_errors(connection, camera_key, number, held_out).await?;
    u32::try_from(number).map_err(Error::fault)
}

async fn add_held_out_errors(
    connection: &mut SqliteConnection,
    camera_key: i64,
    number: i64,
    held_out: &[HeldOutSampleError],
) -> Result<()> {
    for error in held_out {
        sqlx::query(
            "INSERT INTO held_out_errors (camera_key, model_number, time_us, target_id, distance_m) \
             VALUES (?, ?, ?, ?, ?)",
        )
        .bind(camera_key)
        .bind(number)
        .bind(error.time.as_microsecond())
        .bind(error.target_id.as_str())
        .bind(error.distance_m)
        .execute(&mut *connection)
        .await
        .map_err(failed)?;
    }
    Ok(())
}

/// Points the camera to a version that exists, and records it in the history of activations.
pub(super) async fn activate(
    connection: &mut SqliteConnection,
    camera_key: i64,
    number: u32,
    now: Timestamp,
) -> Result<()> {
    let active: Option<i64> = sqlx::query_scalar("SELECT active_model FROM cameras WHERE key = ?")
        .bind(camera_key)
        .fetch_one(&mut *connection)
        .await
        .map_err(failed)?;
    if active == Some(i64::from(number)) {
        return Ok(());
    }
    sqlx::query(
        "INSERT INTO activations (camera_key, position, model_number, activated_at_us) \
         SELECT ?, coalesce(max(position), 0) + 1, ?, ? FROM activations WHERE camera_key = ?",
    )
    .bind(camera_key)
    .bind(number)
    .bind(now.as_microsecond())
    .bind(camera_key)
    .execute(&mut *connection)
    .await
    .map_err(failed)?;
    set_active(connection, camera_key, i64::from(number)).await
}

async fn set_active(connection: &mut SqliteConnection, camera_key: i64, number: i64) -> Result<()> {
    sqlx::query("UPDATE cameras SET active_model = ? WHERE key = ?")
        .bind(number)
        .bind(camera_key)
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}

async fn find_model(
    connection: &mut SqliteConnection,
    camera: &CameraId,
    number: u32,
) -> Result<Option<ModelVersion>> {
    let row = sqlx::query(select!("WHERE cameras.id = ? AND models.number = ?"))
        .bind(camera.as_str())
        .bind(number)
        .fetch_optional(connection)
        .await
        .map_err(failed)?;
    row.as_ref().map(read_model).transpose()
}
