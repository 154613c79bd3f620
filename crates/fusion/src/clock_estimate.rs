//! How late a clock is by an estimate, and from where on that is no chance.

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
}

impl ClockEstimate {
    /// True if the offset is neither chance nor a difference of two maps. Times are corrected by it.
    #[must_use]
    pub fn is_wrong(&self) -> bool {
        self.offset_s.abs() > LEAST_WRONG_S.max(SIGNIFICANT * self.sigma_s)
    }
}
