//! Outcomes of the chi-square gate, and the record of each source that decides when a rejected one
//! may be reacquired.

use jiff::Timestamp;

use super::measurement::{MeasurementSource, RejectionReason};
use crate::geo::EastNorth;

/// Consecutive rejections before a source may be reacquired.
const MIN_REJECTIONS: u32 = 5;
/// A source counts as active for this long after its last accepted measurement, s.
pub(super) const ACTIVE_S: f64 = 10.0;

/// How the gate decided on one measured position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct GateOutcome {
    pub(super) source: MeasurementSource,
    /// Measured less predicted position, m.
    pub(super) innovation: EastNorth,
    pub(super) nis: f64,
    pub(super) rejected: Option<RejectionReason>,
    /// Whether the position reinitialised the filter.
    pub(super) reinitialized: bool,
}

/// How a measurement beyond the gate was dealt with.
pub(super) enum Reacquisition {
    /// It is rejected; the estimate is unchanged.
    Rejected,
    /// The bias of its source was reset, and it now passes the gate.
    BiasReset,
    /// The filter was reinitialised from it.
    Reinitialized,
}

/// Accepted and rejected measurements of one source.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SourceHistory {
    accepted_at: Option<Timestamp>,
    /// Time of the first rejection since then.
    rejected_since: Option<Timestamp>,
    /// Consecutive rejections since then.
    rejections: u32,
}

impl SourceHistory {
    /// The history after an accepted measurement.
    pub(super) const fn accepted(time: Timestamp) -> Self {
        Self { accepted_at: Some(time), rejected_since: None, rejections: 0 }
    }

    /// Counts a rejection. Returns the length of the series of rejections in s, once it has
    /// [`MIN_REJECTIONS`] and lasted `reacquire_after_s`.
    pub(super) fn record_rejection(&mut self, now: Timestamp, reacquire_after_s: f64) -> Option<f64> {
        self.rejections += 1;
        let rejected_s = elapsed_s(*self.rejected_since.get_or_insert(now), now);
        (self.rejections >= MIN_REJECTIONS && rejected_s >= reacquire_after_s).then_some(rejected_s)
    }

    pub(super) fn is_active(&self, now: Timestamp) -> bool {
        self.accepted_at.is_some_and(|at| elapsed_s(at, now) < ACTIVE_S)
    }
}

fn elapsed_s(since: Timestamp, now: Timestamp) -> f64 {
    now.duration_since(since).as_secs_f64()
}
