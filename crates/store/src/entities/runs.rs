//! Training runs: jobs whose output is a model version.

use std::time::Duration;

use jiff::Timestamp;

use super::cameras::{camera_key, lock_camera};
use super::idempotency::{find_answer, insert_answer, lock_key};
use super::jobs::RUNS;
use super::models::{activate, add_model};
use super::retention::prune_models;
use crate::database::Database;
use crate::domain::{AuditAction, CameraId, Result, RunId, RunProgress, TrainingOptions, TrainingRun};
use crate::jobs::{Claim, Heartbeat, run_priority};
use crate::query::{RowLock, Session, query};
use crate::refusals::no_run;
use crate::rows::audit::{Change, version};
use crate::rows::idempotency::IdempotencyRecord;
use crate::rows::runs::{
    RunEnd, RunOutput, check_no_live_run, check_not_ended, read_run, run_of, select_runs,
};

impl Database {
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
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
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
        query(
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
        .execute(&mut transaction)
        .await?;
        let change = Change::of_camera(AuditAction::RunStarted, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
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
        let rows = query(select_runs(
            reader.dialect(),
            "WHERE runs.camera_key = $1 AND runs.id < $2 ORDER BY runs.id DESC LIMIT $3",
        ))
        .bind(key)
        .bind(before)
        .bind(limit)
        .fetch_all(&mut reader)
        .await?;
        rows.iter().map(read_run).collect()
    }

    pub(crate) async fn claim_run(
        &self,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<TrainingRun>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(claim) = RUNS.claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let id = RunId(claim.job);
        query("DELETE FROM training_epochs WHERE run_id = $1")
            .bind(id.to_string())
            .execute(&mut transaction)
            .await?;
        let job = find_run(&mut transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    pub(crate) async fn heartbeat_run(
        &self,
        run: RunId,
        fence: i64,
        progress: &RunProgress,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        let heartbeat = RUNS.heartbeat(&mut transaction, (run.0, fence), lease, now).await?;
        if heartbeat == Heartbeat::Lost {
            return Ok(heartbeat);
        }
        RUNS.record_progress(&mut transaction, run.0, progress).await?;
        transaction.commit().await?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_run(
        &self,
        camera: &CameraId,
        run: RunId,
        now: Timestamp,
    ) -> Result<TrainingRun> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        lock_camera(&mut transaction, camera).await?;
        let stored = run_of(find_run(&mut transaction, run).await?, camera, run)?;
        check_not_ended(&stored)?;
        RUNS.cancel(&mut transaction, run.0, now).await?;
        let change = Change::of_camera(AuditAction::RunCancelled, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
        stored.ok_or_else(|| no_run(run))
    }

    pub(crate) async fn finish_run(
        &self,
        run: RunId,
        fence: i64,
        end: RunEnd<'_>,
        now: Timestamp,
    ) -> Result<Option<TrainingRun>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
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
            query("UPDATE training_runs SET model_version = $1 WHERE id = $2")
                .bind(number)
                .bind(run.to_string())
                .execute(&mut transaction)
                .await?;
        }
        let stored = find_run(&mut transaction, run).await?;
        if let Some((number, stored)) = activated.zip(stored.as_ref()) {
            let change =
                Change::of_camera(AuditAction::ModelActivated, &stored.camera_id, Some(version(number)));
            self.record(&mut transaction, change, now).await?;
        }
        transaction.commit().await?;
        Ok(stored)
    }
}

async fn lock_camera_of(session: &mut dyn Session, run: RunId) -> Result<()> {
    query("SELECT key FROM cameras WHERE key = (SELECT camera_key FROM training_runs WHERE id = $1)")
        .bind(run.to_string())
        .locking(RowLock::NoKeyUpdate)
        .execute(session)
        .await?;
    Ok(())
}

async fn find_run(session: &mut dyn Session, run: RunId) -> Result<Option<TrainingRun>> {
    let row = query(select_runs(session.dialect(), "WHERE runs.id = $1"))
        .bind(run.to_string())
        .fetch_optional(session)
        .await?;
    row.as_ref().map(read_run).transpose()
}
