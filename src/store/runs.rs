//! Training runs as jobs: whoever claims one holds a lease and a fence.
//!
//! A worker that stops beating loses its lease; the next claim raises the fence, and whatever the old
//! worker still writes is left out. So a run ends exactly once, whatever crashes.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use sqlx::sqlite::SqliteRow;
use sqlx::{SqliteConnection, SqliteExecutor};
use uuid::Uuid;

use super::Store;
use super::cameras::camera_key;
use super::faults::{failed, no_run};
use super::fields::Fields;
use super::models::{activate, add_model};
use crate::domain::{
    CameraId, Error, ErrorKind, ModelMetadata, Recipe, Result, RunId, RunProgress, RunState, TrainingOptions,
    TrainingRun,
};

/// A run that was taken up.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// The run, now running.
    pub run: TrainingRun,
    /// What the worker must show to write anything about it.
    pub fence: i64,
    /// The operator has asked for its end already, while an earlier worker held it.
    pub cancel_requested: bool,
}

/// What a worker learns from its heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    /// The lease is prolonged.
    Continue,
    /// The lease is prolonged, and the operator wants the run to end.
    CancelRequested,
    /// The run belongs to another worker now, has ended, or is gone: stop.
    Lost,
}

/// How a worker leaves a run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEnd<'a> {
    /// With a model.
    Succeeded {
        /// What the model says of itself.
        metadata: &'a ModelMetadata,
        /// Its weights.
        weights: &'a [u8],
        /// Whether it shall answer from now on.
        activate: bool,
        /// Why or why not.
        outcome: String,
    },
    /// By an error.
    Failed {
        /// Which.
        outcome: String,
    },
    /// By the operator.
    Cancelled,
    /// Unfinished, because the server ends: the next worker takes it up at once.
    Requeue,
}

macro_rules! select {
    ($rest:literal) => {
        concat!(
            "SELECT runs.id, cameras.id, runs.recipe, runs.seed, runs.epochs, runs.from_us, runs.until_us, \
             runs.state, runs.attempt, runs.phase, runs.epoch_done, runs.epochs_planned, \
             runs.reconstruction_error, runs.regression_error, runs.error_scale, runs.remaining_s, \
             runs.model_version, runs.outcome, runs.created_at_us, runs.started_at_us, runs.ended_at_us \
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
        let mut turn = self.synced().await?;
        let mut transaction = turn.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        check_live_runs(&mut transaction, key, max_live).await?;
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

    /// Takes up the oldest run that is queued or whose worker has stopped beating. Its attempt and
    /// fence go up by one; its curve and progress begin anew.
    ///
    /// # Errors
    /// Faults only.
    pub async fn claim_run(&self, lease: Duration, now: Timestamp) -> Result<Option<Claim>> {
        let mut turn = self.synced().await?;
        let mut transaction = turn.begin().await?;
        let claimed: Option<(String, i64, i64)> = sqlx::query_as(
            "UPDATE training_runs SET state = 'running', attempt = attempt + 1, fence = fence + 1, \
             lease_until_us = ?, started_at_us = ?, phase = '', epoch_done = 0, epochs_planned = 0, \
             reconstruction_error = 0, regression_error = 0, error_scale = 0, remaining_s = NULL \
             WHERE id = (SELECT id FROM training_runs WHERE state IN ('queued', 'running') \
             AND (lease_until_us IS NULL OR lease_until_us <= ?) ORDER BY id LIMIT 1) \
             RETURNING id, fence, cancel_requested",
        )
        .bind(lease_end(now, lease))
        .bind(now.as_microsecond())
        .bind(now.as_microsecond())
        .fetch_optional(&mut *transaction)
        .await
        .map_err(failed)?;
        let Some((id, fence, cancel_requested)) = claimed else { return Ok(None) };
        sqlx::query("DELETE FROM training_epochs WHERE run_id = ?")
            .bind(&id)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let id: RunId = id.parse()?;
        let run = find_run(&mut *transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(Claim { run, fence, cancel_requested: cancel_requested != 0 }))
    }

    /// Prolongs the lease and shows how far the run has come.
    ///
    /// # Errors
    /// Faults only.
    pub async fn heartbeat(
        &self,
        run: RunId,
        fence: i64,
        progress: &RunProgress,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut turn = self.relaxed().await?;
        let mut transaction = turn.begin().await?;
        let cancel_requested: Option<i64> = sqlx::query_scalar(
            "UPDATE training_runs SET lease_until_us = ?, phase = ?, epoch_done = ?, epochs_planned = ?, \
             reconstruction_error = ?, regression_error = ?, error_scale = ?, remaining_s = ? \
             WHERE id = ? AND fence = ? AND state = 'running' RETURNING cancel_requested",
        )
        .bind(lease_end(now, lease))
        .bind(&progress.phase)
        .bind(progress.epoch)
        .bind(progress.epochs)
        .bind(progress.reconstruction_error)
        .bind(progress.regression_error)
        .bind(progress.error_scale)
        .bind(progress.remaining_s)
        .bind(run.to_string())
        .bind(fence)
        .fetch_optional(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(match cancel_requested {
            None => Heartbeat::Lost,
            Some(0) => Heartbeat::Continue,
            Some(_) => Heartbeat::CancelRequested,
        })
    }

    /// Asks for the end of a run: a queued one ends at once, a running one at its worker's next
    /// heartbeat. Once this has returned, the run yields no model any more.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunNotFound`], [`ErrorKind::RunEnded`].
    pub async fn request_cancel(&self, camera: &CameraId, run: RunId, now: Timestamp) -> Result<TrainingRun> {
        let mut turn = self.synced().await?;
        let mut transaction = turn.begin().await?;
        camera_key(&mut *transaction, camera).await?;
        let stored = run_of(find_run(&mut *transaction, run).await?, camera, run)?;
        if stored.state.has_ended() {
            let ended = format!("the training run has ended already: {}", stored.state.as_str());
            return Err(Error::refused(ErrorKind::RunEnded, ended));
        }
        if stored.state == RunState::Queued {
            end_run(&mut transaction, run, RunState::Cancelled, None, None, now).await?;
        }
        sqlx::query("UPDATE training_runs SET cancel_requested = 1 WHERE id = ?")
            .bind(run.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let stored = find_run(&mut *transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        stored.ok_or_else(|| no_run(run))
    }

    /// Ends a run, or gives it back, if the worker still holds it; `None` if it lost it, and then
    /// nothing was changed. The model, its activation and the run's state are one transaction. A run
    /// whose end the operator has asked for is cancelled even if it succeeded or was given back.
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
        let mut turn = self.synced().await?;
        let mut transaction = turn.begin().await?;
        let held: Option<(i64, i64)> = sqlx::query_as(
            "SELECT camera_key, cancel_requested FROM training_runs \
             WHERE id = ? AND fence = ? AND state = 'running'",
        )
        .bind(run.to_string())
        .bind(fence)
        .fetch_optional(&mut *transaction)
        .await
        .map_err(failed)?;
        let Some((key, cancel_requested)) = held else { return Ok(None) };
        let end = match end {
            RunEnd::Succeeded { .. } | RunEnd::Requeue if cancel_requested != 0 => RunEnd::Cancelled,
            end => end,
        };
        match end {
            RunEnd::Succeeded { metadata, weights, activate: wanted, outcome } => {
                let number = add_model(&mut transaction, key, Some(run), metadata, weights, now).await?;
                if wanted {
                    activate(&mut transaction, key, number, now).await?;
                }
                end_run(&mut transaction, run, RunState::Succeeded, Some(number), Some(outcome), now).await?;
            }
            RunEnd::Failed { outcome } => {
                end_run(&mut transaction, run, RunState::Failed, None, Some(outcome), now).await?;
            }
            RunEnd::Cancelled => {
                end_run(&mut transaction, run, RunState::Cancelled, None, None, now).await?;
            }
            RunEnd::Requeue => requeue(&mut transaction, run).await?,
        }
        let stored = find_run(&mut *transaction, run).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(stored)
    }
}

/// Room for one more live run, of this camera and of all.
async fn check_live_runs(connection: &mut SqliteConnection, camera_key: i64, max_live: u32) -> Result<()> {
    let (all, own): (i64, i64) = sqlx::query_as(
        "SELECT count(*), count(CASE WHEN camera_key = ? THEN 1 END) FROM training_runs \
         WHERE state IN ('queued', 'running')",
    )
    .bind(camera_key)
    .fetch_one(connection)
    .await
    .map_err(failed)?;
    if own > 0 {
        return Err(Error::refused(
            ErrorKind::RunLive,
            "the camera has a training run that has not ended; wait for it or cancel it",
        ));
    }
    if all >= i64::from(max_live) {
        return Err(Error::refused(
            ErrorKind::Overloaded,
            format!(
                "{all} training runs are queued or running, and no more than {max_live} may be; try later"
            ),
        ));
    }
    Ok(())
}

async fn end_run(
    connection: &mut SqliteConnection,
    run: RunId,
    state: RunState,
    model_version: Option<u32>,
    outcome: Option<String>,
    now: Timestamp,
) -> Result<()> {
    sqlx::query(
        "UPDATE training_runs SET state = ?, model_version = ?, outcome = ?, ended_at_us = ?, \
         lease_until_us = NULL, remaining_s = NULL WHERE id = ?",
    )
    .bind(state.as_str())
    .bind(model_version)
    .bind(outcome)
    .bind(now.as_microsecond())
    .bind(run.to_string())
    .execute(connection)
    .await
    .map_err(failed)?;
    Ok(())
}

async fn requeue(connection: &mut SqliteConnection, run: RunId) -> Result<()> {
    sqlx::query("UPDATE training_runs SET state = 'queued', lease_until_us = NULL WHERE id = ?")
        .bind(run.to_string())
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}

fn lease_end(now: Timestamp, lease: Duration) -> i64 {
    let lease = SignedDuration::try_from(lease).unwrap_or(SignedDuration::MAX);
    now.saturating_add(lease).unwrap_or(Timestamp::MAX).as_microsecond()
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
    let mut fields = Fields::of("training_runs", row);
    Ok(TrainingRun {
        id: RunId(fields.make(Uuid::parse_str)?),
        camera_id: fields.make(CameraId::new)?,
        options: TrainingOptions {
            recipe: fields.make(|name: &str| name.parse::<Recipe>())?,
            seed: fields.take::<i64>()?.cast_unsigned(),
            epochs: fields.some_count()?,
            from: fields.some_time()?,
            until: fields.some_time()?,
        },
        state: fields.make(read_state)?,
        attempt: fields.count()?,
        progress: RunProgress {
            phase: fields.take()?,
            epoch: fields.count()?,
            epochs: fields.count()?,
            reconstruction_error: fields.number()?,
            regression_error: fields.number()?,
            error_scale: fields.number()?,
            remaining_s: fields.take()?,
        },
        model_version: fields.some_count()?,
        outcome: fields.take()?,
        created_at: fields.time()?,
        started_at: fields.some_time()?,
        ended_at: fields.some_time()?,
    })
}

fn read_state(name: &str) -> Result<RunState, &'static str> {
    RunState::ALL.into_iter().find(|state| state.as_str() == name).ok_or("no state of a training run")
}
