//! Model versions with their checksums and held-out errors, and which version is active.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;
use uuid::Uuid;

use super::Store;
use super::audit::{Change, version};
use super::cameras::{camera_key, find_camera};
use super::errors::{failed, no_model};
use super::retention::prune_models;
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, BoundingBox, Camera, CameraId, Error, ErrorKind, HeldOutSampleError, ModelMetadata,
    ModelVersion, Result, RunId, TargetId, model_sha256,
};
use crate::geo::Position;

macro_rules! select {
    ($rest:literal) => {
        concat!(
            "SELECT cameras.id, models.number, models.run_id, models.created_at_us, \
             length(models.weights), models.metadata \
             FROM models JOIN cameras ON cameras.key = models.camera_key ",
            $rest
        )
    };
}

impl Store {
    /// Stores an imported model as the camera's next version; it does not become active.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn insert_model(
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

    /// One version, without its weights.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`].
    pub async fn model(&self, camera: &CameraId, number: u32) -> Result<ModelVersion> {
        camera_key(self.readers(), camera).await?;
        let mut reader = self.readers().acquire().await.map_err(failed)?;
        find_model(&mut reader, camera, number).await?.ok_or_else(|| no_model(camera, number))
    }

    /// Metadata and weights of one version, as they were stored.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`]; [`ErrorKind::ModelUnusable`] where what
    /// is stored does not match its checksum or cannot be read.
    pub async fn model_content(&self, camera: &CameraId, number: u32) -> Result<(ModelMetadata, Vec<u8>)> {
        let key = camera_key(self.readers(), camera).await?;
        let content: Option<(Vec<u8>, Vec<u8>, Option<String>)> = sqlx::query_as(
            "SELECT CAST(metadata AS BLOB), weights, sha256 FROM models WHERE camera_key = ? AND number = ?",
        )
        .bind(key)
        .bind(number)
        .fetch_optional(self.readers())
        .await
        .map_err(failed)?;
        let (document, weights, sha256) = content.ok_or_else(|| no_model(camera, number))?;
        if sha256.is_some_and(|sha256| sha256 != model_sha256(&document, &weights)) {
            return Err(unusable(camera, number, "what is stored does not match its checksum"));
        }
        let metadata = serde_json::from_slice(&document)
            .map_err(|error| unusable(camera, number, &format!("its metadata cannot be read: {error}")))?;
        Ok((metadata, weights))
    }

    /// Fills in the checksums of versions that an earlier release stored; returns how many there were.
    ///
    /// # Errors
    /// Faults only.
    pub async fn fill_in_model_checksums(&self) -> Result<u64> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let missing: Vec<(i64, i64)> =
            sqlx::query_as("SELECT camera_key, number FROM models WHERE sha256 IS NULL")
                .fetch_all(&mut *transaction)
                .await
                .map_err(failed)?;
        for (key, number) in &missing {
            let (document, weights): (Vec<u8>, Vec<u8>) = sqlx::query_as(
                "SELECT CAST(metadata AS BLOB), weights FROM models WHERE camera_key = ? AND number = ?",
            )
            .bind(key)
            .bind(number)
            .fetch_one(&mut *transaction)
            .await
            .map_err(failed)?;
            sqlx::query("UPDATE models SET sha256 = ? WHERE camera_key = ? AND number = ?")
                .bind(model_sha256(&document, &weights))
                .bind(key)
                .bind(number)
                .execute(&mut *transaction)
                .await
                .map_err(failed)?;
        }
        transaction.commit().await.map_err(failed)?;
        Ok(missing.len() as u64)
    }

    /// The held-out errors that were stored with a version, each with its sample as long as that is
    /// stored; by time and target.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn held_out_errors(&self, camera: &CameraId, number: u32) -> Result<Vec<StoredHeldOutError>> {
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

    /// A page of versions, newest first, before a number.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn models(
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

    /// Makes a version the active one. Naming the active one changes nothing.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`].
    pub async fn activate_model(&self, camera: &CameraId, number: u32, now: Timestamp) -> Result<Camera> {
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

    /// Makes the version active that was before the active one. Repeated calls go further back.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::NoModel`] if none is active, [`ErrorKind::NoEarlierModel`]
    /// if none was active before.
    pub async fn roll_back(&self, camera: &CameraId, now: Timestamp) -> Result<Camera> {
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
        let (position, number) = match latest[..] {
            [(position, _), (_, number)] => (position, number),
            [(_, active), ..] => return Err(no_earlier_model(camera, active)),
            [] => {
                let message =
                    format!("camera {camera} has no active model; activate a version by its number");
                return Err(Error::refused(ErrorKind::NoModel, message));
            }
        };
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

    /// The cameras that have an active model, with its number.
    ///
    /// # Errors
    /// Faults only.
    pub async fn active_models(&self) -> Result<Vec<(CameraId, u32)>> {
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

/// A model to be stored.
#[derive(Debug, Clone, PartialEq)]
pub struct NewModel<'a> {
    /// Its description.
    pub metadata: &'a ModelMetadata,
    /// Its weights.
    pub weights: &'a [u8],
    /// Errors on held-out samples, for the comparison with later versions.
    pub held_out: &'a [HeldOutSampleError],
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
    let metadata = serde_json::to_string(metadata).map_err(Error::fault)?;
    // JSON has no NaN: it would be written as null and could never be read again.
    serde_json::from_str::<ModelMetadata>(&metadata)
        .map_err(|error| Error::fault(format!("the metadata of a model cannot be stored: {error}")))?;
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

fn no_earlier_model(camera: &CameraId, active: i64) -> Error {
    let message = format!(
        "version {active} of camera {camera} stays active: no other version was active before it; activate one by \
         its number"
    );
    Error::refused(ErrorKind::NoEarlierModel, message)
}

fn unusable(camera: &CameraId, number: u32, reason: &str) -> Error {
    Error::refused(
        ErrorKind::ModelUnusable,
        format!(
            "version {number} of camera {camera} cannot be used: {reason}; activate another version, or \
             import this one again"
        ),
    )
}

/// A held-out error, with the box and the fix of its sample as long as that is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredHeldOutError {
    /// The error.
    pub error: HeldOutSampleError,
    /// The sample's box, and the position of its fix.
    pub sample: Option<(BoundingBox, Position)>,
}

fn read_held_out_error(row: &SqliteRow) -> Result<StoredHeldOutError> {
    let mut fields = RowDecoder::new("held_out_errors", row).skip(1);
    let time = fields.timestamp()?;
    let target_id = fields.parse(TargetId::new)?;
    let error = HeldOutSampleError { time, target_id, distance_m: fields.get()? };
    let mut columns = [None; 6];
    for column in &mut columns {
        *column = fields.get::<Option<f64>>()?;
    }
    let [
        Some(left_px),
        Some(top_px),
        Some(width_px),
        Some(height_px),
        Some(longitude_deg),
        Some(latitude_deg),
    ] = columns
    else {
        return Ok(StoredHeldOutError { error, sample: None });
    };
    let bounding_box = fields.checked(BoundingBox::new(left_px, top_px, width_px, height_px))?;
    let position = fields.checked(Position::new(longitude_deg, latitude_deg))?;
    Ok(StoredHeldOutError { error, sample: Some((bounding_box, position)) })
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

fn read_model(row: &SqliteRow) -> Result<ModelVersion> {
    let mut fields = RowDecoder::new("models", row);
    Ok(ModelVersion {
        camera_id: fields.parse(CameraId::new)?,
        number: fields.count()?,
        run_id: fields.parse_optional(Uuid::parse_str)?.map(RunId),
        created_at: fields.timestamp()?,
        weights_bytes: fields.parse(|stored: i64| u64::try_from(stored))?,
        metadata: fields.parse(serde_json::from_str)?,
    })
}
