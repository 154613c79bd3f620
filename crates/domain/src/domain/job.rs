//! Background jobs: training runs and evaluations.

use std::fmt;
use std::str::FromStr;

use strum::{IntoStaticStr, VariantArray};
use uuid::Uuid;

use super::error::{Error, ErrorKind, Result};

/// Id of a job: a UUID of version 7, so that jobs sort by their time of creation.
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
    /// Id of a training run: a UUID of version 7, so that runs sort by their time of creation.
    RunId,
    ErrorKind::RunNotFound,
    "a training run's id is a UUID"
);
job_id!(
    /// Id of an evaluation: a UUID of version 7, so that evaluations sort by their time of creation.
    EvaluationId,
    ErrorKind::EvaluationNotFound,
    "an evaluation's id is a UUID"
);

/// State of a job. Queued, running and cancelling jobs are live; the others have ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case")]
pub enum JobState {
    /// It waits for a worker.
    Queued,
    /// Claimed by a worker.
    Running,
    /// Claimed by a worker, which ends it at its next heartbeat: its cancellation was requested.
    Cancelling,
    /// Completed.
    Succeeded,
    /// Ended by an error, which the outcome describes.
    Failed,
    /// The operator cancelled it.
    Cancelled,
}

impl JobState {
    /// All states.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Name in the database, in wire formats and logs.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// True if the state is final.
    #[must_use]
    pub const fn has_ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}
