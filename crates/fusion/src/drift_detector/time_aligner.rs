//! Interpolates the regressed positions of one target to the times of its fixes, where boxes and fixes
//! come at different instants.
//!
//! Does not interpolate across a gap, and does not give a second sample for the same fix.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};

use crate::geo::EastNorth;

/// Largest interval between two boxes to interpolate over.
const MAX_GAP: SignedDuration = SignedDuration::from_millis(2_500);
/// Regressed positions buffered for late fixes.
const MAX_BUFFERED: usize = 64;

/// A position estimate of one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedEstimate {
    /// The instant.
    pub time: Timestamp,
    /// East and north in the camera's plane.
    pub position: EastNorth,
    /// Error variance per axis, m2.
    pub variance_m2: f64,
}

/// Aligns the boxes and fixes of one target.
#[derive(Debug, Clone, Default)]
pub struct TimeAligner {
    /// In order of time.
    regressed: VecDeque<TimedEstimate>,
    /// The latest fix, while no box at or after its time is known.
    pending_fix: Option<TimedEstimate>,
    /// Time of the latest fix.
    latest_fix: Option<Timestamp>,
}

impl TimeAligner {
    /// Adds a regressed position. Returns the regressed position interpolated to the time of the
    /// pending fix, and that fix, if this box follows it.
    pub fn push_regressed(&mut self, estimate: TimedEstimate) -> Option<(TimedEstimate, TimedEstimate)> {
        if self.regressed.back().is_none_or(|latest| latest.time < estimate.time) {
            self.regressed.push_back(estimate);
        } else {
            let index = self.regressed.partition_point(|other| other.time < estimate.time);
            self.regressed.insert(index, estimate);
        }
        if self.regressed.len() > MAX_BUFFERED {
            self.regressed.pop_front();
        }
        let fix = self.pending_fix?;
        if estimate.time < fix.time {
            return None;
        }
        self.pending_fix = None;
        Some((self.interpolate(fix.time)?, fix))
    }

    /// Adds a fix. Returns the regressed position interpolated to its time, and the fix, if boxes on
    /// both sides of it are known.
    pub fn push_fix(&mut self, fix: TimedEstimate) -> Option<(TimedEstimate, TimedEstimate)> {
        if self.latest_fix.is_some_and(|latest| fix.time <= latest) {
            return None;
        }
        self.latest_fix = Some(fix.time);
        if self.regressed.back().is_none_or(|latest| latest.time < fix.time) {
            self.pending_fix = Some(fix);
            return None;
        }
        Some((self.interpolate(fix.time)?, fix))
    }

    fn interpolate(&self, time: Timestamp) -> Option<TimedEstimate> {
        let index = self.regressed.partition_point(|estimate| estimate.time < time);
        let after = *self.regressed.get(index)?;
        if after.time == time {
            return Some(after);
        }
        let before = *self.regressed.get(index.checked_sub(1)?)?;
        let gap = after.time.duration_since(before.time);
        if gap > MAX_GAP {
            return None;
        }
        let fraction = time.duration_since(before.time).as_secs_f64() / gap.as_secs_f64();
        let between = |one: f64, other: f64| one + fraction * (other - one);
        Some(TimedEstimate {
            time,
            position: EastNorth {
                east_m: between(before.position.east_m, after.position.east_m),
                north_m: between(before.position.north_m, after.position.north_m),
            },
            variance_m2: before.variance_m2.max(after.variance_m2),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::at_s;

    fn estimate(seconds: f64, east_m: f64) -> TimedEstimate {
        TimedEstimate { time: at_s(seconds), position: EastNorth { east_m, north_m: 0.0 }, variance_m2: 1.0 }
    }

    #[test]
    fn regressed_positions_are_interpolated_to_early_and_late_fixes() {
        let mut aligner = TimeAligner::default();
        assert!(aligner.push_regressed(estimate(0.0, 0.0)).is_none());
        assert!(aligner.push_fix(estimate(0.5, 9.0)).is_none(), "the box after it is still to come");
        let (regressed, fix) = aligner.push_regressed(estimate(2.0, 8.0)).expect("a pair");
        assert!((regressed.position.east_m - 2.0).abs() < 1e-9 && fix == estimate(0.5, 9.0));
        assert!(aligner.push_regressed(estimate(2.1, 8.0)).is_none(), "each fix is used once");
        let (regressed, _) = aligner.push_fix(estimate(1.0, 9.0)).expect("late, but between two boxes");
        assert!((regressed.position.east_m - 4.0).abs() < 1e-9);
        assert!(aligner.push_fix(estimate(1.0, 9.0)).is_none());
    }

    #[test]
    fn nothing_is_interpolated_across_a_gap_or_before_the_first_box() {
        let mut aligner = TimeAligner::default();
        assert!(aligner.push_fix(estimate(-1.0, 0.0)).is_none());
        assert!(aligner.push_regressed(estimate(0.0, 0.0)).is_none());
        assert!(aligner.push_fix(estimate(1.0, 0.0)).is_none());
        assert!(aligner.push_regressed(estimate(3.0, 0.0)).is_none());
        for index in 0..1_000 {
            aligner.push_regressed(estimate(4.0 + f64::from(index), 0.0));
        }
        assert!(aligner.regressed.len() <= MAX_BUFFERED);
    }
}
