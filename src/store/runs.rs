//! Training runs: jobs whose output is a model version.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{SqliteConnection, SqliteExecutor};
use uuid::Uuid;

use super::Store;
use super::audit::{Change, version};
use super::cameras::camera_key;
use super::errors::{failed, no_run};
use super::idempotency::{IdempotencyRecord, find_answer, insert_answer};
use super::jobs::{Claim, Heartbeat, JobEnd, Jobs, job_state, read_state};
use super::models::{NewModel, activate, add_model};
use super::retention::{prune_models, prune_runs};
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, CameraId, Error, ErrorKind, Recipe, Result, RunId, RunProgress, TrainingOptions, TrainingRun,
};

pub(super) const RUNS: Jobs = Jobs {
    table: "training_runs",
    plural: "training runs",
    reset_progress: "epoch_done = 0, epochs_planned = 0, reconstruction_error = 0, regression_error = 0, error_scale = 0",
};

/// The output of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOutput<'a> {
    /// The fitted model.
    pub model: NewModel<'a>,
    /// Whether it becomes the active version in the same transaction.
    pub activate: bool,
}

/// How a worker finishes a run.
pub type RunEnd<'a> = JobEnd<RunOutput<'a>>;

macro_rules! select {
    ($rest:literal) => {
        concat!(
            "SELECT runs.id, cameras.id, runs.recipe, runs.seed, runs.epochs, runs.from_us, runs.until_us, \
             ", job_state!("runs"), ", runs.attempt, runs.phase, runs.epoch_done, runs.epochs_planned, \
             runs.reconstruction_error, runs.regression_error, runs.error_scale, runs.remaining_s, \
             runs.model_version, (SELECT json_extract(models.metadata, '$.report') FROM models \
             WHERE models.camera_key = runs.camera_key AND models.number = runs.model_version \
             AND json_valid(models.metadata)), runs.outcome, runs.created_at_us, runs.started_at_us, runs.ended_at_us \
             FROM training_runs AS runs JOIN cameras ON cameras.key = runs.camera_key ",
            $rest
        )
    };
}

impl Store {
    /// Queues a run.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunLive`] if the camera has a run that has not ended,
    /// [`ErrorKind::Overloaded`] if all cameras together have `max_live` of them.
    pub async fn insert_run(
        &self,
        run: RunId,
        camera: &CameraId,
        options: &TrainingOptions,
        max_live: u32,
        now: Timestamp,
    ) -> Result<TrainingRun> {
        self.insert_run_once(run, camera, options, max_live, None, now).await
    }

    /// As [`Store::insert_run`]; of several requests with the same record, the first queues a run and the
    /// others get it.
    ///
    /// # Errors
    /// As [`Store::insert_run`]; [`ErrorKind::IdempotencyKeyReused`] for a key of another request.
    pub async fn insert_run_once(
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
        let key = camera_key(&mut *transaction, camera).await?;
        if let Some(record) = record {
            let caller = (&*self.actor, &record.key);
            if let Some(answer) = find_answer(&mut *transaction, self.limits(), caller, now).await? {
                let first = answer.to_request(&record.digest)?.parse()?;
                return run_of(find_run(&mut *transaction, first).await?, camera, first);
            }
            insert_answer(&mut transaction, self.limits(), (&self.actor, record), &run.to_string(), now)
                .await?;
        }
        prune_runs(&mut transaction, key, self.limits().ended_runs_per_camera).await?;
        check_no_live_run(&mut transaction, key).await?;
        RUNS.check_capacity(&mut transaction, max_live).await?;
        sqlx::query(
            "INSERT INTO training_runs (id, camera_key, recipe, seed, epochs, from_us, until_us, state, \
             created_at_us) VALUES (?, ?, ?, ?, ?, ?, ?, 'queued', ?)",
        )
        .bind(run.to_string())
        .bind(key)
        .bind(options.recipe.as_str())
        .bind(options.seed.cast_signed())
        .bind(options.epochs)
        .bind(options.from.map(Timestamp::as_microsecond))
        .bind(options.until.map(Timestamp::as_microsecond))
        .bind(now.as_microsecond())
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        let change = Change::of_camera(AuditAction::RunStarted, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut *transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        stored.ok_or_else(|| no_run(run))
    }

    /// One run of a camera.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunNotFound`].
    pub async fn run(&self, camera: &CameraId, run: RunId) -> Result<TrainingRun> {
        camera_key(self.readers(), camera).await?;
        run_of(find_run(self.readers(), run).await?, camera, run)
    }

    /// A page of a camera's runs, newest first, before an id.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn runs(
        &self,
        camera: &CameraId,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Vec<TrainingRun>> {
        let key = camera_key(self.readers(), camera).await?;
        // "~" sorts behind all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |run| run.to_string());
        let rows =
            sqlx::query(select!("WHERE runs.camera_key = ? AND runs.id < ? ORDER BY runs.id DESC LIMIT ?"))
                .bind(key)
                .bind(before)
                .bind(limit)
                .fetch_all(self.readers())
                .await
                .map_err(failed)?;
        rows.iter().map(read_run).collect()
    }

    /// Claims the oldest run that is queued or whose lease has expired. Its attempt and fence go up by
    /// one; its curve and progress are reset.
    ///
    /// # Errors
    /// Faults only.
    pub async fn claim_run(&self, lease: Duration, now: Timestamp) -> Result<Option<Claim<TrainingRun>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(claim) = RUNS.claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let id = RunId(claim.job);
        sqlx::query("DELETE FROM training_epochs WHERE run_id = ?")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let job = find_run(&mut *transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    /// Renews the lease and stores the run's progress.
    ///
    /// # Errors
    /// Faults only.
    pub async fn heartbeat_run(
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
        sqlx::query(
            "UPDATE training_runs SET phase = ?, epoch_done = ?, epochs_planned = ?, \
             reconstruction_error = ?, regression_error = ?, error_scale = ?, remaining_s = ? WHERE id = ?",
        )
        .bind(&progress.phase)
        .bind(progress.epoch)
        .bind(progress.epochs)
        .bind(progress.reconstruction_error)
        .bind(progress.regression_error)
        .bind(progress.error_scale)
        .bind(progress.remaining_s)
        .bind(run.to_string())
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(heartbeat)
    }

    /// Cancels a run: at once where no worker holds a live lease on it, otherwise at its worker's next
    /// heartbeat. Once this has returned, the run produces no model any more.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunNotFound`], [`ErrorKind::RunEnded`].
    pub async fn cancel_run(&self, camera: &CameraId, run: RunId, now: Timestamp) -> Result<TrainingRun> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        camera_key(&mut *transaction, camera).await?;
        let stored = run_of(find_run(&mut *transaction, run).await?, camera, run)?;
        if stored.state.has_ended() {
            let ended = format!("the training run has ended already: {}", stored.state.as_str());
            return Err(Error::refused(ErrorKind::RunEnded, ended));
        }
        RUNS.cancel(&mut transaction, run.0, now).await?;
        let change = Change::of_camera(AuditAction::RunCancelled, camera, Some(run.to_string()));
        self.record(&mut transaction, change, now).await?;
        let stored = find_run(&mut *transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        stored.ok_or_else(|| no_run(run))
    }

    /// Ends a run, or returns it to the queue, if the worker still owns its lease; `None` if it lost it,
    /// and then nothing was changed. The model, its activation and the run's state are one transaction. A
    /// run whose cancellation was requested is cancelled even if it succeeded or was returned.
    ///
    /// # Errors
    /// Faults only.
    pub async fn finish_run(
        &self,
        run: RunId,
        fence: i64,
        end: RunEnd<'_>,
        now: Timestamp,
    ) -> Result<Option<TrainingRun>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(finished) = RUNS.finish(&mut transaction, (run.0, fence), end, now).await? else {
            return Ok(None);
        };
        let mut activated = None;
        if let Some(RunOutput { model, activate: wanted }) = finished.output {
            let key = finished.camera_key;
            let number = add_model(&mut transaction, key, Some(run), &model, now).await?;
            if wanted {
                activate(&mut transaction, key, number, now).await?;
                activated = Some(number);
            }
            prune_models(&mut transaction, key, self.limits().models_per_camera).await?;
            sqlx::query("UPDATE training_runs SET model_version = ? WHERE id = ?")
                .bind(number)
                .bind(run.to_string())
                .execute(&mut *transaction)
                .await
                .map_err(failed)?;
        }
        let stored = find_run(&mut *transaction, run).await?;
        if let Some((number, stored)) = activated.zip(stored.as_ref()) {
            let change =
                Change::of_camera(AuditAction::ModelActivated, &stored.camera_id, Some(version(number)));
            self.record(&mut transaction, change, now).await?;
        }
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }
}

/// A camera has one live run at most.
async fn check_no_live_run(connection: &mut SqliteConnection, camera_key: i64) -> Result<()> {
    let live: Option<String> = sqlx::query_scalar(
        "SELECT id FROM training_runs WHERE camera_key = ? AND state IN ('queued', 'running')",
    )
    .bind(camera_key)
    .fetch_optional(connection)
    .await
    .map_err(failed)?;
    let Some(live) = live else { return Ok(()) };
    let message =
        format!("the camera has training run {live}, which has not ended; wait for it or cancel it");
    Err(Error::conflict(ErrorKind::RunLive, live, message))
}

async fn find_run(executor: impl SqliteExecutor<'_>, run: RunId) -> Result<Option<TrainingRun>> {
    let row = sqlx::query(select!("WHERE runs.id = ?"))
        .bind(run.to_string())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    row.as_ref().map(read_run).transpose()
}

/// The run, if it is one of that camera.
fn run_of(found: Option<TrainingRun>, camera: &CameraId, run: RunId) -> Result<TrainingRun> {
    found.filter(|found| found.camera_id == *camera).ok_or_else(|| no_run(run))
}

fn read_run(row: &SqliteRow) -> Result<TrainingRun> {
    let mut fields = RowDecoder::new("training_runs", row);
    Ok(TrainingRun {
        id: RunId(fields.parse(Uuid::parse_str)?),
        camera_id: fields.parse(CameraId::new)?,
        options: TrainingOptions {
            recipe: fields.parse(|name: &str| name.parse::<Recipe>())?,
            seed: fields.get::<i64>()?.cast_unsigned(),
            epochs: fields.optional_count()?,
            from: fields.optional_timestamp()?,
            until: fields.optional_timestamp()?,
        },
        state: fields.parse(read_state)?,
        attempt: fields.count()?,
        progress: RunProgress {
            phase: fields.get()?,
            epoch: fields.count()?,
            epochs: fields.count()?,
            reconstruction_error: fields.nullable_f64()?,
            regression_error: fields.nullable_f64()?,
            error_scale: fields.nullable_f64()?,
            remaining_s: fields.get()?,
        },
        model_version: fields.optional_count()?,
        // A model whose metadata are damaged is reported where the model is read.
        report: fields.get::<Option<String>>()?.and_then(|report| serde_json::from_str(&report).ok()),
        outcome: fields.get()?,
        created_at: fields.timestamp()?,
        started_at: fields.optional_timestamp()?,
        ended_at: fields.optional_timestamp()?,
    })
}
