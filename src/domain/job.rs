//! Background jobs: training runs and evaluations.

use std::fmt;
use std::str::FromStr;

use uuid::Uuid;

use super::error::{Error, ErrorKind, Result};

/// Id of a job: a UUID of version 7, so that jobs sort by the time of their request.
macro_rules! job_id {
    ($(#[$doc:meta])* $name:ident, $unknown:expr, $refusal:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $name(pub Uuid);

        impl fmt::Display for $name {
            fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(out)
            }
        }

        impl FromStr for $name {
            type Err = Error;

            fn from_str(text: &str) -> Result<Self> {
                Uuid::parse_str(text).map(Self).map_err(|_| Error::refused($unknown, $refusal))
            }
        }
    };
}

job_id!(
    /// Id of a training run: a UUID of version 7, so that runs sort by the time of their request.
    RunId,
    ErrorKind::RunNotFound,
    "a training run's id is a UUID"
);
job_id!(
    /// Id of an evaluation: a UUID of version 7, so that they sort by the time of their request.
    EvaluationId,
    ErrorKind::EvaluationNotFound,
    "an evaluation's id is a UUID"
);

/// The state of a job. Queued and running jobs are live; the others have ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum JobState {
    /// It waits for a worker.
    Queued,
    /// A worker has claimed it.
    Running,
    /// It produced its output.
    Succeeded,
    /// An error ended it; the outcome says which.
    Failed,
    /// The operator cancelled it.
    Cancelled,
}

impl JobState {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Whether the job has reached a final state.
    #[must_use]
    pub const fn has_ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}
