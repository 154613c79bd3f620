//! The statements that the tables of background jobs have in common.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::AssertSqlSafe;
use uuid::Uuid;

use crate::database::Database;
use crate::domain::{Error, JobState, Result, RunProgress};
use crate::jobs::{
    self, COUNT_JOBS, Claim, Finished, Heartbeat, JobCounts, JobEnd, JobTable, Settled, lease_expired,
    lease_us,
};
use crate::locks::{Limit, lock_limit};
use crate::query::{RowLock, Session, query, query_as, query_scalar};

pub(super) const EVALUATIONS: Jobs = Jobs(&jobs::EVALUATIONS);

impl Database {
    pub(crate) async fn job_counts(&self) -> Result<JobCounts> {
        let mut reader = self.reader().await?;
        let rows: Vec<(String, String, i64)> = query_as(COUNT_JOBS).fetch_all(&mut reader).await?;
        Ok(JobCounts::of(&rows))
    }
}

/// The statements of a table of jobs.
#[derive(Clone, Copy)]
pub(super) struct Jobs(pub(super) &'static JobTable);

impl Jobs {
    /// Refuses one job more than `max_live` that have not ended.
    pub(super) async fn check_capacity(&self, session: &mut dyn Session, max_live: u32) -> Result<()> {
        let table = self.0.table;
        lock_limit(session, Limit::Jobs).await?;
        let sql = format!("SELECT count(*) FROM {table} WHERE state IN ('queued', 'running')");
        let live: i64 = query_scalar(AssertSqlSafe(sql)).fetch_one(session).await?;
        self.0.check_capacity(live, max_live)
    }

    /// Waits until no other transaction changes a job.
    pub(super) async fn lock(&self, session: &mut dyn Session, id: Uuid) -> Result<()> {
        let sql = format!("SELECT id FROM {} WHERE id = $1", self.0.table);
        query(AssertSqlSafe(sql)).bind(id.to_string()).locking(RowLock::Update).execute(session).await?;
        Ok(())
    }

    /// The job of this owner that has not ended.
    pub(super) async fn live_of(&self, session: &mut dyn Session, owner_key: i64) -> Result<Option<String>> {
        let JobTable { table, owner, .. } = self.0;
        let sql = format!("SELECT id FROM {table} WHERE {owner} = $1 AND state IN ('queued', 'running')");
        query_scalar(AssertSqlSafe(sql)).bind(owner_key).fetch_optional(session).await
    }

    /// Deletes the oldest ended jobs of an owner beyond a number.
    pub(super) async fn prune_ended(
        &self,
        session: &mut dyn Session,
        owner_key: i64,
        keep: u32,
    ) -> Result<()> {
        let JobTable { table, owner, .. } = self.0;
        let sql = format!(
            "DELETE FROM {table} WHERE {owner} = $1 AND state NOT IN ('queued', 'running') \
             AND id <= (SELECT id FROM {table} WHERE {owner} = $1 AND state NOT IN ('queued', 'running') \
             ORDER BY id DESC LIMIT 1 OFFSET $2)"
        );
        query(AssertSqlSafe(sql)).bind(owner_key).bind(keep).execute(session).await?;
        Ok(())
    }

    /// Stores the progress of a training run.
    pub(super) async fn record_progress(
        &self,
        session: &mut dyn Session,
        id: Uuid,
        progress: &RunProgress,
    ) -> Result<()> {
        let sql = format!(
            "UPDATE {} SET phase = $1, epoch_done = $2, epochs_planned = $3, \
             reconstruction_error = $4, regression_error = $5, error_scale = $6, remaining_s = $7 \
             WHERE id = $8",
            self.0.table
        );
        query(AssertSqlSafe(sql))
            .bind(&progress.phase)
            .bind(progress.epoch)
            .bind(progress.epochs)
            .bind(progress.reconstruction_error)
            .bind(progress.regression_error)
            .bind(progress.error_scale)
            .bind(progress.remaining_s)
            .bind(id.to_string())
            .execute(session)
            .await?;
        Ok(())
    }

    /// Claims the job that comes first of those that are queued or whose lease has expired. Attempt and fence go up by one;
    /// the progress is reset. Jobs that another transaction is claiming are passed over. In PostgreSQL the lease
    /// is counted by the database's clock, and `now` is when the job began for those who look at it.
    pub(super) async fn claim(
        &self,
        session: &mut dyn Session,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<Uuid>>> {
        let JobTable { table, reset_progress, order, .. } = self.0;
        let dialect = session.dialect();
        let (now_us, skip_locked) = (dialect.now_us("$1"), dialect.skip_locked());
        let expired = lease_expired(now_us);
        let sql = format!(
            "UPDATE {table} SET state = 'running', attempt = attempt + 1, fence = fence + 1, \
             lease_until_us = {now_us} + $2, lease_us = $2, started_at_us = $1, phase = '', remaining_s = NULL, \
             {reset_progress} \
             WHERE id = (SELECT id FROM {table} WHERE state IN ('queued', 'running') AND {expired} \
             ORDER BY {order} LIMIT 1 {skip_locked}) \
             RETURNING id, fence, cancel_requested"
        );
        let claimed: Option<(String, i64, i64)> = query_as(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(lease_us(lease))
            .fetch_optional(session)
            .await?;
        let Some((id, fence, cancel_requested)) = claimed else { return Ok(None) };
        let job = Uuid::parse_str(&id).map_err(Error::fault)?;
        Ok(Some(Claim { job, fence, cancel_requested: cancel_requested != 0 }))
    }

    /// Renews the lease.
    pub(super) async fn heartbeat(
        &self,
        session: &mut dyn Session,
        (id, fence): (Uuid, i64),
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let (table, now_us) = (self.0.table, session.dialect().now_us("$1"));
        let sql = format!(
            "UPDATE {table} SET lease_until_us = {now_us} + $2, lease_us = $2 \
             WHERE id = $3 AND fence = $4 AND state = 'running' RETURNING cancel_requested"
        );
        let cancel_requested: Option<i64> = query_scalar(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(lease_us(lease))
            .bind(id.to_string())
            .bind(fence)
            .fetch_optional(session)
            .await?;
        Ok(match cancel_requested {
            None => Heartbeat::Lost,
            Some(0) => Heartbeat::Continue,
            Some(_) => Heartbeat::CancelRequested,
        })
    }

    /// The key of what the job belongs to, and whether its cancellation was requested, if the fence is still the newest and
    /// the job runs.
    pub(super) async fn owns_lease(
        &self,
        session: &mut dyn Session,
        (id, fence): (Uuid, i64),
    ) -> Result<Option<(i64, bool)>> {
        let sql = format!(
            "SELECT {}, cancel_requested FROM {} WHERE id = $1 AND fence = $2 AND state = 'running'",
            self.0.owner, self.0.table
        );
        let owned: Option<(i64, i64)> = query_as(AssertSqlSafe(sql))
            .bind(id.to_string())
            .bind(fence)
            .locking(RowLock::Update)
            .fetch_optional(session)
            .await?;
        Ok(owned.map(|(owner_key, cancel_requested)| (owner_key, cancel_requested != 0)))
    }

    /// Cancels a job that has not ended: at once where no worker holds a live lease on it, otherwise at
    /// its worker's next heartbeat.
    pub(super) async fn cancel(&self, session: &mut dyn Session, id: Uuid, now: Timestamp) -> Result<()> {
        let (table, expired) = (self.0.table, lease_expired(session.dialect().now_us("$1")));
        let sql = format!(
            "SELECT id FROM {table} WHERE id = $2 AND (state = 'queued' OR (state = 'running' AND {expired}))"
        );
        let unclaimed = query(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(id.to_string())
            .locking(RowLock::Update)
            .fetch_optional(session)
            .await?;
        if unclaimed.is_some() {
            self.end(session, id, JobState::Cancelled, None, now).await?;
        }
        let sql = format!("UPDATE {table} SET cancel_requested = 1 WHERE id = $1");
        query(AssertSqlSafe(sql)).bind(id.to_string()).execute(session).await?;
        Ok(())
    }

    /// Ends a job, or returns it to the queue, if the worker still owns its lease; `None` if it lost it,
    /// and then nothing was changed.
    pub(super) async fn finish<O>(
        &self,
        session: &mut dyn Session,
        (id, fence): (Uuid, i64),
        end: JobEnd<O>,
        now: Timestamp,
    ) -> Result<Option<Finished<O>>> {
        let Some((owner_key, cancel_requested)) = self.owns_lease(session, (id, fence)).await? else {
            return Ok(None);
        };
        let Settled { state, outcome, output } = end.settle(cancel_requested);
        match state {
            Some(state) => self.end(session, id, state, outcome, now).await?,
            None => self.requeue(session, id).await?,
        }
        Ok(Some(Finished { owner_key, output }))
    }

    async fn end(
        &self,
        session: &mut dyn Session,
        id: Uuid,
        state: JobState,
        outcome: Option<String>,
        now: Timestamp,
    ) -> Result<()> {
        let sql = format!(
            "UPDATE {} SET state = $1, outcome = $2, ended_at_us = $3, lease_until_us = NULL, \
             remaining_s = NULL WHERE id = $4",
            self.0.table
        );
        query(AssertSqlSafe(sql))
            .bind(state.as_str())
            .bind(outcome)
            .bind(now.as_microsecond())
            .bind(id.to_string())
            .execute(session)
            .await?;
        Ok(())
    }

    /// An orderly return is no failed attempt: otherwise a few restarts would exhaust the attempts of a
    /// job that never failed.
    async fn requeue(&self, session: &mut dyn Session, id: Uuid) -> Result<()> {
        let sql = format!(
            "UPDATE {} SET state = 'queued', lease_until_us = NULL, attempt = attempt - 1 WHERE id = $1",
            self.0.table
        );
        query(AssertSqlSafe(sql)).bind(id.to_string()).execute(session).await?;
        Ok(())
    }
}
