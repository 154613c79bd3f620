//! Evaluations over stored samples: plan, state and progress.

use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;

use super::error::{Error, Result};
use super::gnss_error::SigmaM;
use super::job::{EvaluationId, JobState};
use super::method::Method;
use super::names::CameraId;
use super::recipe::Recipe;
use crate::geo::Position;

/// A half-open range of time; `None` leaves an end open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeRange {
    from: Option<Timestamp>,
    until: Option<Timestamp>,
}

impl TimeRange {
    /// The instants from `from` on and before `until`.
    ///
    /// # Errors
    /// Names `until` if it is not later than `from`.
    pub fn new(from: Option<Timestamp>, until: Option<Timestamp>) -> Result<Self> {
        match (from, until) {
            (Some(from), Some(until)) if from >= until => {
                Err(Error::invalid("until", "must be later than from"))
            }
            _ => Ok(Self { from, until }),
        }
    }

    /// First instant within the range.
    #[must_use]
    pub const fn from(self) -> Option<Timestamp> {
        self.from
    }

    /// First instant after the range.
    #[must_use]
    pub const fn until(self) -> Option<Timestamp> {
        self.until
    }

    /// True if an instant lies in the range.
    #[must_use]
    pub fn contains(self, time: Timestamp) -> bool {
        self.from.is_none_or(|from| from <= time) && self.until.is_none_or(|until| time < until)
    }

    /// True if some instant is in both ranges.
    #[must_use]
    pub fn overlaps(self, other: Self) -> bool {
        let ends_before = |one: Self, next: Self| matches!((one.until, next.from), (Some(until), Some(from)) if until <= from);
        !ends_before(self, other) && !ends_before(other, self)
    }
}

/// Ground truth of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub enum Truth {
    /// Columns of the rows; rows without truth are not scored.
    Columns,
    /// One point.
    Point(Position),
    /// Polylines; the error is the distance to the nearest.
    Lines(Vec<Vec<Position>>),
}

/// The parameters of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationPlan {
    /// Training samples.
    pub train: TimeRange,
    /// Test samples; disjoint from `train`.
    pub test: TimeRange,
    /// Ground truth.
    pub truth: Truth,
    /// In the order of the table, each once.
    pub methods: Vec<Method>,
    /// The recipe whose positions tracks use.
    pub recipe: Recipe,
    /// Number of seeds, from 1.
    pub seeds: u32,
    /// Enlargement of the test boxes to the upper left, px.
    pub box_shift_px: f64,
    /// Standard deviation per axis of the receiver, if known.
    pub gnss_sigma: Option<SigmaM>,
}

/// Progress of an evaluation.
#[derive(Debug, Clone, PartialEq, Default, Serialize, ToSchema)]
pub struct EvaluationProgress {
    /// Current phase: `auto, seed 2, held-out group 2 of 4 12/60`, `track, seed 2`.
    pub phase: String,
    /// Completed steps. A step is the fit of a recipe, or a method over all test samples, with one seed.
    pub steps_done: u32,
    /// Total steps.
    pub steps: u32,
    /// Estimated remaining time from the mean duration of the completed steps, s; `None` before the first.
    pub remaining_s: Option<f64>,
}

/// An evaluation as stored, without its report.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationJob {
    /// The evaluation's id.
    pub id: EvaluationId,
    /// The camera whose samples are used.
    pub camera_id: CameraId,
    /// The parameters.
    pub plan: EvaluationPlan,
    /// State of the job.
    pub state: JobState,
    /// Progress of the job.
    pub progress: EvaluationProgress,
    /// Number of times that a worker has claimed it without returning it to the queue in order.
    pub attempt: u32,
    /// The error, if it failed.
    pub outcome: Option<String>,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest claim by a worker.
    pub started_at: Option<Timestamp>,
    /// Time of completion.
    pub ended_at: Option<Timestamp>,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn range((from, until): (Option<i64>, Option<i64>)) -> Option<TimeRange> {
        let at = |second: Option<i64>| second.map(|second| Timestamp::from_second(second).expect("in range"));
        TimeRange::new(at(from), at(until)).ok()
    }

    proptest! {
        /// Compared with the definition: some second is in both.
        #[test]
        fn ranges_overlap_if_they_share_an_instant(
            one: (Option<u8>, Option<u8>), other: (Option<u8>, Option<u8>),
        ) {
            let wide = |(from, until): (Option<u8>, Option<u8>)| (from.map(i64::from), until.map(i64::from));
            let (one, other) = (wide(one), wide(other));
            let holds = |(from, until): (Option<i64>, Option<i64>), second: i64| {
                from.is_none_or(|from| from <= second) && until.is_none_or(|until| second < until)
            };
            if let (Some(first), Some(second)) = (range(one), range(other)) {
                let shared = (-1..=256).any(|at| holds(one, at) && holds(other, at));
                prop_assert_eq!(first.overlaps(second), shared);
            } else {
                let empty = |it: (Option<i64>, Option<i64>)| !(-1..=256).any(|at| holds(it, at));
                prop_assert!(empty(one) || empty(other));
            }
        }
    }
}
