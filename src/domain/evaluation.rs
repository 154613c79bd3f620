//! Evaluations over stored samples: plan, progress, state.

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

/// A range of time, half open: `from` is within, `until` is not. An end that is `None` is unbounded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeRange {
    from: Option<Timestamp>,
    until: Option<Timestamp>,
}

impl TimeRange {
    /// From an instant on, before another.
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

    /// First instant within.
    #[must_use]
    pub const fn from(self) -> Option<Timestamp> {
        self.from
    }

    /// First instant after the range.
    #[must_use]
    pub const fn until(self) -> Option<Timestamp> {
        self.until
    }

    /// Whether an instant lies within.
    #[must_use]
    pub fn contains(self, time: Timestamp) -> bool {
        self.from.is_none_or(|from| from <= time) && self.until.is_none_or(|until| time < until)
    }

    /// Whether an instant lies in both.
    #[must_use]
    pub fn overlaps(self, other: Self) -> bool {
        let ends_before = |one: Self, next: Self| matches!((one.until, next.from), (Some(until), Some(from)) if until <= from);
        !ends_before(self, other) && !ends_before(other, self)
    }
}

/// The true position of the target, against which positions are measured.
#[derive(Debug, Clone, PartialEq)]
pub enum Truth {
    /// The truth columns of each row; rows without are not measured.
    Columns,
    /// One point: the target did not move.
    Point(Position),
    /// Somewhere on these lines; the error is the distance to the nearest one.
    Lines(Vec<Vec<Position>>),
}

/// The parameters of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationPlan {
    /// The samples to train on.
    pub train: TimeRange,
    /// The samples to test on; none of them is in `train`.
    pub test: TimeRange,
    /// The truth of the test samples.
    pub truth: Truth,
    /// In the order of the table, each once.
    pub methods: Vec<Method>,
    /// The recipe whose model the tracks use.
    pub recipe: Recipe,
    /// Every seed from 1 to this.
    pub seeds: u32,
    /// Test boxes grow to the upper left by this, px.
    pub box_shift_px: f64,
    /// Standard deviation per axis of the receiver, if known.
    pub gnss_sigma: Option<SigmaM>,
}

/// The progress of an evaluation.
#[derive(Debug, Clone, PartialEq, Default, Serialize, ToSchema)]
pub struct EvaluationProgress {
    /// The current step: `auto, seed 2, held-out block 2 of 4 12/60`, `track, seed 2`.
    pub phase: String,
    /// Steps done. A step is a recipe's fit, or a method over all test samples, with one seed.
    pub steps_done: u32,
    /// Steps to do.
    pub steps: u32,
    /// Estimated seconds left, from the mean duration of the steps so far; `None` before the first.
    pub remaining_s: Option<f64>,
}

/// An evaluation as stored, without its report.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationJob {
    /// The evaluation's id.
    pub id: EvaluationId,
    /// The camera whose samples are evaluated.
    pub camera_id: CameraId,
    /// The parameters.
    pub plan: EvaluationPlan,
    /// The job's state.
    pub state: JobState,
    /// The progress.
    pub progress: EvaluationProgress,
    /// Times a worker has claimed it without returning it to the queue in order.
    pub attempt: u32,
    /// Why it failed, if it did.
    pub outcome: Option<String>,
    /// When it was requested.
    pub created_at: Timestamp,
    /// When a worker claimed it last.
    pub started_at: Option<Timestamp>,
    /// When it ended.
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
        /// Against the plain meaning: some second lies in both.
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
