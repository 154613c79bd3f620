//! What the tables of background jobs have in common: claim, lease, heartbeat, fence.
//!
//! A worker that claims a job gets a lease, which it renews by heartbeats, and a fencing token, which goes
//! up by one with every claim. A worker that stops sending heartbeats loses its lease; the next claim raises
//! the fence, and whatever the earlier worker still writes is ignored. So a job ends exactly once, whatever
//! crashes.
//!
//! Leases are instants of the wall clock, which may step. A lease that ends further ahead than its own
//! length was taken under a clock that has been set back since; it counts as expired. A worker that is
//! alive writes a sound lease again with its next heartbeat.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, SqliteConnection};
use uuid::Uuid;

use super::Store;
use super::errors::failed;
use crate::domain::{Error, ErrorKind, JobState, Result};

/// Condition under which no worker holds a live lease on a job; `?1` is the time now in microseconds.
/// Rows of earlier releases do not have the length of their lease; an hour is longer than any was.
const LEASE_EXPIRED: &str = "(lease_until_us IS NULL OR lease_until_us <= ?1 \
                             OR lease_until_us > ?1 + coalesce(lease_us, 3600000000))";

/// A claimed job.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim<J> {
    /// The job, now running.
    pub job: J,
    /// Fencing token: every write of the worker must show it.
    pub fence: i64,
    /// The operator asked for its cancellation while an earlier worker held it.
    pub cancel_requested: bool,
}

/// What a worker learns from its heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    /// The lease is renewed.
    Continue,
    /// The lease is renewed, and the operator wants the job to be cancelled.
    CancelRequested,
    /// The lease is lost: another worker has the job, or it has ended or was deleted. Stop.
    Lost,
}

/// Jobs of one kind that have not ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LiveJobs {
    /// They wait for a worker.
    pub queued: u64,
    /// A worker has claimed them.
    pub running: u64,
}

/// Jobs that have not ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct JobCounts {
    /// Training runs.
    pub training: LiveJobs,
    /// Evaluations.
    pub evaluation: LiveJobs,
}

impl Store {
    /// How many jobs have not ended.
    ///
    /// # Errors
    /// Faults only.
    pub async fn job_counts(&self) -> Result<JobCounts> {
        let rows: Vec<(String, String, i64)> = sqlx::query_as(
            "SELECT 'training', state, count(*) FROM training_runs WHERE state IN ('queued', 'running') GROUP BY 2 \
             UNION ALL \
             SELECT 'evaluation', state, count(*) FROM evaluations WHERE state IN ('queued', 'running') GROUP BY 2",
        )
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        let count = |kind: &str, state: &str| {
            let row = rows.iter().find(|row| row.0 == kind && row.1 == state);
            row.map_or(0, |row| row.2.unsigned_abs())
        };
        let live = |kind| LiveJobs { queued: count(kind, "queued"), running: count(kind, "running") };
        Ok(JobCounts { training: live("training"), evaluation: live("evaluation") })
    }
}

/// How a worker finishes a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEnd<O> {
    /// It produced its output.
    Succeeded {
        /// What is stored with it.
        output: O,
        /// A sentence for the operator.
        outcome: Option<String>,
    },
    /// An error ended it.
    Failed {
        /// The error.
        outcome: String,
    },
    /// The operator cancelled it.
    Cancelled,
    /// The server shuts down: the job returns to the queue, and this attempt does not count.
    Requeue,
}

/// A finished job: its camera, and the output to be stored in the same transaction.
pub(super) struct Finished<O> {
    pub(super) camera_key: i64,
    pub(super) output: Option<O>,
}

/// A table of jobs. Only its fixed text goes into statements; values are bound.
pub(super) struct Jobs {
    pub(super) table: &'static str,
    /// What messages call the table's jobs.
    pub(super) plural: &'static str,
    /// Assignments that reset the table's own columns of progress.
    pub(super) reset_progress: &'static str,
}

impl Jobs {
    /// Refuses one job more than `max_live` that have not ended.
    pub(super) async fn check_capacity(
        &self,
        connection: &mut SqliteConnection,
        max_live: u32,
    ) -> Result<()> {
        let Self { table, plural, .. } = self;
        let sql = format!("SELECT count(*) FROM {table} WHERE state IN ('queued', 'running')");
        let live: i64 = sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(connection).await.map_err(failed)?;
        if live >= i64::from(max_live) {
            return Err(Error::refused(
                ErrorKind::Overloaded,
                format!("{live} {plural} are queued or running, at most {max_live} may be; try later"),
            ));
        }
        Ok(())
    }

    /// Claims the oldest job that is queued or whose lease has expired. Attempt and fence go up by one;
    /// the progress is reset.
    pub(super) async fn claim(
        &self,
        connection: &mut SqliteConnection,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<Uuid>>> {
        let Self { table, reset_progress, .. } = self;
        let sql = format!(
            "UPDATE {table} SET state = 'running', attempt = attempt + 1, fence = fence + 1, \
             lease_until_us = ?1 + ?2, lease_us = ?2, started_at_us = ?1, phase = '', remaining_s = NULL, \
             {reset_progress} \
             WHERE id = (SELECT id FROM {table} WHERE state IN ('queued', 'running') AND {LEASE_EXPIRED} \
             ORDER BY id LIMIT 1) \
             RETURNING id, fence, cancel_requested"
        );
        let claimed: Option<(String, i64, i64)> = sqlx::query_as(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(lease_us(lease))
            .fetch_optional(connection)
            .await
            .map_err(failed)?;
        let Some((id, fence, cancel_requested)) = claimed else { return Ok(None) };
        let job = Uuid::parse_str(&id).map_err(Error::fault)?;
        Ok(Some(Claim { job, fence, cancel_requested: cancel_requested != 0 }))
    }

    /// Renews the lease.
    pub(super) async fn heartbeat(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let sql = format!(
            "UPDATE {} SET lease_until_us = ?1 + ?2, lease_us = ?2 \
             WHERE id = ?3 AND fence = ?4 AND state = 'running' RETURNING cancel_requested",
            self.table
        );
        let cancel_requested: Option<i64> = sqlx::query_scalar(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(lease_us(lease))
            .bind(id.to_string())
            .bind(fence)
            .fetch_optional(connection)
            .await
            .map_err(failed)?;
        Ok(match cancel_requested {
            None => Heartbeat::Lost,
            Some(0) => Heartbeat::Continue,
            Some(_) => Heartbeat::CancelRequested,
        })
    }

    /// The job's camera and whether its cancellation was requested, if the fence is still the newest and
    /// the job runs.
    pub(super) async fn owns_lease(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
    ) -> Result<Option<(i64, bool)>> {
        let sql = format!(
            "SELECT camera_key, cancel_requested FROM {} WHERE id = ? AND fence = ? AND state = 'running'",
            self.table
        );
        let owned: Option<(i64, i64)> = sqlx::query_as(AssertSqlSafe(sql))
            .bind(id.to_string())
            .bind(fence)
            .fetch_optional(connection)
            .await
            .map_err(failed)?;
        Ok(owned.map(|(camera_key, cancel_requested)| (camera_key, cancel_requested != 0)))
    }

    /// Cancels a job that has not ended: at once where no worker holds a live lease on it, otherwise at
    /// its worker's next heartbeat.
    pub(super) async fn cancel(
        &self,
        connection: &mut SqliteConnection,
        id: Uuid,
        now: Timestamp,
    ) -> Result<()> {
        let Self { table, .. } = self;
        let sql = format!(
            "SELECT 1 FROM {table} WHERE id = ?2 AND (state = 'queued' OR (state = 'running' AND {LEASE_EXPIRED}))"
        );
        let unclaimed: Option<i64> = sqlx::query_scalar(AssertSqlSafe(sql))
            .bind(now.as_microsecond())
            .bind(id.to_string())
            .fetch_optional(&mut *connection)
            .await
            .map_err(failed)?;
        if unclaimed.is_some() {
            self.end(connection, id, JobState::Cancelled, None, now).await?;
        }
        let sql = format!("UPDATE {table} SET cancel_requested = 1 WHERE id = ?");
        sqlx::query(AssertSqlSafe(sql)).bind(id.to_string()).execute(connection).await.map_err(failed)?;
        Ok(())
    }

    /// Ends a job, or returns it to the queue, if the worker still owns its lease; `None` if it lost it,
    /// and then nothing was changed. A job whose cancellation was requested is cancelled even if it
    /// succeeded or was returned.
    pub(super) async fn finish<O>(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
        end: JobEnd<O>,
        now: Timestamp,
    ) -> Result<Option<Finished<O>>> {
        let Some((camera_key, cancel_requested)) = self.owns_lease(connection, (id, fence)).await? else {
            return Ok(None);
        };
        let end = match end {
            JobEnd::Succeeded { .. } | JobEnd::Requeue if cancel_requested => JobEnd::Cancelled,
            end => end,
        };
        let mut stored = None;
        match end {
            JobEnd::Succeeded { output, outcome } => {
                self.end(connection, id, JobState::Succeeded, outcome, now).await?;
                stored = Some(output);
            }
            JobEnd::Failed { outcome } => {
                self.end(connection, id, JobState::Failed, Some(outcome), now).await?;
            }
            JobEnd::Cancelled => self.end(connection, id, JobState::Cancelled, None, now).await?,
            JobEnd::Requeue => self.requeue(connection, id).await?,
        }
        Ok(Some(Finished { camera_key, output: stored }))
    }

    async fn end(
        &self,
        connection: &mut SqliteConnection,
        id: Uuid,
        state: JobState,
        outcome: Option<String>,
        now: Timestamp,
    ) -> Result<()> {
        let sql = format!(
            "UPDATE {} SET state = ?, outcome = ?, ended_at_us = ?, lease_until_us = NULL, \
             remaining_s = NULL WHERE id = ?",
            self.table
        );
        sqlx::query(AssertSqlSafe(sql))
            .bind(state.as_str())
            .bind(outcome)
            .bind(now.as_microsecond())
            .bind(id.to_string())
            .execute(connection)
            .await
            .map_err(failed)?;
        Ok(())
    }

    /// An orderly return is no failed attempt: otherwise a few restarts would exhaust the attempts of a
    /// job that never failed.
    async fn requeue(&self, connection: &mut SqliteConnection, id: Uuid) -> Result<()> {
        let sql = format!(
            "UPDATE {} SET state = 'queued', lease_until_us = NULL, attempt = attempt - 1 WHERE id = ?",
            self.table
        );
        sqlx::query(AssertSqlSafe(sql)).bind(id.to_string()).execute(connection).await.map_err(failed)?;
        Ok(())
    }
}

/// The state as clients see it, of the jobs that a statement calls `name`: that of a running job whose
/// cancellation was requested is not stored, so that every rule of leases stays one of running jobs.
macro_rules! job_state {
    ($name:literal) => {
        concat!(
            "CASE WHEN ",
            $name,
            ".state = 'running' AND ",
            $name,
            ".cancel_requested <> 0 ",
            "THEN 'cancelling' ELSE ",
            $name,
            ".state END"
        )
    };
}
pub(super) use job_state;

pub(super) fn read_state(name: &str) -> Result<JobState, &'static str> {
    JobState::ALL.iter().copied().find(|state| state.as_str() == name).ok_or("is not the state of a job")
}

/// Microseconds of a lease; at most a century, so that the end of a lease stays in range.
fn lease_us(lease: Duration) -> i64 {
    const CENTURY_US: i64 = 100 * 366 * 86_400 * 1_000_000;
    i64::try_from(lease.as_micros()).map_or(CENTURY_US, |lease_us| lease_us.min(CENTURY_US))
}
