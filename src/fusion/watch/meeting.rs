//! Boxes and fixes of one target that come at instants of their own, brought to the same one.
//!
//! The regressed position of a fix's instant lies on the line between those of the boxes around it.
//! What never happens here: a comparison across a gap, or two of the same fix.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};

use crate::geo::EastNorth;

/// Boxes around a fix are joined by a line over at most this long a gap.
const LONGEST_GAP: SignedDuration = SignedDuration::from_millis(2_500);
/// Boxes that are remembered, for fixes that come late.
const REMEMBERED: usize = 64;

/// A position with its error variance per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// When.
    pub time: Timestamp,
    /// Where, in the camera's plane.
    pub position: EastNorth,
    /// Error variance per axis, m2.
    pub variance_m2: f64,
}

/// What is remembered of one target's boxes and of its fix that waits for the next box.
#[derive(Debug, Clone, Default)]
pub struct Meeting {
    /// In order of time.
    regressed: VecDeque<Spot>,
    waiting: Option<Spot>,
    /// The last fix that was compared or given up.
    heard: Option<Timestamp>,
}

impl Meeting {
    /// Takes what a box says; returns it at the instant of the fix that waited for it, and that fix.
    pub fn regressed(&mut self, spot: Spot) -> Option<(Spot, Spot)> {
        let place = self.regressed.partition_point(|other| other.time < spot.time);
        self.regressed.insert(place, spot);
        if self.regressed.len() > REMEMBERED {
            self.regressed.pop_front();
        }
        let fix = self.waiting?;
        if spot.time < fix.time {
            return None;
        }
        self.waiting = None;
        Some((self.at(fix.time)?, fix))
    }

    /// Takes a fix; returns what the boxes say of its instant, and the fix.
    pub fn fix(&mut self, fix: Spot) -> Option<(Spot, Spot)> {
        if self.heard.is_some_and(|heard| fix.time <= heard) {
            return None;
        }
        self.heard = Some(fix.time);
        if self.regressed.back().is_none_or(|latest| latest.time < fix.time) {
            self.waiting = Some(fix);
            return None;
        }
        Some((self.at(fix.time)?, fix))
    }

    fn at(&self, time: Timestamp) -> Option<Spot> {
        let after = self.regressed.partition_point(|spot| spot.time < time);
        let second = *self.regressed.get(after)?;
        if second.time == time {
            return Some(second);
        }
        let first = *self.regressed.get(after.checked_sub(1)?)?;
        let gap = second.time.duration_since(first.time);
        if gap > LONGEST_GAP {
            return None;
        }
        let share = time.duration_since(first.time).as_secs_f64() / gap.as_secs_f64();
        let between = |one: f64, other: f64| one + share * (other - one);
        Some(Spot {
            time,
            position: EastNorth {
                east_m: between(first.position.east_m, second.position.east_m),
                north_m: between(first.position.north_m, second.position.north_m),
            },
            variance_m2: first.variance_m2.max(second.variance_m2),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::track::simulated::at_s;

    fn spot(seconds: f64, east_m: f64) -> Spot {
        Spot { time: at_s(seconds), position: EastNorth { east_m, north_m: 0.0 }, variance_m2: 1.0 }
    }

    #[test]
    fn a_fix_meets_the_line_between_its_boxes_early_or_late() {
        let mut meeting = Meeting::default();
        assert!(meeting.regressed(spot(0.0, 0.0)).is_none());
        assert!(meeting.fix(spot(0.5, 9.0)).is_none(), "the box behind it is to come");
        let (regressed, fix) = meeting.regressed(spot(2.0, 8.0)).expect("met");
        assert!((regressed.position.east_m - 2.0).abs() < 1e-9 && fix == spot(0.5, 9.0));
        assert!(meeting.regressed(spot(2.1, 8.0)).is_none(), "each fix is compared once");
        let (regressed, _) = meeting.fix(spot(1.0, 9.0)).expect("late, but between two boxes");
        assert!((regressed.position.east_m - 4.0).abs() < 1e-9);
        assert!(meeting.fix(spot(1.0, 9.0)).is_none());
    }

    #[test]
    fn no_comparison_spans_a_gap_or_reaches_before_the_first_box() {
        let mut meeting = Meeting::default();
        assert!(meeting.fix(spot(-1.0, 0.0)).is_none());
        assert!(meeting.regressed(spot(0.0, 0.0)).is_none());
        assert!(meeting.fix(spot(1.0, 0.0)).is_none());
        assert!(meeting.regressed(spot(3.0, 0.0)).is_none());
        for index in 0..1_000 {
            meeting.regressed(spot(4.0 + f64::from(index), 0.0));
        }
        assert!(meeting.regressed.len() <= REMEMBERED);
    }
}
