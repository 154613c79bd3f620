//! Rows of training runs, and what finishes them.

use sqlx::AssertSqlSafe;
use uuid::Uuid;

use super::models::NewModel;
use crate::domain::{
    CameraId, Error, ErrorKind, Recipe, Result, RunId, RunProgress, TrainingOptions, TrainingRun,
};
use crate::jobs::{JobEnd, job_state, read_state};
use crate::query::Dialect;
use crate::refusals::no_run;
use crate::row_decoder::{RowDecoder, StoredRow};

/// Lines kept in a run's log; older ones are deleted.
pub(crate) const LOG_LINES: i64 = 1_000;

/// Bytes kept of one line; the rest is cut off.
pub(crate) const LINE_BYTES: usize = 4_000;

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

/// A statement for [`read_run`].
pub(crate) fn select_runs(dialect: Dialect, rest: &'static str) -> AssertSqlSafe<String> {
    AssertSqlSafe(format!(
        "SELECT runs.id, cameras.id, runs.recipe, runs.seed, runs.epochs, runs.from_us, runs.until_us, {}, \
         runs.attempt, runs.phase, runs.epoch_done, runs.epochs_planned, \
         runs.reconstruction_error, runs.regression_error, runs.error_scale, runs.remaining_s, \
         runs.model_version, (SELECT {} FROM models WHERE models.camera_key = runs.camera_key \
         AND models.number = runs.model_version), runs.outcome, runs.created_at_us, runs.started_at_us, \
         runs.ended_at_us FROM training_runs AS runs JOIN cameras ON cameras.key = runs.camera_key {rest}",
        job_state!("runs"),
        dialect.training_report()
    ))
}

/// The run, if it is one of that camera.
pub(crate) fn run_of(found: Option<TrainingRun>, camera: &CameraId, run: RunId) -> Result<TrainingRun> {
    found.filter(|found| found.camera_id == *camera).ok_or_else(|| no_run(run))
}

pub(crate) fn read_run(row: &StoredRow) -> Result<TrainingRun> {
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

/// A camera has one live run at most.
pub(crate) fn check_no_live_run(live: Option<String>) -> Result<()> {
    let Some(live) = live else { return Ok(()) };
    let message =
        format!("the camera has training run {live}, which has not ended; wait for it or cancel it");
    Err(Error::conflict(ErrorKind::RunLive, live, message))
}

/// Refuses to cancel a run that has ended.
pub(crate) fn check_not_ended(run: &TrainingRun) -> Result<()> {
    if !run.state.has_ended() {
        return Ok(());
    }
    let ended = format!("the training run has ended already: {}", run.state.as_str());
    Err(Error::refused(ErrorKind::RunEnded, ended))
}
