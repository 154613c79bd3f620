//! The rate of a clock, by the offsets that were found over hours.
//!
//! A clock that runs too fast by r is late by `o + r t` at the time t. r and o are the line of least squares through the estimates of the
//! offset, weighed by their variances; what these do not explain of the residuals makes the standard deviation of r larger.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};

use crate::clock_estimate::{ClockDrift, ClockEstimate};

/// An estimate is noted so long after the one before: by then most observations of an offset are new.
const EVERY: SignedDuration = SignedDuration::from_mins(10);
/// Estimates that are remembered: one day.
const MOST: usize = 144;
/// A line has at least so many estimates.
const LEAST: usize = 6;
/// Least standard deviation of an estimate, s. The camera that the others are compared with has none at that time.
const LEAST_SIGMA_S: f64 = 0.005;
/// Two estimates that differ by more than this many standard deviations, and by more than 0.2 s, are not of one line: the clock was
/// set.
const SET_SIGMAS: f64 = 6.0;
const SET_S: f64 = 0.2;

/// The offsets of one clock over time.
#[derive(Debug, Clone, Default)]
pub struct ClockHistory {
    estimates: VecDeque<(Timestamp, ClockEstimate)>,
}

impl ClockHistory {
    /// Notes the present estimate, where the one before is ten minutes old; forgets all of before where the clock was set, or the time
    /// goes back.
    pub fn note(&mut self, now: Timestamp, estimate: ClockEstimate) {
        if let Some((time, last)) = self.estimates.back() {
            let change_s = (estimate.offset_s - last.offset_s).abs();
            let is_set = change_s > SET_S.max(SET_SIGMAS * estimate.sigma_s.hypot(last.sigma_s));
            if is_set || now < *time {
                self.estimates.clear();
            } else if now.duration_since(*time) < EVERY {
                return;
            }
        }
        self.estimates.push_back((now, estimate));
        if self.estimates.len() > MOST {
            self.estimates.pop_front();
        }
    }

    /// True if no estimate was noted for a day.
    #[must_use]
    pub fn is_outdated(&self, now: Timestamp) -> bool {
        self.estimates
            .back()
            .is_none_or(|(time, _)| now.duration_since(*time) > SignedDuration::from_hours(24))
    }

    /// The rate; `None` before an hour of estimates.
    #[must_use]
    pub fn drift(&self) -> Option<ClockDrift> {
        let (first, _) = self.estimates.front().filter(|_| self.estimates.len() >= LEAST)?;
        let points: Vec<[f64; 3]> = self
            .estimates
            .iter()
            .map(|(time, own)| {
                let weight = own.sigma_s.max(LEAST_SIGMA_S).powi(-2);
                [time.duration_since(*first).as_secs_f64(), own.offset_s, weight]
            })
            .collect();
        let sum = |of: &dyn Fn(&[f64; 3]) -> f64| points.iter().map(|own| own[2] * of(own)).sum::<f64>();
        let weights = sum(&|_| 1.0);
        let (mean_time, mean_offset) = (sum(&|own| own[0]) / weights, sum(&|own| own[1]) / weights);
        let squares = sum(&|own| (own[0] - mean_time).powi(2));
        let rate = sum(&|own| (own[0] - mean_time) * (own[1] - mean_offset)) / squares;
        let unexplained = sum(&|own| (own[1] - mean_offset - rate * (own[0] - mean_time)).powi(2))
            / (points.len() - 2) as f64;
        let sigma = (unexplained.max(1.0) / squares).sqrt();
        (sigma.is_finite() && rate.is_finite())
            .then_some(ClockDrift { ppm: 1e6 * rate, sigma_ppm: 1e6 * sigma })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A history of an estimate per minute, whose errors alternate.
    fn history(minutes: i64, offset_s: impl Fn(f64) -> f64) -> ClockHistory {
        let mut history = ClockHistory::default();
        for minute in 0..minutes {
            let error_s = if minute / 10 % 2 == 0 { 0.01 } else { -0.01 };
            let estimate = ClockEstimate {
                offset_s: offset_s(60.0 * minute as f64) + error_s,
                sigma_s: 0.02,
                drift: None,
            };
            history.note(Timestamp::UNIX_EPOCH + SignedDuration::from_mins(minute), estimate);
        }
        history
    }

    #[test]
    fn the_rate_of_a_clock_is_found_after_an_hour_with_its_error() {
        assert_eq!(history(50, |time_s| 40e-6 * time_s).drift(), None);
        let drift = history(6 * 60, |time_s| 0.3 + 40e-6 * time_s).drift().expect("six hours");
        assert!((drift.ppm - 40.0).abs() < 2.0 * drift.sigma_ppm, "{drift:?}");
        assert!((0.2..1.5).contains(&drift.sigma_ppm), "{drift:?}");
        let right = history(6 * 60, |_| 0.0).drift().expect("six hours");
        assert!(right.ppm.abs() < 2.0 * right.sigma_ppm, "{right:?}");
    }

    #[test]
    fn a_clock_that_was_set_begins_anew() {
        let set = history(180, |time_s| if time_s < 7_200.0 { 2.0 } else { 0.0 });
        let drift = set.drift().expect("an hour since");
        assert!(drift.ppm.abs() < 2.0 * drift.sigma_ppm, "{drift:?}");
        assert_eq!(history(130, |time_s| if time_s < 7_200.0 { 2.0 } else { 0.0 }).drift(), None);
    }

    #[test]
    fn errors_beyond_those_stated_make_the_rate_less_sure() {
        let quiet = history(180, |_| 0.0).drift().expect("three hours");
        let restless = history(180, |time_s| 0.09 * (time_s / 600.0).sin()).drift().expect("three hours");
        assert!(restless.sigma_ppm > 1.5 * quiet.sigma_ppm, "{restless:?}, {quiet:?}");
    }

    #[test]
    fn a_day_is_remembered() {
        assert_eq!(history(3 * 24 * 60, |_| 0.0).estimates.len(), MOST);
    }
}
