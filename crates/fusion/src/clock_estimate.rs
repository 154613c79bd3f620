//! How late a clock is by an estimate, and from where on that is no chance.

use jiff::{SignedDuration, Timestamp};

/// An offset is wrong, and corrected, beyond this one, s, and that many standard deviations.
const LEAST_WRONG_S: f64 = 0.2;
const SIGNIFICANT: f64 = 4.0;

/// How late the times of a camera or of a receiver are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockEstimate {
    /// Seconds by which its times are later than those that it is compared with.
    pub offset_s: f64,
    /// Standard deviation of the estimate, s.
    pub sigma_s: f64,
    /// How the offset changes, where it was followed for an hour.
    pub drift: Option<ClockDrift>,
}

/// How fast a clock is, in millionths: 10 are 0.9 s a day.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockDrift {
    /// By how much its seconds are too short; negative where it is slow.
    pub ppm: f64,
    /// Standard deviation of the estimate.
    pub sigma_ppm: f64,
}

impl ClockEstimate {
    /// True if the offset is neither chance nor a difference of two maps. Times are corrected by it.
    #[must_use]
    pub fn is_wrong(&self) -> bool {
        self.offset_s.abs() > LEAST_WRONG_S.max(SIGNIFICANT * self.sigma_s)
    }
}

/// A time less what it is late by, s; the time itself where no such time exists.
pub(crate) fn earlier(time: Timestamp, late_s: f64) -> Timestamp {
    let late = SignedDuration::try_from_secs_f64(late_s).unwrap_or_default();
    time.checked_sub(late).unwrap_or(time)
}
