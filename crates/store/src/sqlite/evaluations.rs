//! Evaluations: jobs whose output is a report, a document that the store does not read.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteExecutor;

use super::Store;
use super::cameras::camera_key;
use super::errors::failed;
use super::jobs::EVALUATIONS;
use super::retention::prune_evaluations;
use crate::domain::{
    AuditAction, CameraId, Error, EvaluationId, EvaluationJob, EvaluationPlan, EvaluationProgress, Method,
    Result, SigmaM,
};
use crate::geo::Position;
use crate::jobs::{Claim, Heartbeat, JobEnd};
use crate::refusals::no_evaluation;
use crate::rows::audit::Change;
use crate::rows::evaluations::{
    check_not_ended, read_evaluation, select_evaluations as select, written_truth,
};

impl Store {
    pub(crate) async fn insert_evaluation(
        &self,
        id: EvaluationId,
        camera: &CameraId,
        plan: &EvaluationPlan,
        max_live: u32,
        now: Timestamp,
    ) -> Result<EvaluationJob> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        prune_evaluations(&mut transaction, self.limits().ended_evaluations).await?;
        EVALUATIONS.check_capacity(&mut transaction, max_live).await?;
        let (point, lines) = written_truth(&plan.truth)?;
        let methods: Vec<String> = plan.methods.iter().map(Method::to_string).collect();
        sqlx::query(
            "INSERT INTO evaluations (id, camera_key, train_from_us, train_until_us, test_from_us, \
             test_until_us, truth_longitude_deg, truth_latitude_deg, truth_lines, methods, recipe, seeds, \
             box_shift_px, gnss_sigma_m, state, created_at_us) \
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 'queued', ?)",
        )
        .bind(id.to_string())
        .bind(key)
        .bind(plan.train.from().map(Timestamp::as_microsecond))
        .bind(plan.train.until().map(Timestamp::as_microsecond))
        .bind(plan.test.from().map(Timestamp::as_microsecond))
        .bind(plan.test.until().map(Timestamp::as_microsecond))
        .bind(point.map(Position::longitude_deg))
        .bind(point.map(Position::latitude_deg))
        .bind(lines)
        .bind(serde_json::to_string(&methods).map_err(Error::fault)?)
        .bind(plan.recipe.as_str())
        .bind(plan.seeds)
        .bind(plan.box_shift_px)
        .bind(plan.gnss_sigma.map(SigmaM::metres))
        .bind(now.as_microsecond())
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        let change = Change::of_camera(AuditAction::EvaluationStarted, camera, Some(id.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }

    pub(crate) async fn evaluation(&self, id: EvaluationId) -> Result<EvaluationJob> {
        find_evaluation(self.readers(), id).await
    }

    pub(crate) async fn evaluation_report(&self, id: EvaluationId) -> Result<Option<String>> {
        let report: Option<Option<String>> =
            sqlx::query_scalar("SELECT report FROM evaluations WHERE id = ?")
                .bind(id.to_string())
                .fetch_optional(self.readers())
                .await
                .map_err(failed)?;
        report.ok_or_else(|| no_evaluation(id))
    }

    pub(crate) async fn evaluations(
        &self,
        camera: Option<&CameraId>,
        before: Option<EvaluationId>,
        limit: u32,
    ) -> Result<Vec<EvaluationJob>> {
        // "~" sorts after all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |id| id.to_string());
        let query = match camera {
            Some(camera) => {
                let key = camera_key(self.readers(), camera).await?;
                sqlx::query(select!(
                    "WHERE jobs.camera_key = ? AND jobs.id < ? ORDER BY jobs.id DESC LIMIT ?"
                ))
                .bind(key)
            }
            None => sqlx::query(select!("WHERE jobs.id < ? ORDER BY jobs.id DESC LIMIT ?")),
        };
        let rows = query.bind(before).bind(limit).fetch_all(self.readers()).await.map_err(failed)?;
        rows.iter().map(read_evaluation).collect()
    }

    pub(crate) async fn claim_evaluation(
        &self,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<EvaluationJob>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(claim) = EVALUATIONS.claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let job = find_evaluation(&mut *transaction, EvaluationId(claim.job)).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    pub(crate) async fn heartbeat_evaluation(
        &self,
        id: EvaluationId,
        fence: i64,
        progress: &EvaluationProgress,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        let heartbeat = EVALUATIONS.heartbeat(&mut transaction, (id.0, fence), lease, now).await?;
        if heartbeat == Heartbeat::Lost {
            return Ok(heartbeat);
        }
        sqlx::query(
            "UPDATE evaluations SET phase = ?, steps_done = ?, steps_planned = ?, remaining_s = ? WHERE id = ?",
        )
        .bind(&progress.phase)
        .bind(progress.steps_done)
        .bind(progress.steps)
        .bind(progress.remaining_s)
        .bind(id.to_string())
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<EvaluationJob> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        check_not_ended(&stored)?;
        EVALUATIONS.cancel(&mut transaction, id.0, now).await?;
        let subject = Some(id.to_string());
        let change = Change::of_camera(AuditAction::EvaluationCancelled, &stored.camera_id, subject);
        self.record(&mut transaction, change, now).await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }

    pub(crate) async fn finish_evaluation(
        &self,
        id: EvaluationId,
        fence: i64,
        end: JobEnd<String>,
        now: Timestamp,
    ) -> Result<Option<EvaluationJob>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(finished) = EVALUATIONS.finish(&mut transaction, (id.0, fence), end, now).await? else {
            return Ok(None);
        };
        if let Some(report) = finished.output {
            sqlx::query("UPDATE evaluations SET report = ? WHERE id = ?")
                .bind(report)
                .bind(id.to_string())
                .execute(&mut *transaction)
                .await
                .map_err(failed)?;
        }
        let stored = find_evaluation(&mut *transaction, id).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(stored))
    }

    pub(crate) async fn delete_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        sqlx::query("DELETE FROM evaluations WHERE id = ?")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let subject = Some(id.to_string());
        let change = Change::of_camera(AuditAction::EvaluationDeleted, &stored.camera_id, subject);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }
}

async fn find_evaluation(executor: impl SqliteExecutor<'_>, id: EvaluationId) -> Result<EvaluationJob> {
    let row = sqlx::query(select!("WHERE jobs.id = ?"))
        .bind(id.to_string())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    read_evaluation(&row.ok_or_else(|| no_evaluation(id))?)
}
