//! Tracklets in the plane and the fixes of receivers, as association compares them.

use crate::geo::EastNorth;

/// Overlap of two tracklets of one target that is tolerated, s: trackers hold on to a target for some frames.
pub(super) const MAX_OVERLAP_S: f64 = 0.6;

/// Position of a tracklet at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TrackPoint {
    /// Seconds since a common origin.
    pub(super) time_s: f64,
    /// Position, m.
    pub(super) position: EastNorth,
    /// Variance per axis of the part of its error that is independent from box to box, m2.
    pub(super) box_variance_m2: f64,
    /// Variance per axis of the part of its error that is alike at places nearby, m2.
    pub(super) map_variance_m2: f64,
}

/// The boxes of one tracker's id, in order of time.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Tracklet {
    /// Its positions.
    pub(super) points: Vec<TrackPoint>,
}

/// One fix of a receiver by the camera's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TimedFix {
    /// Seconds since a common origin.
    pub(super) time_s: f64,
    /// Position, m.
    pub(super) position: EastNorth,
    /// Variance per axis that the receiver states, m2.
    pub(super) stated_variance_m2: Option<f64>,
}

/// Difference of a fix and a tracklet's position at its instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Residual {
    pub(super) fix: TimedFix,
    pub(super) difference_m: [f64; 2],
    pub(super) box_variance_m2: f64,
    pub(super) map_variance_m2: f64,
}

impl Tracklet {
    /// First and last instant, s; an empty interval without points.
    #[must_use]
    pub(super) fn span_s(&self) -> [f64; 2] {
        match (self.points.first(), self.points.last()) {
            (Some(first), Some(last)) => [first.time_s, last.time_s],
            _ => [f64::INFINITY, f64::NEG_INFINITY],
        }
    }

    /// The position at an instant on the straight line between neighbours at most `max_gap_s` apart.
    pub(super) fn at(&self, time_s: f64, max_gap_s: f64) -> Option<TrackPoint> {
        Self::between(&self.points, time_s, max_gap_s)
    }

    /// The same of some points.
    pub(super) fn between(points: &[TrackPoint], time_s: f64, max_gap_s: f64) -> Option<TrackPoint> {
        let next = points.partition_point(|point| point.time_s < time_s);
        let after = points.get(next)?;
        let Some(before) = next.checked_sub(1).map(|at| &points[at]) else {
            return (after.time_s <= time_s).then_some(*after);
        };
        let gap_s = after.time_s - before.time_s;
        if gap_s > max_gap_s {
            return None;
        }
        let share = if gap_s > 0.0 { (time_s - before.time_s) / gap_s } else { 0.0 };
        let mix = |of: fn(&TrackPoint) -> f64| (1.0 - share) * of(before) + share * of(after);
        Some(TrackPoint {
            time_s,
            position: EastNorth {
                east_m: mix(|point| point.position.east_m),
                north_m: mix(|point| point.position.north_m),
            },
            box_variance_m2: mix(|point| point.box_variance_m2),
            map_variance_m2: mix(|point| point.map_variance_m2),
        })
    }

    /// The differences of all fixes (in order of time, shifted by `offset_s`) within the tracklet.
    pub(super) fn residuals(&self, fixes: &[TimedFix], offset_s: f64, max_gap_s: f64) -> Vec<Residual> {
        let [from_s, to_s] = self.span_s();
        let begin = fixes.partition_point(|fix| fix.time_s + offset_s < from_s);
        fixes[begin..]
            .iter()
            .take_while(|fix| fix.time_s + offset_s <= to_s)
            .filter_map(|fix| {
                let point = self.at(fix.time_s + offset_s, max_gap_s)?;
                Some(Residual {
                    fix: TimedFix { time_s: fix.time_s + offset_s, ..*fix },
                    difference_m: [
                        fix.position.east_m - point.position.east_m,
                        fix.position.north_m - point.position.north_m,
                    ],
                    box_variance_m2: point.box_variance_m2,
                    map_variance_m2: point.map_variance_m2,
                })
            })
            .collect()
    }
}

/// Mean number of tracklets with these spans that are seen at the same time as one with the first span, itself included.
pub(super) fn concurrent([from_s, to_s]: [f64; 2], spans_s: impl Iterator<Item = [f64; 2]>) -> f64 {
    let overlaps_s = spans_s.map(|[first_s, last_s]| (to_s.min(last_s) - from_s.max(first_s)).max(0.0));
    (overlaps_s.sum::<f64>() / (to_s - from_s).max(0.5)).max(1.0)
}

/// How the targets of a scene move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SceneMotion {
    /// Standard deviation of their positions per axis, m.
    pub(super) spread_m: f64,
    /// Root mean square of their speed per axis, m/s.
    pub(super) speed_m_s: f64,
    /// The same of slow, usual and fast targets, m/s: each stands for as many of them.
    pub(super) speeds_m_s: [f64; 3],
}

impl SceneMotion {
    /// Time over which a speed is measured, s: longer than the noise of boxes matters.
    const BASELINE_S: f64 = 2.0;
    /// The same of who stands: people sway.
    const LEAST_SPEED_M_S: f64 = 0.05;

    /// Returns the motion of the targets that the tracklets show.
    #[must_use]
    pub(super) fn of(tracklets: &[Tracklet]) -> Self {
        let points = || tracklets.iter().flat_map(|tracklet| &tracklet.points);
        let count = points().count().max(1) as f64;
        let mean = |of: fn(&TrackPoint) -> f64| points().map(of).sum::<f64>() / count;
        let variance = |of: fn(&TrackPoint) -> f64| {
            let centre = mean(of);
            points().map(|point| (of(point) - centre).powi(2)).sum::<f64>() / count
        };
        let spread = variance(|point| point.position.east_m) + variance(|point| point.position.north_m);
        let mut squares: Vec<Vec<f64>> = tracklets.iter().map(Self::squared_speeds_m2_s2).collect();
        squares.retain(|own| !own.is_empty());
        let per_axis = |squares: &mut dyn Iterator<Item = f64>| {
            let (sum, count) = squares.fold((0.0, 0.0), |(sum, count), square| (sum + square, count + 1.0));
            if count > 0.0 { (0.5 * sum / count).sqrt() } else { 0.0 }
        };
        let mut speeds: Vec<f64> = squares.iter().map(|own| per_axis(&mut own.iter().copied())).collect();
        speeds.sort_by(f64::total_cmp);
        let quantile = |sixth: usize| speeds.get(speeds.len() * sixth / 6).copied().unwrap_or(0.0);
        let speed_m_s = per_axis(&mut squares.iter().flatten().copied());
        Self {
            spread_m: (0.5 * spread).sqrt().max(3.0),
            speed_m_s: speed_m_s.max(0.3),
            speeds_m_s: [1, 3, 5].map(|sixth| quantile(sixth).max(Self::LEAST_SPEED_M_S)),
        }
    }

    /// Squares of a target's speeds over [`Self::BASELINE_S`], m2/s2.
    fn squared_speeds_m2_s2(tracklet: &Tracklet) -> Vec<f64> {
        let (mut from, mut squares) = (0, Vec::new());
        for (at, point) in tracklet.points.iter().enumerate() {
            let first = &tracklet.points[from];
            let elapsed_s = point.time_s - first.time_s;
            if elapsed_s >= Self::BASELINE_S {
                squares.push((point.position.distance_m(first.position) / elapsed_s).powi(2));
                from = at;
            }
        }
        squares
    }
}
