//! Outcomes of the chi-square gate, and the record of each source that decides when a rejected one
//! may be reacquired.

use jiff::Timestamp;

use super::measurement::{MeasurementSource, RejectionReason};
use crate::geo::EastNorth;

/// Consecutive rejections before a source may be reacquired.
const MIN_REJECTIONS: u32 = 5;
/// Rejections in a row that agree with each other, and their least duration, s, after which a track whose other source
/// is silent or agrees with them restarts from them: track initiation by 3 of 3 (Bar-Shalom, Li and Kirubarajan 2001,
/// 1.3). A detector that takes another target for a moment is not followed.
const MIN_AGREEING: u32 = 3;
const AGREEING_S: f64 = 1.0;
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
    /// True if the position restarted the filter.
    pub(super) restarted: bool,
}

impl GateOutcome {
    /// The outcome of a position that is used, before its innovation is known.
    pub(super) const fn of(source: MeasurementSource) -> Self {
        Self {
            source,
            innovation: EastNorth { east_m: 0.0, north_m: 0.0 },
            nis: f64::NAN,
            rejected: None,
            restarted: false,
        }
    }

    /// The outcome of a position that is not used.
    pub(super) const fn unused(source: MeasurementSource, reason: RejectionReason) -> Self {
        Self { rejected: Some(reason), ..Self::of(source) }
    }
}

/// How a measurement beyond the gate was dealt with.
pub(super) enum Reacquisition {
    /// It is rejected; the estimate is unchanged.
    Rejected,
    /// The bias of its source was reset, and it now passes the gate.
    BiasReset,
    /// The filter was restarted from it.
    Restarted,
}

/// Accepted and rejected measurements of one source.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SourceHistory {
    accepted_at: Option<Timestamp>,
    /// Time of the first rejection since then.
    rejected_since: Option<Timestamp>,
    /// Consecutive rejections since then.
    rejections: u32,
    agreeing: Option<Agreeing>,
}

/// The latest rejections that agree with each other.
#[derive(Debug, Clone, Copy)]
struct Agreeing {
    since: Timestamp,
    latest: (Timestamp, EastNorth),
    count: u32,
}

/// How far apart two positions of one target may be: its speed, m/s, and the distance that the noise explains, m.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach {
    pub(super) speed_m_s: f64,
    pub(super) noise_m: f64,
}

impl SourceHistory {
    /// The history after an accepted measurement.
    pub(super) const fn accepted(time: Timestamp) -> Self {
        Self { accepted_at: Some(time), rejected_since: None, rejections: 0, agreeing: None }
    }

    /// Counts a rejection. Returns the length of the series of rejections in s, once it has
    /// [`MIN_REJECTIONS`] and lasted `reacquire_after_s`.
    pub(super) fn record_rejection(&mut self, now: Timestamp, reacquire_after_s: f64) -> Option<f64> {
        self.rejections += 1;
        let rejected_s = elapsed_s(*self.rejected_since.get_or_insert(now), now);
        (self.rejections >= MIN_REJECTIONS && rejected_s >= reacquire_after_s).then_some(rejected_s)
    }

    /// Notes where a rejected position was; whether it and those before it agree with each other for long enough to be
    /// of a target of their own.
    pub(super) fn agree_on(&mut self, now: Timestamp, position: EastNorth, reach: Reach) -> bool {
        let before = self.agreeing.filter(|it| {
            let (at, latest) = it.latest;
            latest.distance_m(position) <= reach.noise_m + reach.speed_m_s * elapsed_s(at, now)
        });
        let (since, count) = before.map_or((now, 1), |it| (it.since, it.count + 1));
        self.agreeing = Some(Agreeing { since, latest: (now, position), count });
        count >= MIN_AGREEING && elapsed_s(since, now) >= AGREEING_S
    }

    pub(super) fn is_active(&self, now: Timestamp) -> bool {
        self.accepted_at.is_some_and(|at| elapsed_s(at, now) < ACTIVE_S)
    }
}

fn elapsed_s(since: Timestamp, now: Timestamp) -> f64 {
    now.duration_since(since).as_secs_f64()
}
