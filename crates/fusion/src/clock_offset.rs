//! Estimates the offset of a receiver's clock from recorded boxes and fixes.
//!
//! For any camera geometry, motion in the image and motion of the fixes agree best at the true offset.
//! Displacements over a few seconds are regressed linearly on differences of box features; the estimate
//! maximises the explained share of their variance (R^2) over the offset. Displacements instead of
//! positions cancel the receiver's slow bias. Does not read files or pair.

use jiff::{SignedDuration, Timestamp};
use nalgebra::{SMatrix, SVector};

use crate::domain::{BoundingBox, Detection, Fix};
use crate::geo::{EastNorth, LocalPlane};

/// Features of a box: a linear basis that approximates the perspective view of a plane.
const FEATURES: usize = 9;
/// The estimate needs at least this many rows.
const MIN_ROWS: usize = 60;
/// Boxes are subsampled to at most about this many rows.
const MAX_ROWS: usize = 6_000;
/// Fixes are interpolated over at most this gap, s.
const MAX_GAP_S: f64 = 2.5;

/// Step of the search grid, s.
const GRID_STEP_S: f64 = 0.5;

/// Parameters of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffsetSearch {
    /// Largest absolute offset, s.
    pub max_offset_s: f64,
    /// Time between the two ends of a displacement, s.
    pub baseline_s: f64,
}

impl Default for OffsetSearch {
    fn default() -> Self {
        Self { max_offset_s: 10.0, baseline_s: 5.0 }
    }
}

/// An estimated offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffsetEstimate {
    /// Added to the receiver's time it gives the camera's time.
    pub clock_offset: SignedDuration,
    /// Standard deviation of the estimate, s.
    pub sigma_s: f64,
    /// R^2 at that offset: the explained share of the displacements' variance, 0 to 1.
    pub explained: f64,
    /// R^2 at offset 0.
    pub explained_at_zero: f64,
    /// Number of displacements used.
    pub rows: usize,
}

/// Estimates the clock offset of one receiver from its fixes and the boxes of its target, both in
/// order of time. `None` if boxes and fixes overlap too little in time, the target hardly moves, the
/// boxes explain less than a third of the motion, or the best offset is at the limit of the search.
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
    let differences = feature_differences(&boxes, search.baseline_s);
    let width_s = width_s(&path);
    let explained = |offset_s: f64| explained(&differences, &path, width_s, offset_s);

    let steps = (search.max_offset_s / GRID_STEP_S).floor().max(1.0);
    let grid = |step: i32| f64::from(step) * GRID_STEP_S;
    let (best_step, _) = (-(steps as i32)..=steps as i32)
        .filter_map(|step| Some((step, explained(grid(step))?.share)))
        .max_by(|one, other| one.1.total_cmp(&other.1))?;
    if f64::from(best_step.abs()) >= steps {
        return None;
    }
    let (best, low, high) =
        (explained(grid(best_step))?, explained(grid(best_step - 1))?, explained(grid(best_step + 1))?);
    // The maximum of the parabola through the three points about the best.
    let curvature = low.share - 2.0 * best.share + high.share;
    if curvature >= 0.0 || best.share < 1.0 / 3.0 {
        return None;
    }
    let offset_s = grid(best_step) + 0.5 * GRID_STEP_S * (low.share - high.share) / curvature;
    // Overlapping displacements are correlated: one independent displacement per baseline.
    let independent = (best.span_s / search.baseline_s).max(2.0);
    let sigma_s = ((1.0 - best.share) * GRID_STEP_S * GRID_STEP_S / (-curvature * independent)).sqrt();
    Some(OffsetEstimate {
        clock_offset: SignedDuration::from_millis((offset_s * 1_000.0).round() as i64),
        sigma_s,
        explained: explained(offset_s)?.share,
        explained_at_zero: explained(0.0).map_or(0.0, |fit| fit.share),
        rows: best.rows,
    })
}

fn features(bounding_box: BoundingBox) -> SVector<f64, FEATURES> {
    let [x_px, y_px] = bounding_box.foot_px();
    // Scaled to keep the normal equations well conditioned.
    let (x, y, height) = (x_px / 1_000.0, y_px / 1_000.0, bounding_box.height_px() / 200.0);
    SVector::from([x, y, height, x * x, x * y, y * y, y * y * y, x * y * y, height.recip().min(50.0)])
}

/// Difference of features between two instants.
struct FeatureDifference {
    from_s: f64,
    to_s: f64,
    features: SVector<f64, FEATURES>,
}

fn feature_differences(boxes: &[(f64, SVector<f64, FEATURES>)], baseline_s: f64) -> Vec<FeatureDifference> {
    let stride = boxes.len().div_ceil(MAX_ROWS).max(1);
    let mut ahead = 0;
    let mut differences = Vec::new();
    for (from_s, at_first) in boxes.iter().step_by(stride) {
        while ahead < boxes.len() && boxes[ahead].0 < from_s + baseline_s {
            ahead += 1;
        }
        let Some((to_s, at_last)) = boxes.get(ahead) else { break };
        if *to_s - from_s <= 1.2 * baseline_s {
            differences.push(FeatureDifference {
                from_s: *from_s,
                to_s: *to_s,
                features: at_last - at_first,
            });
        }
    }
    differences
}

/// How well the boxes explain the motion of the fixes.
struct Explained {
    /// Share of the variance that is explained, R^2.
    share: f64,
    rows: usize,
    /// Time covered, without gaps.
    span_s: f64,
}

/// Least squares of the fixes' displacements on the feature differences, for both axes.
fn explained(
    differences: &[FeatureDifference],
    path: &[(f64, EastNorth)],
    width_s: f64,
    offset_s: f64,
) -> Option<Explained> {
    let mut normal = SMatrix::<f64, FEATURES, FEATURES>::zeros();
    let mut mixed = SMatrix::<f64, FEATURES, 2>::zeros();
    let (mut total, mut rows, mut span_s, mut last_s) = (0.0, 0, 0.0, f64::NEG_INFINITY);
    for difference in differences {
        // A fix of receiver time t belongs to camera time t + offset.
        let (Some(first), Some(last)) = (
            smoothed_position(path, width_s, difference.from_s - offset_s),
            smoothed_position(path, width_s, difference.to_s - offset_s),
        ) else {
            continue;
        };
        let displacement = SVector::from([last.east_m - first.east_m, last.north_m - first.north_m]);
        normal += difference.features * difference.features.transpose();
        mixed += difference.features * displacement.transpose();
        total += displacement.norm_squared();
        rows += 1;
        span_s += (difference.from_s - last_s).clamp(0.0, MAX_GAP_S);
        last_s = difference.from_s;
    }
    if rows < MIN_ROWS || total < rows as f64 * 0.25 {
        return None;
    }
    let ridge = 1e-9 * normal.trace() / FEATURES as f64;
    let solved = (normal + SMatrix::identity() * ridge).cholesky()?.solve(&mixed);
    Some(Explained { share: (solved.dot(&mixed) / total).clamp(0.0, 1.0), rows, span_s })
}

/// The receiver's position at an instant by local linear regression with Gaussian weights. Linear
/// interpolation would average the noise between fixes but not at them, and so bias the estimate
/// towards half an interval.
fn smoothed_position(path: &[(f64, EastNorth)], width_s: f64, at_s: f64) -> Option<EastNorth> {
    let reach_s = 3.0 * width_s;
    let begin = path.partition_point(|(time_s, _)| *time_s < at_s - reach_s);
    let next = path.partition_point(|(time_s, _)| *time_s < at_s);
    let end = path.partition_point(|(time_s, _)| *time_s <= at_s + reach_s);
    // Fixes on both sides, without a gap at the instant.
    let (before, after) = (path.get(next.checked_sub(1)?)?, path.get(next)?);
    if after.0 - before.0 > MAX_GAP_S || begin + 1 >= end {
        return None;
    }
    let mut moments = [0.0; 3];
    let mut sums = [[0.0; 2]; 2];
    for (time_s, point) in &path[begin..end] {
        let offset_s = time_s - at_s;
        let weight = (-0.5 * (offset_s / width_s).powi(2)).exp();
        moments[0] += weight;
        moments[1] += weight * offset_s;
        moments[2] += weight * offset_s * offset_s;
        for (sum, value) in sums.iter_mut().zip([point.east_m, point.north_m]) {
            sum[0] += weight * value;
            sum[1] += weight * offset_s * value;
        }
    }
    let determinant = moments[0] * moments[2] - moments[1] * moments[1];
    let intercept = |sum: [f64; 2]| (moments[2] * sum[0] - moments[1] * sum[1]) / determinant;
    (determinant > 1e-9).then(|| EastNorth { east_m: intercept(sums[0]), north_m: intercept(sums[1]) })
}

/// Standard deviation of the smoothing window, s: three quarters of the fixes' median interval.
fn width_s(path: &[(f64, EastNorth)]) -> f64 {
    let mut intervals: Vec<f64> = path.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    intervals.sort_by(f64::total_cmp);
    0.75 * intervals.get(intervals.len() / 2).copied().unwrap_or(1.0).clamp(0.2, MAX_GAP_S)
}
