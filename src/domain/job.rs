//! Work in the background: training runs and evaluations.

use std::fmt;
use std::str::FromStr;

use uuid::Uuid;

use super::error::{Error, ErrorKind, Result};

/// Id of a job: a UUID of version 7, so that jobs sort by the time they were asked for.
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
    /// Id of a training run: a UUID of version 7, so that runs sort by the time they were asked for.
    RunId,
    ErrorKind::RunNotFound,
    "a training run's id is a UUID"
);
job_id!(
    /// Id of an evaluation: a UUID of version 7, so that they sort by the time they were asked for.
    EvaluationId,
    ErrorKind::EvaluationNotFound,
    "an evaluation's id is a UUID"
);

/// Where a job stands. Queued and running jobs are live; the others have ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker carries it out.
    Running,
    /// Yielded what it was asked for.
    Succeeded,
    /// Ended by an error; the outcome says which.
    Failed,
    /// Ended by the operator.
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

    /// Whether the job will change no more.
    #[must_use]
    pub const fn has_ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}
