//! Training runs of sites: jobs whose output is a model version of each camera.

use std::time::Duration;

use jiff::Timestamp;

use super::idempotency::{find_answer, insert_answer, lock_key};
use super::jobs::SITE_RUNS;
use super::models::{activate, add_model};
use super::retention::prune_models;
use crate::database::Database;
use crate::domain::{
    AuditAction, Error, Result, RunId, RunProgress, SiteId, SiteTrainingOptions, SiteTrainingReport,
    SiteTrainingRun,
};
use crate::jobs::{Claim, Heartbeat, JobEnd};
use crate::query::{RowLock, Session, query, query_as, query_scalar};
use crate::refusals::{no_run, no_site};
use crate::rows::audit::{Change, version};
use crate::rows::idempotency::IdempotencyRecord;
use crate::rows::site_runs::{
    SiteCameraOutput, SiteRunEnd, SiteRunOutput, check_no_live_site_run, check_site_run_not_ended,
    conflict_of, read_site_run, select_site_runs as select, site_run_of,
};

impl Database {
    pub(crate) async fn insert_site_run(
        &self,
        run: RunId,
        site: &SiteId,
        options: &SiteTrainingOptions,
        max_live: u32,
        record: Option<&IdempotencyRecord>,
        now: Timestamp,
    ) -> Result<SiteTrainingRun> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_site(&mut transaction, site).await?;
        if let Some(record) = record {
            let caller = (&*self.actor, &record.key);
            lock_key(&mut transaction, caller).await?;
            if let Some(answer) = find_answer(&mut transaction, self.limits(), caller, now).await? {
                let first = answer.to_request(&record.digest)?.parse()?;
                return site_run_of(find_run(&mut transaction, first).await?, site, first);
            }
            insert_answer(&mut transaction, self.limits(), (&self.actor, record), &run.to_string(), now)
                .await?;
        }
        SITE_RUNS.prune_ended(&mut transaction, key, self.limits().ended_runs_per_camera).await?;
        check_no_live_site_run(SITE_RUNS.live_of(&mut transaction, key).await?)?;
        SITE_RUNS.check_capacity(&mut transaction, max_live).await?;
        query(
            "INSERT INTO site_training_runs (id, site_key, seed, from_us, until_us, state, created_at_us) \
             VALUES ($1, $2, $3, $4, $5, 'queued', $6)",
        )
        .bind(run.to_string())
        .bind(key)
        .bind(options.seed.cast_signed())
        .bind(options.from.map(Timestamp::as_microsecond))
        .bind(options.until.map(Timestamp::as_microsecond))
        .bind(now.as_microsecond())
        .execute(&mut transaction)
        .await?;
        self.record(&mut transaction, change(AuditAction::SiteRunStarted, site, run), now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
        stored.ok_or_else(|| no_run(run))
    }

    pub(crate) async fn site_run(&self, site: &SiteId, run: RunId) -> Result<SiteTrainingRun> {
        let mut reader = self.reader().await?;
        site_key(&mut reader, site).await?;
        site_run_of(find_run(&mut reader, run).await?, site, run)
    }

    pub(crate) async fn site_runs(
        &self,
        site: &SiteId,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Vec<SiteTrainingRun>> {
        let mut reader = self.reader().await?;
        let key = site_key(&mut reader, site).await?;
        // "~" sorts after all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |run| run.to_string());
        let rows = query(select!("WHERE runs.site_key = $1 AND runs.id < $2 ORDER BY runs.id DESC LIMIT $3"))
            .bind(key)
            .bind(before)
            .bind(limit)
            .fetch_all(&mut reader)
            .await?;
        rows.iter().map(read_site_run).collect()
    }

    pub(crate) async fn claim_site_run(
        &self,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<SiteTrainingRun>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(claim) = SITE_RUNS.claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let id = RunId(claim.job);
        let job = find_run(&mut transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    pub(crate) async fn heartbeat_site_run(
        &self,
        run: RunId,
        fence: i64,
        progress: &RunProgress,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        let heartbeat = SITE_RUNS.heartbeat(&mut transaction, (run.0, fence), lease, now).await?;
        if heartbeat == Heartbeat::Lost {
            return Ok(heartbeat);
        }
        SITE_RUNS.record_progress(&mut transaction, run.0, progress).await?;
        transaction.commit().await?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_site_run(
        &self,
        site: &SiteId,
        run: RunId,
        now: Timestamp,
    ) -> Result<SiteTrainingRun> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        site_key(&mut transaction, site).await?;
        SITE_RUNS.lock(&mut transaction, run.0).await?;
        let stored = site_run_of(find_run(&mut transaction, run).await?, site, run)?;
        check_site_run_not_ended(&stored)?;
        SITE_RUNS.cancel(&mut transaction, run.0, now).await?;
        self.record(&mut transaction, change(AuditAction::SiteRunCancelled, site, run), now).await?;
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
        stored.ok_or_else(|| no_run(run))
    }

    pub(crate) async fn finish_site_run(
        &self,
        run: RunId,
        fence: i64,
        end: SiteRunEnd<'_>,
        now: Timestamp,
    ) -> Result<Option<SiteTrainingRun>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let end = without_conflict(&mut transaction, (run, fence), end).await?;
        let Some(finished) = SITE_RUNS.finish(&mut transaction, (run.0, fence), end, now).await? else {
            return Ok(None);
        };
        if let Some(SiteRunOutput { mut report, models }) = finished.output {
            let activates = report.is_activated;
            for (output, finding) in models.iter().zip(&mut report.cameras) {
                finding.model_version = self.add_site_model(&mut transaction, output, activates, now).await?;
            }
            store_report(&mut transaction, run, &report).await?;
        }
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
        Ok(stored)
    }

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
    let Some((site_key, _)) = SITE_RUNS.owns_lease(session, (run.0, fence)).await? else { return Ok(end) };
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

fn change(action: AuditAction, site: &SiteId, run: RunId) -> Change<'static> {
    Change::of(action, format!("site {site}, training run {run}"))
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

async fn find_run(session: &mut dyn Session, run: RunId) -> Result<Option<SiteTrainingRun>> {
    let row = query(select!("WHERE runs.id = $1")).bind(run.to_string()).fetch_optional(session).await?;
    row.as_ref().map(read_site_run).transpose()
}
