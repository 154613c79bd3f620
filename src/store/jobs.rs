//! What the tables of background jobs have in common: whoever claims a job holds a lease and a fence.
//!
//! A worker that stops beating loses its lease; the next claim raises the fence, and whatever the old
//! worker still writes is left out. So a job ends exactly once, whatever crashes.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use sqlx::{AssertSqlSafe, SqliteConnection};
use uuid::Uuid;

use super::faults::failed;
use crate::domain::{Error, ErrorKind, JobState, Result};

/// A job that was taken up.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim<J> {
    /// The job, now running.
    pub job: J,
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
    /// The lease is prolonged, and the operator wants the job to end.
    CancelRequested,
    /// The job belongs to another worker now, has ended, or is gone: stop.
    Lost,
}

/// How a worker leaves a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEnd<Y> {
    /// With what it was asked for.
    Succeeded {
        /// What is kept of it.
        yielded: Y,
        /// A sentence for the operator, if there is something to say.
        outcome: Option<String>,
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

/// A job that its holder has left: whose it is, and what is to be kept of it in the same transaction.
pub(super) struct Left<Y> {
    pub(super) camera_key: i64,
    pub(super) yielded: Option<Y>,
}

/// A table of jobs. Only its fixed text goes into statements; values are bound.
pub(super) struct Jobs {
    pub(super) table: &'static str,
    /// What the table's jobs are called in a message.
    pub(super) plural: &'static str,
    /// Assignments that begin the table's own columns of progress anew.
    pub(super) fresh: &'static str,
}

impl Jobs {
    /// Refuses one job more than `max_live` that have not ended.
    pub(super) async fn check_room(&self, connection: &mut SqliteConnection, max_live: u32) -> Result<()> {
        let Self { table, plural, .. } = self;
        let sql = format!("SELECT count(*) FROM {table} WHERE state IN ('queued', 'running')");
        let live: i64 = sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(connection).await.map_err(failed)?;
        if live >= i64::from(max_live) {
            return Err(Error::refused(
                ErrorKind::Overloaded,
                format!(
                    "{live} {plural} are queued or running, and no more than {max_live} may be; try later"
                ),
            ));
        }
        Ok(())
    }

    /// Takes up the oldest job that is queued or whose worker has stopped beating. Its attempt and
    /// fence go up by one; its progress begins anew.
    pub(super) async fn claim(
        &self,
        connection: &mut SqliteConnection,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<Uuid>>> {
        let Self { table, fresh, .. } = self;
        let sql = format!(
            "UPDATE {table} SET state = 'running', attempt = attempt + 1, fence = fence + 1, \
             lease_until_us = ?, started_at_us = ?, phase = '', remaining_s = NULL, {fresh} \
             WHERE id = (SELECT id FROM {table} WHERE state IN ('queued', 'running') \
             AND (lease_until_us IS NULL OR lease_until_us <= ?) ORDER BY id LIMIT 1) \
             RETURNING id, fence, cancel_requested"
        );
        let claimed: Option<(String, i64, i64)> = sqlx::query_as(AssertSqlSafe(sql))
            .bind(lease_end(now, lease))
            .bind(now.as_microsecond())
            .bind(now.as_microsecond())
            .fetch_optional(connection)
            .await
            .map_err(failed)?;
        let Some((id, fence, cancel_requested)) = claimed else { return Ok(None) };
        let job = Uuid::parse_str(&id).map_err(Error::fault)?;
        Ok(Some(Claim { job, fence, cancel_requested: cancel_requested != 0 }))
    }

    /// Prolongs the lease.
    pub(super) async fn beat(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let sql = format!(
            "UPDATE {} SET lease_until_us = ? WHERE id = ? AND fence = ? AND state = 'running' \
             RETURNING cancel_requested",
            self.table
        );
        let cancel_requested: Option<i64> = sqlx::query_scalar(AssertSqlSafe(sql))
            .bind(lease_end(now, lease))
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

    /// Whose the job is and whether its end was asked for, if the fence is still the newest and the
    /// job runs.
    pub(super) async fn held(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
    ) -> Result<Option<(i64, bool)>> {
        let sql = format!(
            "SELECT camera_key, cancel_requested FROM {} WHERE id = ? AND fence = ? AND state = 'running'",
            self.table
        );
        let held: Option<(i64, i64)> = sqlx::query_as(AssertSqlSafe(sql))
            .bind(id.to_string())
            .bind(fence)
            .fetch_optional(connection)
            .await
            .map_err(failed)?;
        Ok(held.map(|(camera_key, cancel_requested)| (camera_key, cancel_requested != 0)))
    }

    /// Asks for the end of a live job: a queued one ends at once, a running one at its worker's next
    /// heartbeat.
    pub(super) async fn cancel(
        &self,
        connection: &mut SqliteConnection,
        id: Uuid,
        state: JobState,
        now: Timestamp,
    ) -> Result<()> {
        if state == JobState::Queued {
            self.end(connection, id, JobState::Cancelled, None, now).await?;
        }
        let sql = format!("UPDATE {} SET cancel_requested = 1 WHERE id = ?", self.table);
        sqlx::query(AssertSqlSafe(sql)).bind(id.to_string()).execute(connection).await.map_err(failed)?;
        Ok(())
    }

    /// Ends a job, or gives it back, if the worker still holds it; `None` if it lost it, and then
    /// nothing was changed. A job whose end the operator has asked for is cancelled even if it
    /// succeeded or was given back.
    pub(super) async fn leave<Y>(
        &self,
        connection: &mut SqliteConnection,
        (id, fence): (Uuid, i64),
        end: JobEnd<Y>,
        now: Timestamp,
    ) -> Result<Option<Left<Y>>> {
        let Some((camera_key, cancel_requested)) = self.held(connection, (id, fence)).await? else {
            return Ok(None);
        };
        let end = match end {
            JobEnd::Succeeded { .. } | JobEnd::Requeue if cancel_requested => JobEnd::Cancelled,
            end => end,
        };
        let mut kept = None;
        match end {
            JobEnd::Succeeded { yielded, outcome } => {
                self.end(connection, id, JobState::Succeeded, outcome, now).await?;
                kept = Some(yielded);
            }
            JobEnd::Failed { outcome } => {
                self.end(connection, id, JobState::Failed, Some(outcome), now).await?;
            }
            JobEnd::Cancelled => self.end(connection, id, JobState::Cancelled, None, now).await?,
            JobEnd::Requeue => self.requeue(connection, id).await?,
        }
        Ok(Some(Left { camera_key, yielded: kept }))
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

    async fn requeue(&self, connection: &mut SqliteConnection, id: Uuid) -> Result<()> {
        let sql = format!("UPDATE {} SET state = 'queued', lease_until_us = NULL WHERE id = ?", self.table);
        sqlx::query(AssertSqlSafe(sql)).bind(id.to_string()).execute(connection).await.map_err(failed)?;
        Ok(())
    }
}

pub(super) fn read_state(name: &str) -> Result<JobState, &'static str> {
    JobState::ALL.iter().copied().find(|state| state.as_str() == name).ok_or("no state of a job")
}

fn lease_end(now: Timestamp, lease: Duration) -> i64 {
    let lease = SignedDuration::try_from(lease).unwrap_or(SignedDuration::MAX);
    now.saturating_add(lease).unwrap_or(Timestamp::MAX).as_microsecond()
}
