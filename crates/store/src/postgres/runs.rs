//! Training runs: jobs whose output is a model version.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::PgConnection;

use super::Store;
use super::cameras::{camera_key, lock_camera};
use super::errors::failed;
use super::idempotency::{find_answer, insert_answer, lock_key};
use super::jobs::RUNS;
use super::models::{activate, add_model};
use super::retention::prune_models;
use crate::domain::{AuditAction, CameraId, Result, RunId, RunProgress, TrainingOptions, TrainingRun};
use crate::jobs::{Claim, Heartbeat, run_priority};
use crate::refusals::no_run;
use crate::rows::audit::{Change, version};
use crate::rows::idempotency::IdempotencyRecord;
use crate::rows::runs::{
    RunEnd, RunOutput, check_no_live_run, check_not_ended, read_run, run_of, select_runs,
};

macro_rules! select {
    ($rest:literal) => {
        select_runs!("training_report(models.metadata)", $rest)
    };
}

impl Store {
    /// Queues a run.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunLive`] if the camera has a run that has not ended,
    /// [`ErrorKind::Overloaded`] if all cameras together have `max_live` of them.
    pub(crate) async fn insert_run(
        &self,
        run: RunId,
        camera: &CameraId,
        options: &TrainingOptions,
        max_live: u32,
        now: Timestamp,
    ) -> Result<TrainingRun> {
        self.insert_run_once(run, camera, options, max_live, None, now).await
    }

    pub(crate) async fn insert_run_once(
        &self,
        run: RunId,
        camera: &CameraId,
        options: &TrainingOptions,
        max_live: u32,
        record: Option<&IdempotencyRecord>,
        now: Timestamp,
    ) -> Result<TrainingRun> {
        let mut transaction = self.writer().await?;
        let key = lock_camera(&mut transaction, camera).await?;
        if let Some(record) = record {
            let caller = (&*self.actor, &record.key);
            lock_key(&mut transaction, caller).await?;
            if let Some(answer) = find_answer(&mut transaction, self.limits(), caller, now).await? {
                let first = answer.to_request(&record.digest)?.parse()?;
                return run_of(find_run(&mut transaction, first).await?, camera, first);
            }
            insert_answer(&mut transaction, self.limits(), (&self.actor, record), &run.to_string(), now)
                .await?;
        }
        RUNS.prune_ended(&mut transaction, key, self.limits().ended_runs_per_camera).await?;
        check_no_live_run(RUNS.live_of(&mut transaction, key).await?)?;
        RUNS.check_capacity(&mut transaction, max_live).await?;
        sqlx::query(
            "INSERT INTO training_runs (id, camera_key, recipe, seed, epochs, from_us, until_us, state, \
             created_at_us, priority) VALUES ($1, $2, $3, $4, $5, $6, $7, 'queued', $8, $9)",
        )
        .bind(run.to_string())
        .bind(key)
        .bind(options.recipe.as_str())
        .bind(options.seed.cast_signed())
        .bind(options.epochs.map(i64::from))
        .bind(options.from.map(Timestamp::as_microsecond))
        .bind(options.until.map(Timestamp::as_microsecond))
        .bind(now.as_microsecond())
        .bind(run_priority(&self.actor))
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        let change = Change::of_camera(AuditAction::RunStarted, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        stored.ok_or_else(|| no_run(run))
    }

    pub(crate) async fn run(&self, camera: &CameraId, run: RunId) -> Result<TrainingRun> {
        let mut reader = self.reader().await?;
        camera_key(&mut reader, camera).await?;
        run_of(find_run(&mut reader, run).await?, camera, run)
    }

    pub(crate) async fn runs(
        &self,
        camera: &CameraId,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Vec<TrainingRun>> {
        let mut reader = self.reader().await?;
        let key = camera_key(&mut reader, camera).await?;
        // "~" sorts after all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |run| run.to_string());
        let rows = sqlx::query(select!(
            "WHERE runs.camera_key = $1 AND runs.id < $2 ORDER BY runs.id DESC LIMIT $3"
        ))
        .bind(key)
        .bind(before)
        .bind(i64::from(limit))
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        rows.iter().map(read_run).collect()
    }

    pub(crate) async fn claim_run(
        &self,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<TrainingRun>>> {
        let mut transaction = self.writer().await?;
        let Some(claim) = RUNS.claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let id = RunId(claim.job);
        sqlx::query("DELETE FROM training_epochs WHERE run_id = $1")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let job = find_run(&mut transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    pub(crate) async fn heartbeat_run(
        &self,
        run: RunId,
        fence: i64,
        progress: &RunProgress,
        lease: Duration,
        _now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut transaction = self.relaxed_writer().await?;
        let heartbeat = RUNS.heartbeat(&mut transaction, (run.0, fence), lease).await?;
        if heartbeat == Heartbeat::Lost {
            return Ok(heartbeat);
        }
        RUNS.record_progress(&mut transaction, run.0, progress).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_run(
        &self,
        camera: &CameraId,
        run: RunId,
        now: Timestamp,
    ) -> Result<TrainingRun> {
        let mut transaction = self.writer().await?;
        lock_camera(&mut transaction, camera).await?;
        let stored = run_of(find_run(&mut transaction, run).await?, camera, run)?;
        check_not_ended(&stored)?;
        RUNS.cancel(&mut transaction, run.0, now).await?;
        let change = Change::of_camera(AuditAction::RunCancelled, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        stored.ok_or_else(|| no_run(run))
    }

    pub(crate) async fn finish_run(
        &self,
        run: RunId,
        fence: i64,
        end: RunEnd<'_>,
        now: Timestamp,
    ) -> Result<Option<TrainingRun>> {
        let mut transaction = self.writer().await?;
        // The camera first, as in every change of a camera's runs.
        lock_camera_of(&mut transaction, run).await?;
        let Some(finished) = RUNS.finish(&mut transaction, (run.0, fence), end, now).await? else {
            return Ok(None);
        };
        let mut activated = None;
        if let Some(RunOutput { model, activate: wanted }) = finished.output {
            let key = finished.owner_key;
            let number = add_model(&mut transaction, key, Some(run), &model, now).await?;
            if wanted {
                activate(&mut transaction, key, number, now).await?;
                activated = Some(number);
            }
            prune_models(&mut transaction, key, self.limits().models_per_camera).await?;
            sqlx::query("UPDATE training_runs SET model_version = $1 WHERE id = $2")
                .bind(i64::from(number))
                .bind(run.to_string())
                .execute(&mut *transaction)
                .await
                .map_err(failed)?;
        }
        let stored = find_run(&mut transaction, run).await?;
        if let Some((number, stored)) = activated.zip(stored.as_ref()) {
            let change =
                Change::of_camera(AuditAction::ModelActivated, &stored.camera_id, Some(version(number)));
            self.record(&mut transaction, change, now).await?;
        }
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }
}

async fn lock_camera_of(connection: &mut PgConnection, run: RunId) -> Result<()> {
    sqlx::query(
        "SELECT key FROM cameras WHERE key = (SELECT camera_key FROM training_runs WHERE id = $1) \
         FOR NO KEY UPDATE",
    )
    .bind(run.to_string())
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}

async fn find_run(connection: &mut PgConnection, run: RunId) -> Result<Option<TrainingRun>> {
    let row = sqlx::query(select!("WHERE runs.id = $1"))
        .bind(run.to_string())
        .fetch_optional(connection)
        .await
        .map_err(failed)?;
    row.as_ref().map(read_run).transpose()
}
