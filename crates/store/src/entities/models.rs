//! Model versions with their checksums and held-out errors, and which version is active.

use jiff::Timestamp;
use sqlx::AssertSqlSafe;

use super::cameras::{camera_key, find_camera, lock_camera};
use super::retention::prune_models;
use crate::database::Database;
use crate::domain::{
    AuditAction, Camera, CameraId, Error, HeldOutSampleError, ModelMetadata, ModelVersion, Result, RunId,
    model_sha256,
};
use crate::query::{Query, Session, query, query_as, query_scalar};
use crate::refusals::no_model;
use crate::row_decoder::RowDecoder;
use crate::row_decoder::StoredRow;
use crate::rows::audit::{Change, version};
use crate::rows::models::{
    NewModel, StoredContent, StoredHeldOutError, StoredModel, read_held_out_error, read_model,
    roll_back_target, select_models as select, write_metadata,
};

/// Rows of one statement.
const ERRORS_AT_A_TIME: usize = 500;

impl Database {
    pub(crate) async fn insert_model(
        &self,
        camera: &CameraId,
        metadata: &ModelMetadata,
        weights: &[u8],
        now: Timestamp,
    ) -> Result<ModelVersion> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        let model = NewModel { metadata, weights, held_out: &[] };
        let number = add_model(&mut transaction, key, None, &model, now).await?;
        prune_models(&mut transaction, key, self.limits().models_per_camera).await?;
        let change = Change::of_camera(AuditAction::ModelImported, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let version = find_model(&mut transaction, camera, number).await?;
        transaction.commit().await?;
        version.ok_or_else(|| no_model(camera, number))
    }

    pub(crate) async fn model(&self, camera: &CameraId, number: u32) -> Result<ModelVersion> {
        let mut reader = self.reader().await?;
        camera_key(&mut reader, camera).await?;
        find_model(&mut reader, camera, number).await?.ok_or_else(|| no_model(camera, number))
    }

    pub(crate) async fn model_content(
        &self,
        camera: &CameraId,
        number: u32,
    ) -> Result<(ModelMetadata, Vec<u8>)> {
        let mut reader = self.reader().await?;
        let key = camera_key(&mut reader, camera).await?;
        let content: StoredContent = query_as(AssertSqlSafe(format!(
            "SELECT {}, weights, sha256 FROM models WHERE camera_key = $1 AND number = $2",
            reader.dialect().metadata_bytes()
        )))
        .bind(key)
        .bind(number)
        .fetch_optional(&mut reader)
        .await?;
        StoredModel { camera: camera.clone(), number, content }.read()
    }

    pub(crate) async fn held_out_errors(
        &self,
        camera: &CameraId,
        number: u32,
    ) -> Result<Vec<StoredHeldOutError>> {
        let mut reader = self.reader().await?;
        let key = camera_key(&mut reader, camera).await?;
        let rows = query(
            "SELECT errors.camera_key, errors.time_us, errors.target_id, errors.distance_m, left_px, top_px, \
             width_px, height_px, longitude_deg, latitude_deg \
             FROM held_out_errors AS errors LEFT JOIN samples USING (camera_key, time_us, target_id) \
             WHERE errors.camera_key = $1 AND errors.model_number = $2 ORDER BY errors.time_us, errors.target_id",
        )
        .bind(key)
        .bind(number)
        .fetch_all(&mut reader).await?;
        rows.iter().map(read_held_out_error).collect()
    }

    pub(crate) async fn models(
        &self,
        camera: &CameraId,
        before: Option<u32>,
        limit: u32,
    ) -> Result<Vec<ModelVersion>> {
        let mut reader = self.reader().await?;
        let key = camera_key(&mut reader, camera).await?;
        let rows = query(select!(
            "WHERE models.camera_key = $1 AND models.number < $2 ORDER BY models.number DESC LIMIT $3"
        ))
        .bind(key)
        .bind(before.map_or(i64::MAX, i64::from))
        .bind(limit)
        .fetch_all(&mut reader)
        .await?;
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
        let key = lock_camera(&mut transaction, camera).await?;
        if find_model(&mut transaction, camera, number).await?.is_none() {
            return Err(no_model(camera, number));
        }
        activate(&mut transaction, key, number, now).await?;
        let change = Change::of_camera(AuditAction::ModelActivated, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let camera = find_camera(&mut transaction, camera).await?;
        transaction.commit().await?;
        Ok(camera)
    }

    pub(crate) async fn roll_back(&self, camera: &CameraId, now: Timestamp) -> Result<Camera> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        let latest: Vec<(i64, i64)> = query_as(
            "SELECT position, model_number FROM activations \
             WHERE camera_key = $1 AND rolled_back_at_us IS NULL ORDER BY position DESC LIMIT 2",
        )
        .bind(key)
        .fetch_all(&mut transaction)
        .await?;
        let (position, number) = roll_back_target(camera, &latest)?;
        query("UPDATE activations SET rolled_back_at_us = $1 WHERE camera_key = $2 AND position = $3")
            .bind(now.as_microsecond())
            .bind(key)
            .bind(position)
            .execute(&mut transaction)
            .await?;
        set_active(&mut transaction, key, number).await?;
        let change = Change::of_camera(AuditAction::ModelRolledBack, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        let camera = find_camera(&mut transaction, camera).await?;
        transaction.commit().await?;
        Ok(camera)
    }

    pub(crate) async fn active_models(&self) -> Result<Vec<(CameraId, u32)>> {
        let mut reader = self.reader().await?;
        let rows = query("SELECT id, active_model FROM cameras WHERE active_model IS NOT NULL ORDER BY id")
            .fetch_all(&mut reader)
            .await?;
        let read = |row| {
            let mut fields = RowDecoder::new("cameras", row);
            Ok((fields.parse(CameraId::new)?, fields.count()?))
        };
        rows.iter().map(read).collect()
    }
}

/// Adds the next version of a camera; returns its number, which no version had before.
pub(super) async fn add_model(
    session: &mut dyn Session,
    camera_key: i64,
    run: Option<RunId>,
    model: &NewModel<'_>,
    now: Timestamp,
) -> Result<u32> {
    let NewModel { metadata, weights, held_out } = model;
    let metadata = write_metadata(metadata)?;
    let number: i64 = query_scalar(
        "UPDATE cameras SET last_model_number = last_model_number + 1 WHERE key = $1 \
         RETURNING last_model_number",
    )
    .bind(camera_key)
    .fetch_one(session)
    .await?;
    query(
        "INSERT INTO models (camera_key, number, run_id, created_at_us, sha256, metadata, weights) \
         VALUES ($1, $2, $3, $4, $5, $6, $7)",
    )
    .bind(camera_key)
    .bind(number)
    .bind(run.map(|run| run.to_string()))
    .bind(now.as_microsecond())
    .bind(model_sha256(metadata.as_bytes(), weights))
    .bind(metadata)
    .bind(*weights)
    .execute(session)
    .await?;
    add_held_out_errors(session, camera_key, number, held_out).await?;
    u32::try_from(number).map_err(Error::fault)
}

async fn add_held_out_errors(
    session: &mut dyn Session,
    camera_key: i64,
    number: i64,
    held_out: &[HeldOutSampleError],
) -> Result<()> {
    for errors in held_out.chunks(ERRORS_AT_A_TIME) {
        let row = |row: usize| format!("($1, $2, ${}, ${}, ${})", 3 * row + 3, 3 * row + 4, 3 * row + 5);
        let rows: Vec<String> = (0..errors.len()).map(row).collect();
        let insert = query(AssertSqlSafe(format!(
            "INSERT INTO held_out_errors (camera_key, model_number, time_us, target_id, distance_m) VALUES {}",
            rows.join(", ")
        )));
        let bind = |query: Query<StoredRow>, error: &HeldOutSampleError| {
            query.bind(error.time.as_microsecond()).bind(error.target_id.as_str()).bind(error.distance_m)
        };
        errors.iter().fold(insert.bind(camera_key).bind(number), bind).execute(session).await?;
    }
    Ok(())
}

/// Points the camera to a version that exists, and records it in the history of activations.
pub(super) async fn activate(
    session: &mut dyn Session,
    camera_key: i64,
    number: u32,
    now: Timestamp,
) -> Result<()> {
    let active: Option<i64> = query_scalar("SELECT active_model FROM cameras WHERE key = $1")
        .bind(camera_key)
        .fetch_one(session)
        .await?;
    if active == Some(number.into()) {
        return Ok(());
    }
    query(
        "INSERT INTO activations (camera_key, position, model_number, activated_at_us) \
         SELECT $1, coalesce(max(position), 0) + 1, $2, $3 FROM activations WHERE camera_key = $4",
    )
    .bind(camera_key)
    .bind(number)
    .bind(now.as_microsecond())
    .bind(camera_key)
    .execute(session)
    .await?;
    set_active(session, camera_key, number.into()).await
}

async fn set_active(session: &mut dyn Session, camera_key: i64, number: i64) -> Result<()> {
    query("UPDATE cameras SET active_model = $1 WHERE key = $2")
        .bind(number)
        .bind(camera_key)
        .execute(session)
        .await?;
    Ok(())
}

async fn find_model(
    session: &mut dyn Session,
    camera: &CameraId,
    number: u32,
) -> Result<Option<ModelVersion>> {
    let row = query(select!("WHERE cameras.id = $1 AND models.number = $2"))
        .bind(camera.as_str())
        .bind(number)
        .fetch_optional(session)
        .await?;
    row.as_ref().map(read_model).transpose()
}
