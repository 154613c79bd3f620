//! Evaluations: jobs whose output is a report, a document that the store does not read.

use std::time::Duration;

use jiff::Timestamp;

use super::cameras::{camera_key, lock_camera};
use super::jobs::EVALUATIONS;
use super::retention::prune_evaluations;
use crate::database::Database;
use crate::domain::{
    AuditAction, CameraId, Error, EvaluationId, EvaluationJob, EvaluationPlan, EvaluationProgress, Method,
    Result, SigmaM,
};
use crate::geo::Position;
use crate::jobs::{Claim, Heartbeat, JobEnd};
use crate::query::{Session, query, query_scalar};
use crate::refusals::no_evaluation;
use crate::rows::audit::Change;
use crate::rows::evaluations::{
    check_not_ended, read_evaluation, select_evaluations as select, written_truth,
};

impl Database {
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
        let key = lock_camera(&mut transaction, camera).await?;
        prune_evaluations(&mut transaction, self.limits().ended_evaluations).await?;
        EVALUATIONS.check_capacity(&mut transaction, max_live).await?;
        let (point, lines) = written_truth(&plan.truth)?;
        let methods: Vec<String> = plan.methods.iter().map(Method::to_string).collect();
        query(
            "INSERT INTO evaluations (id, camera_key, train_from_us, train_until_us, test_from_us, \
             test_until_us, truth_longitude_deg, truth_latitude_deg, truth_lines, methods, recipe, seeds, \
             box_shift_px, gnss_sigma_m, state, created_at_us) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, 'queued', $15)",
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
        .execute(&mut transaction)
        .await?;
        let change = Change::of_camera(AuditAction::EvaluationStarted, camera, Some(id.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_evaluation(&mut transaction, id).await?;
        transaction.commit().await?;
        Ok(stored)
    }

    pub(crate) async fn evaluation(&self, id: EvaluationId) -> Result<EvaluationJob> {
        let mut reader = self.reader().await?;
        find_evaluation(&mut reader, id).await
    }

    pub(crate) async fn evaluation_report(&self, id: EvaluationId) -> Result<Option<String>> {
        let mut reader = self.reader().await?;
        let report: Option<Option<String>> = query_scalar("SELECT report FROM evaluations WHERE id = $1")
            .bind(id.to_string())
            .fetch_optional(&mut reader)
            .await?;
        report.ok_or_else(|| no_evaluation(id))
    }

    pub(crate) async fn evaluations(
        &self,
        camera: Option<&CameraId>,
        before: Option<EvaluationId>,
        limit: u32,
    ) -> Result<Vec<EvaluationJob>> {
        let mut reader = self.reader().await?;
        // "~" sorts after all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |id| id.to_string());
        let query = match camera {
            Some(camera) => {
                let key = camera_key(&mut reader, camera).await?;
                query(select!("WHERE jobs.camera_key = $1 AND jobs.id < $2 ORDER BY jobs.id DESC LIMIT $3"))
                    .bind(key)
            }
            None => query(select!("WHERE jobs.id < $1 ORDER BY jobs.id DESC LIMIT $2")),
        };
        let rows = query.bind(before).bind(limit).fetch_all(&mut reader).await?;
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
        let job = find_evaluation(&mut transaction, EvaluationId(claim.job)).await?;
        transaction.commit().await?;
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
        query(
            "UPDATE evaluations SET phase = $1, steps_done = $2, steps_planned = $3, remaining_s = $4 WHERE id = $5",
        )
        .bind(&progress.phase)
        .bind(progress.steps_done)
        .bind(progress.steps)
        .bind(progress.remaining_s)
        .bind(id.to_string())
        .execute(&mut transaction).await?;
        transaction.commit().await?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<EvaluationJob> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        EVALUATIONS.lock(&mut transaction, id.0).await?;
        let stored = find_evaluation(&mut transaction, id).await?;
        check_not_ended(&stored)?;
        EVALUATIONS.cancel(&mut transaction, id.0, now).await?;
        let subject = Some(id.to_string());
        let change = Change::of_camera(AuditAction::EvaluationCancelled, &stored.camera_id, subject);
        self.record(&mut transaction, change, now).await?;
        let stored = find_evaluation(&mut transaction, id).await?;
        transaction.commit().await?;
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
            query("UPDATE evaluations SET report = $1 WHERE id = $2")
                .bind(report)
                .bind(id.to_string())
                .execute(&mut transaction)
                .await?;
        }
        let stored = find_evaluation(&mut transaction, id).await?;
        transaction.commit().await?;
        Ok(Some(stored))
    }

    pub(crate) async fn delete_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        EVALUATIONS.lock(&mut transaction, id.0).await?;
        let stored = find_evaluation(&mut transaction, id).await?;
        query("DELETE FROM evaluations WHERE id = $1").bind(id.to_string()).execute(&mut transaction).await?;
        let subject = Some(id.to_string());
        let change = Change::of_camera(AuditAction::EvaluationDeleted, &stored.camera_id, subject);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }
}

async fn find_evaluation(session: &mut dyn Session, id: EvaluationId) -> Result<EvaluationJob> {
    let row = query(select!("WHERE jobs.id = $1")).bind(id.to_string()).fetch_optional(session).await?;
    read_evaluation(&row.ok_or_else(|| no_evaluation(id))?)
}
