//! Training runs of a site: their output is a model version of each camera.

use jiff::Timestamp;

use super::jobs::Jobs;
use super::models::{activate, add_model};
use super::retention::prune_models;
use super::runs::RunSubject;
use crate::database::Database;
use crate::domain::{AuditAction, Error, Result, RunId, SiteId, SiteTrainingOptions, SiteTrainingReport};
use crate::jobs::{JobEnd, SITE_RUNS};
use crate::query::{Query, RowLock, Session, query, query_as, query_scalar};
use crate::refusals::no_site;
use crate::row_decoder::StoredRow;
use crate::rows::audit::{Change, version};
use crate::rows::site_runs::{SiteCameraOutput, SiteRunEnd, SiteRunOutput, conflict_of};

impl RunSubject for SiteId {
    type Output<'a> = SiteRunOutput<'a>;

    const ACTIONS: [AuditAction; 2] = [AuditAction::SiteRunStarted, AuditAction::SiteRunCancelled];

    async fn key(&self, session: &mut dyn Session) -> Result<i64> {
        site_key(session, self).await
    }

    async fn lock(&self, session: &mut dyn Session) -> Result<i64> {
        lock_site(session, self).await
    }

    fn insert(run: RunId, key: i64, options: &SiteTrainingOptions, _priority: i64) -> Query<StoredRow> {
        query(
            "INSERT INTO site_training_runs (id, site_key, seed, from_us, until_us, state, created_at_us) \
             VALUES ($1, $2, $3, $4, $5, 'queued', $6)",
        )
        .bind(run.to_string())
        .bind(key)
        .bind(options.seed.cast_signed())
        .bind(options.from.map(Timestamp::as_microsecond))
        .bind(options.until.map(Timestamp::as_microsecond))
    }

    fn change(&self, action: AuditAction, run: RunId) -> Change<'_> {
        Change::of(action, format!("site {self}, training run {run}"))
    }

    async fn prepare_end<'a>(
        session: &mut dyn Session,
        claimed: (RunId, i64),
        end: JobEnd<Self::Output<'a>>,
    ) -> Result<JobEnd<Self::Output<'a>>> {
        without_conflict(session, claimed, end).await
    }

    async fn store_output(
        database: &Database,
        session: &mut dyn Session,
        (run, _): (RunId, i64),
        SiteRunOutput { mut report, models }: Self::Output<'_>,
        now: Timestamp,
    ) -> Result<()> {
        let activates = report.is_activated;
        for (output, finding) in models.iter().zip(&mut report.cameras) {
            finding.model_version = database.add_site_model(session, output, activates, now).await?;
        }
        store_report(session, run, &report).await
    }
}

impl Database {
    /// Stores the model of one camera, and activates it where the set is; returns its number.
    async fn add_site_model(
        &self,
        session: &mut dyn Session,
        output: &SiteCameraOutput<'_>,
        activates: bool,
        now: Timestamp,
    ) -> Result<u32> {
        let key = output.key.0;
        let number = add_model(session, key, None, &output.model, now).await?;
        if activates {
            activate(session, key, number, now).await?;
            let change = Change::of_camera(AuditAction::ModelActivated, output.camera, Some(version(number)));
            self.record(session, change, now).await?;
        }
        prune_models(session, key, self.limits().models_per_camera).await?;
        Ok(number)
    }
}

/// A success becomes a failure where the cameras are not what they were when the run read them.
async fn without_conflict<'a>(
    session: &mut dyn Session,
    (run, fence): (RunId, i64),
    end: SiteRunEnd<'a>,
) -> Result<SiteRunEnd<'a>> {
    let JobEnd::Succeeded { output, .. } = &end else { return Ok(end) };
    let mut keys: Vec<i64> = output.models.iter().map(|output| output.key.0).collect();
    keys.sort_unstable();
    for key in keys {
        let camera = query("SELECT key FROM cameras WHERE key = $1").bind(key);
        camera.locking(RowLock::NoKeyUpdate).execute(session).await?;
    }
    let Some((site_key, _)) = Jobs(&SITE_RUNS).owns_lease(session, (run.0, fence)).await? else {
        return Ok(end);
    };
    for output in &output.models {
        let stored = query_as("SELECT site_key, active_model FROM cameras WHERE key = $1")
            .bind(output.key.0)
            .fetch_optional(session)
            .await?;
        if let Some(outcome) = conflict_of(output, stored, site_key) {
            return Ok(JobEnd::Failed { outcome });
        }
    }
    Ok(end)
}

async fn store_report(session: &mut dyn Session, run: RunId, report: &SiteTrainingReport) -> Result<()> {
    query("UPDATE site_training_runs SET report = $1 WHERE id = $2")
        .bind(serde_json::to_string(report).map_err(Error::fault)?)
        .bind(run.to_string())
        .execute(session)
        .await?;
    Ok(())
}

async fn site_key(session: &mut dyn Session, id: &SiteId) -> Result<i64> {
    query_scalar("SELECT key FROM sites WHERE id = $1")
        .bind(id.as_str())
        .fetch_optional(session)
        .await?
        .ok_or_else(|| no_site(id))
}

/// As [`site_key`]; no other transaction queues a run of the site until this one ends.
async fn lock_site(session: &mut dyn Session, id: &SiteId) -> Result<i64> {
    query_scalar("SELECT key FROM sites WHERE id = $1")
        .locking(RowLock::NoKeyUpdate)
        .bind(id.as_str())
        .fetch_optional(session)
        .await?
        .ok_or_else(|| no_site(id))
}
