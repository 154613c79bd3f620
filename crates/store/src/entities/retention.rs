//! Deletion one by one or by age: model versions, training runs, evaluations.

use jiff::Timestamp;

use super::cameras::{find_camera, lock_camera};
use crate::database::Database;
use crate::domain::{AuditAction, CameraId, Error, ErrorKind, Result, RunId};
use crate::query::{Session, query, query_scalar};
use crate::refusals::{no_model, no_run};
use crate::rows::audit::{Change, version};
use crate::rows::models::is_active;

impl Database {
    pub(crate) async fn delete_model(&self, camera: &CameraId, number: u32, now: Timestamp) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        if find_camera(&mut transaction, camera).await?.active_model == Some(number) {
            return Err(is_active(number));
        }
        if !remove_model(&mut transaction, key, number.into()).await? {
            return Err(no_model(camera, number));
        }
        let change = Change::of_camera(AuditAction::ModelDeleted, camera, Some(version(number)));
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }

    pub(crate) async fn delete_run(&self, camera: &CameraId, run: RunId, now: Timestamp) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        let is_live: Option<bool> = query_scalar(
            "SELECT state IN ('queued', 'running') FROM training_runs WHERE id = $1 AND camera_key = $2",
        )
        .bind(run.to_string())
        .bind(key)
        .fetch_optional(&mut transaction)
        .await?;
        if is_live.ok_or_else(|| no_run(run))? {
            return Err(Error::refused(
                ErrorKind::RunLive,
                "the training run has not ended; cancel it first, or wait for its end",
            ));
        }
        query("DELETE FROM training_runs WHERE id = $1")
            .bind(run.to_string())
            .execute(&mut transaction)
            .await?;
        let change = Change::of_camera(AuditAction::RunDeleted, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }
}

/// Deletes a version with everything that refers to it; false if there is none.
async fn remove_model(session: &mut dyn Session, camera_key: i64, number: i64) -> Result<bool> {
    for sql in [
        "DELETE FROM activations WHERE camera_key = $1 AND model_number = $2",
        "DELETE FROM camera_moves WHERE camera_key = $1 AND model_number = $2",
    ] {
        query(sql).bind(camera_key).bind(number).execute(session).await?;
    }
    join_activations(session, camera_key).await?;
    let removed = query("DELETE FROM models WHERE camera_key = $1 AND number = $2")
        .bind(camera_key)
        .bind(number)
        .execute(session)
        .await?;
    Ok(removed > 0)
}

/// Two activations of one version that have become neighbours count as one, or a roll back from a
/// version would lead to itself.
async fn join_activations(session: &mut dyn Session, camera_key: i64) -> Result<()> {
    query(
        "DELETE FROM activations WHERE camera_key = $1 AND rolled_back_at_us IS NULL AND model_number = \
         (SELECT earlier.model_number FROM activations AS earlier WHERE earlier.camera_key = $1 \
         AND earlier.rolled_back_at_us IS NULL AND earlier.position < activations.position \
         ORDER BY earlier.position DESC LIMIT 1)",
    )
    .bind(camera_key)
    .execute(session)
    .await?;
    Ok(())
}

/// Deletes the oldest versions of a camera beyond a number, but neither the active nor the newest one.
pub(super) async fn prune_models(session: &mut dyn Session, camera_key: i64, keep: u32) -> Result<()> {
    let active: Option<i64> = query_scalar("SELECT active_model FROM cameras WHERE key = $1")
        .bind(camera_key)
        .fetch_one(session)
        .await?;
    let others: Vec<i64> = query_scalar(
        "SELECT number FROM models WHERE camera_key = $1 AND number IS DISTINCT FROM $2 ORDER BY number DESC",
    )
    .bind(camera_key)
    .bind(active)
    .fetch_all(session)
    .await?;
    let others_kept = (keep as usize).saturating_sub(usize::from(active.is_some())).max(1);
    for number in others.into_iter().skip(others_kept) {
        remove_model(session, camera_key, number).await?;
    }
    Ok(())
}

/// Deletes the oldest ended evaluations beyond a number.
pub(super) async fn prune_evaluations(session: &mut dyn Session, keep: u32) -> Result<()> {
    query(
        "DELETE FROM evaluations WHERE state NOT IN ('queued', 'running') AND id <= (SELECT id FROM evaluations \
         WHERE state NOT IN ('queued', 'running') ORDER BY id DESC LIMIT 1 OFFSET $1)",
    )
    .bind(keep)
    .execute(session).await?;
    Ok(())
}
