//! Training runs of a camera: their output is one model version.

use jiff::Timestamp;

use super::cameras::{camera_key, lock_camera};
use super::models::{activate, add_model};
use super::retention::prune_models;
use super::runs::{RunSubject, find_run};
use crate::database::Database;
use crate::domain::{AuditAction, CameraId, Result, RunId, TrainingOptions, TrainingRun};
use crate::jobs::JobEnd;
use crate::query::{Query, RowLock, Session, query};
use crate::row_decoder::StoredRow;
use crate::rows::audit::{Change, version};
use crate::rows::runs::RunOutput;

impl RunSubject for CameraId {
    type Output<'a> = RunOutput<'a>;

    const ACTIONS: [AuditAction; 2] = [AuditAction::RunStarted, AuditAction::RunCancelled];

    async fn key(&self, session: &mut dyn Session) -> Result<i64> {
        camera_key(session, self).await
    }

    async fn lock(&self, session: &mut dyn Session) -> Result<i64> {
        lock_camera(session, self).await
    }

    fn insert(run: RunId, key: i64, options: &TrainingOptions, priority: i64) -> Query<StoredRow> {
        query(
            "INSERT INTO training_runs (id, camera_key, recipe, seed, epochs, from_us, until_us, state, priority, \
             created_at_us) VALUES ($1, $2, $3, $4, $5, $6, $7, 'queued', $8, $9)",
        )
        .bind(run.to_string())
        .bind(key)
        .bind(options.recipe.as_str())
        .bind(options.seed.cast_signed())
        .bind(options.epochs)
        .bind(options.from.map(Timestamp::as_microsecond))
        .bind(options.until.map(Timestamp::as_microsecond))
        .bind(priority)
    }

    fn change(&self, action: AuditAction, run: RunId) -> Change<'_> {
        Change::of_camera(action, self, Some(run.to_string()))
    }

    /// The camera is locked first, as in every change of a camera's runs.
    async fn prepare_end<'a>(
        session: &mut dyn Session,
        (run, _): (RunId, i64),
        end: JobEnd<Self::Output<'a>>,
    ) -> Result<JobEnd<Self::Output<'a>>> {
        query("SELECT key FROM cameras WHERE key = (SELECT camera_key FROM training_runs WHERE id = $1)")
            .bind(run.to_string())
            .locking(RowLock::NoKeyUpdate)
            .execute(session)
            .await?;
        Ok(end)
    }

    async fn store_output(
        database: &Database,
        session: &mut dyn Session,
        (run, key): (RunId, i64),
        RunOutput { model, activate: wanted }: Self::Output<'_>,
        now: Timestamp,
    ) -> Result<()> {
        let number = add_model(session, key, Some(run), &model, now).await?;
        if wanted {
            activate(session, key, number, now).await?;
        }
        prune_models(session, key, database.limits().models_per_camera).await?;
        query("UPDATE training_runs SET model_version = $1 WHERE id = $2")
            .bind(number)
            .bind(run.to_string())
            .execute(session)
            .await?;
        let stored: Option<TrainingRun<Self>> = find_run(session, run).await?;
        if let Some(stored) = stored.filter(|_| wanted) {
            let subject = Some(version(number));
            let change = Change::of_camera(AuditAction::ModelActivated, &stored.subject, subject);
            database.record(session, change, now).await?;
        }
        Ok(())
    }
}
