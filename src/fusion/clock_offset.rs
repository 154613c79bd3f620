//! A receiver's clock offset, from the files themselves.
//!
//! Whatever the camera's geometry, the target's motion in the image and the motion of its fixes
//! agree best when the clocks do: changes of position over a few seconds are regressed on changes of
//! box features, and the offset that leaves the least is the estimate. Changes, not positions,
//! because a receiver's slow bias then falls out. What never happens here: files, pairing.

use jiff::{SignedDuration, Timestamp};
use nalgebra::{SMatrix, SVector};

use crate::domain::{BoundingBox, Detection, Fix};
use crate::geo::{EastNorth, LocalPlane};

/// Features of a box: enough for a plane seen in perspective, and linear in what is sought.
const FEATURES: usize = 9;
/// Fewer rows than this tell nothing.
const FEWEST_ROWS: usize = 60;
/// More rows than this tell nothing new.
const MOST_ROWS: usize = 6_000;
/// Fixes are joined over at most this long a gap, s.
const LONGEST_GAP_S: f64 = 2.5;

/// What to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffsetSearch {
    /// Offsets from minus to plus this are tried, s.
    pub largest_s: f64,
    /// Changes are taken over this long, s.
    pub change_s: f64,
}

impl Default for OffsetSearch {
    fn default() -> Self {
        Self { largest_s: 10.0, change_s: 5.0 }
    }
}

/// An estimated offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffsetEstimate {
    /// To be added to the receiver's time to get the camera's.
    pub clock_offset: SignedDuration,
    /// Standard deviation of the estimate, s.
    pub sigma_s: f64,
    /// Share of the changes' variance that the boxes explain at that offset, 0 to 1.
    pub explained: f64,
    /// The same without an offset.
    pub explained_at_zero: f64,
    /// Changes used.
    pub rows: usize,
}

/// Estimates the clock offset of one receiver from its fixes and the boxes of its target, both in
/// order of time. `None` where target and time do not overlap enough, the target hardly moves, the
/// boxes explain less than a third of the motion, or the best offset lies at the end of the search.
#[must_use]
pub fn estimate_clock_offset(
    detections: &[Detection],
    fixes: &[(Timestamp, Fix)],
    search: &OffsetSearch,
) -> Option<OffsetEstimate> {
    let origin = fixes.first()?;
    let plane = LocalPlane::new(origin.1.position);
    let seconds = |time: Timestamp| time.duration_since(origin.0).as_secs_f64();
    let path: Vec<(f64, EastNorth)> =
        fixes.iter().map(|(time, fix)| (seconds(*time), plane.to_plane(fix.position))).collect();
    let boxes: Vec<(f64, SVector<f64, FEATURES>)> =
        detections.iter().map(|it| (seconds(it.time), features(it.bounding_box))).collect();
    let changes = changes(&boxes, search.change_s);
    let width_s = width_s(&path);
    let explained = |offset_s: f64| explained(&changes, &path, width_s, offset_s);

    let coarse_s = 0.5;
    let steps = (search.largest_s / coarse_s).floor().max(1.0);
    let grid = |step: i32| f64::from(step) * coarse_s;
    let (best_step, _) = (-(steps as i32)..=steps as i32)
        .filter_map(|step| Some((step, explained(grid(step))?.share)))
        .max_by(|one, other| one.1.total_cmp(&other.1))?;
    if f64::from(best_step.abs()) >= steps {
        return None;
    }
    let (middle, low, high) =
        (explained(grid(best_step))?, explained(grid(best_step - 1))?, explained(grid(best_step + 1))?);
    // The top of the parabola through the three best.
    let bend = low.share - 2.0 * middle.share + high.share;
    if bend >= 0.0 || middle.share < 1.0 / 3.0 {
        return None;
    }
    let offset_s = grid(best_step) + 0.5 * coarse_s * (low.share - high.share) / bend;
    // Overlapping changes are not independent: one new one per change_s.
    let independent = (middle.span_s / search.change_s).max(2.0);
    let sigma_s = ((1.0 - middle.share) * coarse_s * coarse_s / (-bend * independent)).sqrt();
    Some(OffsetEstimate {
        clock_offset: SignedDuration::from_millis((offset_s * 1_000.0).round() as i64),
        sigma_s,
        explained: explained(offset_s)?.share,
        explained_at_zero: explained(0.0).map_or(0.0, |fit| fit.share),
        rows: middle.rows,
    })
}

fn features(bounding_box: BoundingBox) -> SVector<f64, FEATURES> {
    let [x_px, y_px] = bounding_box.foot_px();
    // Any scale will do; this one keeps the normal equations well conditioned.
    let (x, y, height) = (x_px / 1_000.0, y_px / 1_000.0, bounding_box.height_px() / 200.0);
    SVector::from([x, y, height, x * x, x * y, y * y, y * y * y, x * y * y, height.recip().min(50.0)])
}

/// A change of features between two instants.
struct Change {
    from_s: f64,
    to_s: f64,
    features: SVector<f64, FEATURES>,
}

fn changes(boxes: &[(f64, SVector<f64, FEATURES>)], change_s: f64) -> Vec<Change> {
    let stride = boxes.len().div_ceil(MOST_ROWS).max(1);
    let mut ahead = 0;
    let mut changes = Vec::new();
    for (from_s, at_first) in boxes.iter().step_by(stride) {
        while ahead < boxes.len() && boxes[ahead].0 < from_s + change_s {
            ahead += 1;
        }
        let Some((to_s, at_last)) = boxes.get(ahead) else { break };
        if *to_s - from_s <= 1.2 * change_s {
            changes.push(Change { from_s: *from_s, to_s: *to_s, features: at_last - at_first });
        }
    }
    changes
}

/// How well the boxes explain the fixes' motion.
struct Explained {
    share: f64,
    rows: usize,
    span_s: f64,
}

/// Least squares of the fixes' changes on the boxes', both axes at once.
fn explained(
    changes: &[Change],
    path: &[(f64, EastNorth)],
    width_s: f64,
    offset_s: f64,
) -> Option<Explained> {
    let mut normal = SMatrix::<f64, FEATURES, FEATURES>::zeros();
    let mut mixed = SMatrix::<f64, FEATURES, 2>::zeros();
    let (mut total, mut rows, mut span_s, mut last_s) = (0.0, 0, 0.0, f64::NEG_INFINITY);
    for change in changes {
        // A fix of receiver time t belongs to camera time t + offset.
        let (Some(first), Some(last)) =
            (place(path, width_s, change.from_s - offset_s), place(path, width_s, change.to_s - offset_s))
        else {
            continue;
        };
        let moved = SVector::from([last.east_m - first.east_m, last.north_m - first.north_m]);
        normal += change.features * change.features.transpose();
        mixed += change.features * moved.transpose();
        total += moved.norm_squared();
        rows += 1;
        span_s += (change.from_s - last_s).clamp(0.0, LONGEST_GAP_S);
        last_s = change.from_s;
    }
    if rows < FEWEST_ROWS || total < rows as f64 * 0.25 {
        return None;
    }
    let ridge = 1e-9 * normal.trace() / FEATURES as f64;
    let solved = (normal + SMatrix::identity() * ridge).cholesky()?.solve(&mixed);
    Some(Explained { share: (solved.dot(&mixed) / total).clamp(0.0, 1.0), rows, span_s })
}

/// Where the receiver says it was, smoothed over its neighbours: a straight line fitted with
/// Gaussian weights. Plain interpolation halves the noise between fixes and not at them, and so
/// draws every estimate to half an interval.
fn place(path: &[(f64, EastNorth)], width_s: f64, at_s: f64) -> Option<EastNorth> {
    let reach_s = 3.0 * width_s;
    let begin = path.partition_point(|(time_s, _)| *time_s < at_s - reach_s);
    let middle = path.partition_point(|(time_s, _)| *time_s < at_s);
    let end = path.partition_point(|(time_s, _)| *time_s <= at_s + reach_s);
    // Fixes on both sides, and no hole where the instant lies.
    let (before, after) = (path.get(middle.checked_sub(1)?)?, path.get(middle)?);
    if after.0 - before.0 > LONGEST_GAP_S || begin + 1 >= end {
        return None;
    }
    let mut moments = [0.0; 3];
    let mut sums = [[0.0; 2]; 2];
    for (time_s, point) in &path[begin..end] {
        let away_s = time_s - at_s;
        let weight = (-0.5 * (away_s / width_s).powi(2)).exp();
        moments[0] += weight;
        moments[1] += weight * away_s;
        moments[2] += weight * away_s * away_s;
        for (sum, value) in sums.iter_mut().zip([point.east_m, point.north_m]) {
            sum[0] += weight * value;
            sum[1] += weight * away_s * value;
        }
    }
    let determinant = moments[0] * moments[2] - moments[1] * moments[1];
    let level = |sum: [f64; 2]| (moments[2] * sum[0] - moments[1] * sum[1]) / determinant;
    (determinant > 1e-9).then(|| EastNorth { east_m: level(sums[0]), north_m: level(sums[1]) })
}

/// Width of the smoothing, s: three quarters of the fixes' usual interval.
fn width_s(path: &[(f64, EastNorth)]) -> f64 {
    let mut intervals: Vec<f64> = path.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    intervals.sort_by(f64::total_cmp);
    0.75 * intervals.get(intervals.len() / 2).copied().unwrap_or(1.0).clamp(0.2, LONGEST_GAP_S)
}
