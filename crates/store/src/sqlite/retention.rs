//! What is deleted one by one or by age: model versions, training runs, evaluations.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::Store;
use super::cameras::{camera_key, find_camera};
use super::errors::failed;
use crate::domain::{AuditAction, CameraId, Error, ErrorKind, Result, RunId};
use crate::refusals::{no_model, no_run};
use crate::rows::audit::{Change, version};
use crate::rows::models::is_active;

impl Store {
    pub(crate) async fn delete_model(&self, camera: &CameraId, number: u32, now: Timestamp) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        if find_camera(&mut *transaction, camera).await?.active_model == Some(number) {
            return Err(is_active(number));
        }
        let key = camera_key(&mut *transaction, camera).await?;
        if !remove_model(&mut transaction, key, number.into()).await? {
            return Err(no_model(camera, number));
        }
        let change = Change::of_camera(AuditAction::ModelDeleted, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }

    pub(crate) async fn delete_run(&self, camera: &CameraId, run: RunId, now: Timestamp) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        let is_live: Option<bool> = sqlx::query_scalar(
            "SELECT state IN ('queued', 'running') FROM training_runs WHERE id = ? AND camera_key = ?",
        )
        .bind(run.to_string())
        .bind(key)
        .fetch_optional(&mut *transaction)
        .await
        .map_err(failed)?;
        if is_live.ok_or_else(|| no_run(run))? {
            return Err(Error::refused(
                ErrorKind::RunLive,
                "the training run has not ended; cancel it first, or wait for its end",
            ));
        }
        sqlx::query("DELETE FROM training_runs WHERE id = ?")
            .bind(run.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let change = Change::of_camera(AuditAction::RunDeleted, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }
}

/// Deletes a version with everything that refers to it; false if there is none.
async fn remove_model(connection: &mut SqliteConnection, camera_key: i64, number: i64) -> Result<bool> {
    for sql in [
        "DELETE FROM activations WHERE camera_key = ? AND model_number = ?",
        "DELETE FROM camera_moves WHERE camera_key = ? AND model_number = ?",
    ] {
        sqlx::query(sql).bind(camera_key).bind(number).execute(&mut *connection).await.map_err(failed)?;
    }
    join_activations(connection, camera_key).await?;
    let removed = sqlx::query("DELETE FROM models WHERE camera_key = ? AND number = ?")
        .bind(camera_key)
        .bind(number)
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(removed.rows_affected() > 0)
}

/// Two activations of one version that have become neighbours count as one, or a roll back from a
/// version would lead to itself.
async fn join_activations(connection: &mut SqliteConnection, camera_key: i64) -> Result<()> {
    sqlx::query(
        "DELETE FROM activations WHERE camera_key = ?1 AND rolled_back_at_us IS NULL AND model_number = \
         (SELECT earlier.model_number FROM activations AS earlier WHERE earlier.camera_key = ?1 \
         AND earlier.rolled_back_at_us IS NULL AND earlier.position < activations.position \
         ORDER BY earlier.position DESC LIMIT 1)",
    )
    .bind(camera_key)
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}

/// Deletes the oldest versions of a camera beyond a number, but neither the active nor the newest one.
pub(super) async fn prune_models(
    connection: &mut SqliteConnection,
    camera_key: i64,
    keep: u32,
) -> Result<()> {
    let beyond: Vec<i64> = sqlx::query_scalar(
        "SELECT number FROM models WHERE camera_key = ?1 \
         AND number IS NOT (SELECT active_model FROM cameras WHERE key = ?1) \
         ORDER BY number DESC LIMIT -1 OFFSET max(1, ?2 - \
         (SELECT active_model IS NOT NULL FROM cameras WHERE key = ?1))",
    )
    .bind(camera_key)
    .bind(keep)
    .fetch_all(&mut *connection)
    .await
    .map_err(failed)?;
    for number in beyond {
        remove_model(connection, camera_key, number).await?;
    }
    Ok(())
}

/// Deletes the oldest ended evaluations beyond a number.
pub(super) async fn prune_evaluations(connection: &mut SqliteConnection, keep: u32) -> Result<()> {
    sqlx::query(
        "DELETE FROM evaluations WHERE id IN (SELECT id FROM evaluations \
         WHERE state NOT IN ('queued', 'running') ORDER BY id DESC LIMIT -1 OFFSET ?)",
    )
    .bind(keep)
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}
