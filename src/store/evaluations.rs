//! Evaluations: jobs whose output is a report, a document that the store does not read.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteExecutor;
use sqlx::sqlite::SqliteRow;
use uuid::Uuid;

use super::Store;
use super::audit::Change;
use super::cameras::camera_key;
use super::errors::{failed, no_evaluation};
use super::jobs::{Claim, Heartbeat, JobEnd, Jobs, job_state, read_state};
use super::retention::prune_evaluations;
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, CameraId, Error, ErrorKind, EvaluationId, EvaluationJob, EvaluationPlan, EvaluationProgress,
    Method, Result, SigmaM, TimeRange, Truth,
};
use crate::geo::Position;

const EVALUATIONS: Jobs =
    Jobs { table: "evaluations", plural: "evaluations", reset_progress: "steps_done = 0, steps_planned = 0" };

macro_rules! select {
    ($rest:literal) => {
        concat!(
            "SELECT jobs.id, cameras.id, jobs.train_from_us, jobs.train_until_us, jobs.test_from_us, \
             jobs.test_until_us, jobs.truth_longitude_deg, jobs.truth_latitude_deg, jobs.truth_lines, \
             jobs.methods, jobs.recipe, jobs.seeds, jobs.box_shift_px, jobs.gnss_sigma_m, ", job_state!("jobs"), ", \
             jobs.attempt, jobs.phase, jobs.steps_done, jobs.steps_planned, jobs.remaining_s, jobs.outcome, \
             jobs.created_at_us, jobs.started_at_us, jobs.ended_at_us \
             FROM evaluations AS jobs JOIN cameras ON cameras.key = jobs.camera_key ",
            $rest
        )
    };
}

impl Store {
    /// Queues an evaluation.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::Overloaded`] if all cameras together have
    /// `max_live` of them that have not ended.
    pub async fn insert_evaluation(
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

    /// One evaluation.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    pub async fn evaluation(&self, id: EvaluationId) -> Result<EvaluationJob> {
        find_evaluation(self.readers(), id).await
    }

    /// The report of an evaluation as it was stored, `None` unless it has succeeded.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    pub async fn evaluation_report(&self, id: EvaluationId) -> Result<Option<String>> {
        let report: Option<Option<String>> =
            sqlx::query_scalar("SELECT report FROM evaluations WHERE id = ?")
                .bind(id.to_string())
                .fetch_optional(self.readers())
                .await
                .map_err(failed)?;
        report.ok_or_else(|| no_evaluation(id))
    }

    /// A page of evaluations, of a camera or of all, newest first, before an id.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn evaluations(
        &self,
        camera: Option<&CameraId>,
        before: Option<EvaluationId>,
        limit: u32,
    ) -> Result<Vec<EvaluationJob>> {
        // "~" sorts behind all UUIDs.
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

    /// Claims the oldest evaluation that is queued or whose lease has expired. Its attempt and fence go
    /// up by one; its progress is reset.
    ///
    /// # Errors
    /// Faults only.
    pub async fn claim_evaluation(
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

    /// Renews the lease and stores the evaluation's progress.
    ///
    /// # Errors
    /// Faults only.
    pub async fn heartbeat_evaluation(
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

    /// Cancels an evaluation: at once where no worker holds a live lease on it, otherwise at its worker's
    /// next heartbeat. Once this has returned, it produces no report any more.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`], [`ErrorKind::EvaluationEnded`].
    pub async fn cancel_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<EvaluationJob> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        if stored.state.has_ended() {
            let ended = format!("the evaluation has ended already: {}", stored.state.as_str());
            return Err(Error::refused(ErrorKind::EvaluationEnded, ended));
        }
        EVALUATIONS.cancel(&mut transaction, id.0, now).await?;
        let subject = Some(id.to_string());
        let change = Change::of_camera(AuditAction::EvaluationCancelled, &stored.camera_id, subject);
        self.record(&mut transaction, change, now).await?;
        let stored = find_evaluation(&mut *transaction, id).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }

    /// Ends an evaluation, or returns it to the queue, if the worker still owns its lease; `None` if it
    /// lost it, and then nothing was changed. One whose cancellation was requested is cancelled even if it
    /// succeeded or was returned.
    ///
    /// # Errors
    /// Faults only.
    pub async fn finish_evaluation(
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

    /// Deletes an evaluation, whatever its state; its worker learns of it by its next heartbeat.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    pub async fn delete_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<()> {
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

fn read_evaluation(row: &SqliteRow) -> Result<EvaluationJob> {
    let mut fields = RowDecoder::new("evaluations", row);
    Ok(EvaluationJob {
        id: EvaluationId(fields.parse(Uuid::parse_str)?),
        camera_id: fields.parse(CameraId::new)?,
        plan: EvaluationPlan {
            train: read_range(&mut fields)?,
            test: read_range(&mut fields)?,
            truth: read_truth(&mut fields)?,
            methods: fields.parse(read_methods)?,
            recipe: fields.parse(|name: &str| name.parse())?,
            seeds: fields.count()?,
            box_shift_px: fields.get()?,
            gnss_sigma: fields.parse_optional(SigmaM::new)?,
        },
        state: fields.parse(read_state)?,
        attempt: fields.count()?,
        progress: EvaluationProgress {
            phase: fields.get()?,
            steps_done: fields.count()?,
            steps: fields.count()?,
            remaining_s: fields.get()?,
        },
        outcome: fields.get()?,
        created_at: fields.timestamp()?,
        started_at: fields.optional_timestamp()?,
        ended_at: fields.optional_timestamp()?,
    })
}

fn read_range(fields: &mut RowDecoder<'_>) -> Result<TimeRange> {
    let (from, until) = (fields.optional_timestamp()?, fields.optional_timestamp()?);
    fields.checked(TimeRange::new(from, until))
}

fn read_methods(json: &str) -> Result<Vec<Method>> {
    let names: Vec<String> = serde_json::from_str(json).map_err(Error::fault)?;
    names.iter().map(|name| name.parse()).collect()
}

/// A truth as its columns: a point, or lines as JSON.
fn written_truth(truth: &Truth) -> Result<(Option<Position>, Option<String>)> {
    match truth {
        Truth::Columns => Ok((None, None)),
        Truth::Point(point) => Ok((Some(*point), None)),
        Truth::Lines(lines) => {
            let pair = |point: &Position| [point.longitude_deg(), point.latitude_deg()];
            let lines: Vec<Vec<[f64; 2]>> =
                lines.iter().map(|line| line.iter().map(pair).collect()).collect();
            Ok((None, Some(serde_json::to_string(&lines).map_err(Error::fault)?)))
        }
    }
}

fn read_truth(fields: &mut RowDecoder<'_>) -> Result<Truth> {
    let (longitude_deg, latitude_deg): (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let point =
        longitude_deg.zip(latitude_deg).map(|(longitude, latitude)| Position::new(longitude, latitude));
    let point = fields.checked(point.transpose())?;
    let lines = fields.parse_optional(read_lines)?;
    Ok(match (point, lines) {
        (Some(point), _) => Truth::Point(point),
        (None, Some(lines)) => Truth::Lines(lines),
        (None, None) => Truth::Columns,
    })
}

fn read_lines(json: &str) -> Result<Vec<Vec<Position>>> {
    let lines: Vec<Vec<[f64; 2]>> = serde_json::from_str(json).map_err(Error::fault)?;
    let read = |line: Vec<[f64; 2]>| {
        line.into_iter()
            .map(|[longitude_deg, latitude_deg]| {
                Position::new(longitude_deg, latitude_deg).map_err(Error::fault)
            })
            .collect()
    };
    lines.into_iter().map(read).collect()
}
