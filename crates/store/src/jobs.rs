//! Background jobs as every backend reports them: claim, lease, heartbeat, fence.
//!
//! A worker that claims a job gets a lease, which it renews by heartbeats, and a fencing token, which goes
//! up by one with every claim. A worker that stops sending heartbeats loses its lease; the next claim raises
//! the fence, and whatever the earlier worker still writes is ignored. So a job ends exactly once, whatever
//! crashes.
//!
//! Leases are instants of one clock: that of the database's server in PostgreSQL, and in a data folder, which one
//! machine has, that of the caller. The caller may have read its clock before it waited for the file, so a lease that
//! another worker has taken meanwhile ends somewhat further ahead than its own length. One that ends more than
//! [`CLOCK_ERROR_US`] further ahead was taken under a clock that has been set back since; it counts as expired. A worker
//! that is alive writes a sound lease again with its next heartbeat.

use std::time::Duration;

use crate::domain::{Error, ErrorKind, JobState, Result};

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

/// The answer to a worker's heartbeat.
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
    /// Training runs, of cameras and of sites.
    pub training: LiveJobs,
    /// Evaluations.
    pub evaluation: LiveJobs,
}

/// How a worker finishes a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEnd<O> {
    /// It produced its output.
    Succeeded {
        /// The output that is stored with it.
        output: O,
        /// A sentence for the operator.
        outcome: Option<String>,
    },
    /// An error ended it.
    Failed {
        /// The text of the error.
        outcome: String,
    },
    /// The operator cancelled it.
    Cancelled,
    /// The server shuts down: the job returns to the queue, and this attempt does not count.
    Requeue,
}

/// The new state of a job that its worker has finished.
pub(super) struct Settled<O> {
    /// Its state from now on; `None` if it returns to the queue.
    pub(super) state: Option<JobState>,
    pub(super) outcome: Option<String>,
    pub(super) output: Option<O>,
}

impl<O> JobEnd<O> {
    /// A job whose cancellation was requested is cancelled even if it succeeded or was returned.
    pub(super) fn settle(self, cancel_requested: bool) -> Settled<O> {
        let ended = |state, outcome, output| Settled { state: Some(state), outcome, output };
        match self {
            Self::Failed { outcome } => ended(JobState::Failed, Some(outcome), None),
            Self::Cancelled => ended(JobState::Cancelled, None, None),
            Self::Succeeded { .. } | Self::Requeue if cancel_requested => {
                ended(JobState::Cancelled, None, None)
            }
            Self::Succeeded { output, outcome } => ended(JobState::Succeeded, outcome, Some(output)),
            Self::Requeue => Settled { state: None, outcome: None, output: None },
        }
    }
}

/// A finished job: the key of what it belongs to, and the output to be stored in the same transaction.
pub(super) struct Finished<O> {
    pub(super) owner_key: i64,
    pub(super) output: Option<O>,
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
pub(super) fn lease_us(lease: Duration) -> i64 {
    const CENTURY_US: i64 = 100 * 366 * 86_400 * 1_000_000;
    i64::try_from(lease.as_micros()).map_or(CENTURY_US, |lease_us| lease_us.min(CENTURY_US))
}

/// How much further ahead than its own length a lease may end. A clock that is set back by less keeps the job of a dead
/// worker waiting for as long as it was set back.
pub(super) const CLOCK_ERROR_US: i64 = 60_000_000;

/// Condition under which no worker holds a live lease on a job, where `now` is an expression for the time now in
/// microseconds.
pub(super) fn lease_expired(now: &str) -> String {
    format!(
        "(lease_until_us IS NULL OR lease_until_us <= {now} \
         OR lease_until_us > {now} + lease_us + {CLOCK_ERROR_US})"
    )
}

/// A table of jobs. Only its fixed text goes into statements; values are bound.
pub struct JobTable {
    pub(super) table: &'static str,
    /// Column of what a job belongs to.
    pub(super) owner: &'static str,
    /// The name of the table's jobs in messages.
    pub(super) plural: &'static str,
    /// Assignments that reset the table's own columns of progress.
    pub(super) reset_progress: &'static str,
    /// Columns by which waiting jobs are claimed. Ids rise with time, and a camera has one live run at most, so
    /// no camera is served twice before all that wait with it were served once.
    pub(super) order: &'static str,
}

pub(super) const RUNS: JobTable = JobTable {
    table: "training_runs",
    owner: "camera_key",
    plural: "training runs",
    reset_progress: "epoch_done = 0, epochs_planned = 0, reconstruction_error = 0, regression_error = 0, error_scale = 0",
    order: "priority DESC, id",
};

pub(super) const SITE_RUNS: JobTable = JobTable {
    table: "site_training_runs",
    owner: "site_key",
    plural: "training runs of sites",
    reset_progress: RUNS.reset_progress,
    order: "id",
};

pub(super) const EVALUATIONS: JobTable = JobTable {
    table: "evaluations",
    owner: "camera_key",
    plural: "evaluations",
    reset_progress: "steps_done = 0, steps_planned = 0",
    order: "id",
};

impl JobTable {
    /// Refuses one job more than `max_live` of which `live` have not ended.
    pub(super) fn check_capacity(&self, live: i64, max_live: u32) -> Result<()> {
        if live < i64::from(max_live) {
            return Ok(());
        }
        let plural = self.plural;
        let message = format!("{live} {plural} are queued or running, at most {max_live} may be; try later");
        Err(Error::refused(ErrorKind::Overloaded, message))
    }
}

impl JobCounts {
    /// From rows of a kind, a state and how many jobs of that kind are in it.
    pub(super) fn of(rows: &[(String, String, i64)]) -> Self {
        let count = |kind: &str, state: &str| {
            let row = rows.iter().find(|row| row.0 == kind && row.1 == state);
            row.map_or(0, |row| row.2.unsigned_abs())
        };
        let live = |kind| LiveJobs { queued: count(kind, "queued"), running: count(kind, "running") };
        Self { training: live("training"), evaluation: live("evaluation") }
    }
}

/// The statement of [`JobCounts::of`]'s rows.
pub(super) const COUNT_JOBS: &str = "SELECT 'training', state, count(*) FROM (SELECT state FROM training_runs \
     UNION ALL SELECT state FROM site_training_runs) AS runs WHERE state IN ('queued', 'running') GROUP BY 2 \
     UNION ALL \
     SELECT 'evaluation', state, count(*) FROM evaluations WHERE state IN ('queued', 'running') GROUP BY 2";
