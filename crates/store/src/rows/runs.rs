//! Rows of training runs, and what finishes them.

use sqlx::AssertSqlSafe;
use uuid::Uuid;

use super::models::NewModel;
use crate::domain::{
    CameraId, Recipe, Result, RunId, RunProgress, TrainingOptions, TrainingReport, TrainingRun,
    TrainingSubject,
};
use crate::jobs::{JobEnd, JobTable, RUNS, job_state, read_state};
use crate::query::Dialect;
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
    /// True if it becomes the active version in the same transaction.
    pub activate: bool,
}

/// How a worker finishes a run.
pub type RunEnd<'a> = JobEnd<RunOutput<'a>>;

/// How a subject's runs are read.
pub trait ReadRun: TrainingSubject + Clone + PartialEq + Send + Sync + 'static {
    /// The table of its runs.
    #[doc(hidden)]
    const JOBS: &'static JobTable;
    /// The name of such a run in messages.
    #[doc(hidden)]
    const KIND: &'static str;
    /// Its own table.
    #[doc(hidden)]
    const SUBJECTS: &'static str;
    /// The columns of [`ReadRun::read_options`].
    #[doc(hidden)]
    const OPTIONS: &'static str;

    /// Expressions for the model version and the report of a run.
    #[doc(hidden)]
    fn results(dialect: Dialect) -> String;

    #[doc(hidden)]
    fn read_subject(fields: &mut RowDecoder<'_>) -> Result<Self>;

    #[doc(hidden)]
    fn read_options(fields: &mut RowDecoder<'_>) -> Result<Self::Options>;

    #[doc(hidden)]
    fn read_report(fields: &mut RowDecoder<'_>) -> Result<Option<Self::Report>>;
}

impl ReadRun for CameraId {
    const JOBS: &'static JobTable = &RUNS;
    const KIND: &'static str = "camera";
    const SUBJECTS: &'static str = "cameras";
    const OPTIONS: &'static str = "runs.recipe, runs.seed, runs.epochs, runs.from_us, runs.until_us";

    fn results(dialect: Dialect) -> String {
        format!(
            "runs.model_version, (SELECT {} FROM models WHERE models.camera_key = runs.camera_key \
             AND models.number = runs.model_version)",
            dialect.training_report()
        )
    }

    fn read_subject(fields: &mut RowDecoder<'_>) -> Result<Self> {
        fields.parse(Self::new)
    }

    fn read_options(fields: &mut RowDecoder<'_>) -> Result<TrainingOptions> {
        Ok(TrainingOptions {
            recipe: fields.parse(|name: &str| name.parse::<Recipe>())?,
            seed: fields.get::<i64>()?.cast_unsigned(),
            epochs: fields.optional_count()?,
            from: fields.optional_timestamp()?,
            until: fields.optional_timestamp()?,
        })
    }

    /// A model whose metadata are damaged is reported where the model is read.
    fn read_report(fields: &mut RowDecoder<'_>) -> Result<Option<TrainingReport>> {
        Ok(fields.get::<Option<String>>()?.and_then(|report| serde_json::from_str(&report).ok()))
    }
}

/// A statement for [`read_run`].
pub(crate) fn select_runs<S: ReadRun>(dialect: Dialect, rest: &str) -> AssertSqlSafe<String> {
    let JobTable { table, owner, .. } = S::JOBS;
    AssertSqlSafe(format!(
        "SELECT runs.id, subjects.id, {}, {}, runs.attempt, runs.phase, runs.epoch_done, runs.epochs_planned, \
         runs.reconstruction_error, runs.regression_error, runs.error_scale, runs.remaining_s, {}, runs.outcome, \
         runs.created_at_us, runs.started_at_us, runs.ended_at_us \
         FROM {table} AS runs JOIN {} AS subjects ON subjects.key = runs.{owner} {rest}",
        S::OPTIONS,
        job_state!("runs"),
        S::results(dialect),
        S::SUBJECTS
    ))
}

pub(crate) fn read_run<S: ReadRun>(row: &StoredRow) -> Result<TrainingRun<S>> {
    let mut fields = RowDecoder::new(S::JOBS.table, row);
    Ok(TrainingRun {
        id: RunId(fields.parse(Uuid::parse_str)?),
        subject: S::read_subject(&mut fields)?,
        options: S::read_options(&mut fields)?,
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
        report: S::read_report(&mut fields)?,
        outcome: fields.get()?,
        created_at: fields.timestamp()?,
        started_at: fields.optional_timestamp()?,
        ended_at: fields.optional_timestamp()?,
    })
}
