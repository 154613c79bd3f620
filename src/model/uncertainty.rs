//! How sure a fitted encoder is, from held-out residuals: the error of the regression without the
//! receiver's.
//!
//! Squared misses less the receiver's variance would be the plain way (METHOD 2.4), but the
//! difference of two large numbers is mostly noise. Passes tell it better: within one patch of the
//! image the receiver's errors of different passes are independent, so what their means share is
//! the regression's own error. What never happens here: a look at the truth.

use super::FitError;
use super::artifact::Parts;
use super::coverage::Coverage;
use super::regressor::{R95_PER_SIGMA, Regressor};
use super::rows::{Row, Rows, median};
use super::select::BLOCKS;
use super::whitening::FixNoise;
use crate::domain::BoundingBox;
use crate::geo::EastNorth;

/// Patches of the image.
const PATCHES: usize = 64;
/// Unknowns per axis of the simplest map, for the error that the fixes' noise must leave.
const UNKNOWNS_PER_AXIS: f64 = 4.0;
/// The error varies over the image, so its distribution has longer tails than a normal one.
const TAIL: f64 = 1.2;
/// Factor on the error variance of boxes that the image's border cuts, where training had few.
const RARE_BORDER_FACTOR: f64 = 4.0;
/// Share of training boxes whose reconstruction error is usual for certain, and the factor on it up
/// to which any is.
const USUAL: f64 = 0.995;
const USUAL_FACTOR: f64 = 2.0;

/// What [`calibrate`] found, per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Calibration {
    /// Error variance of the regression, mean over the training boxes, m2.
    pub(super) error_m2: f64,
    /// The receiver's variance as the rows show it, with what lasts for a whole block of time, m2.
    pub(super) receiver_m2: f64,
}

/// Sets the error's size and shape in the parts of a model.
///
/// `residuals` are regressed position less fix (m) of each row, by encoders that had not seen it.
pub(super) fn calibrate(
    parts: &mut Parts,
    rows: &Rows,
    residuals: &[[f64; 2]],
    noise: &FixNoise,
) -> Result<Calibration, FitError> {
    let mut coverage = Coverage::new(rows.rows.iter().map(|row| row.bounding_box));
    set_plain(parts, &coverage);
    let regressor = Regressor::build(parts.clone()).map_err(|error| FitError::Fault(error.into()))?;
    let points: Vec<EastNorth> =
        rows.rows.iter().map(|row| regressor.regress(&row.bounding_box, None).regressed).collect();
    let mut rebuilt: Vec<f64> =
        rows.rows.iter().map(|row| regressor.regress(&row.bounding_box, None).reconstruction_error).collect();
    rebuilt.sort_by(f64::total_cmp);
    let usual = rebuilt[((rebuilt.len() - 1) as f64 * USUAL) as usize].max(1e-4) * USUAL_FACTOR;

    let independent = independent_fixes(&rows.rows, noise);
    let floor_m2 = UNKNOWNS_PER_AXIS * noise.variance_m2 / independent;
    let shared_m2 = match shared_error(rows, &coverage, residuals) {
        Some(shared_m2) => shared_m2,
        None => few_passes_error(residuals, noise, independent),
    };
    let own: Vec<[f64; 2]> = rows
        .rows
        .iter()
        .zip(&points)
        .map(|(row, point)| [point.east_m - row.label.east_m, point.north_m - row.label.north_m])
        .collect();
    let lasting_m2 = lasting_m2(residuals, &own);
    let error_m2 =
        shared_m2.max(floor_m2).max(lasting_m2 / f64::from(BLOCKS)) + jitter_m2(&rows.rows, &points);
    let error_m2 = error_m2.max(1e-4);

    let boxes: Vec<BoundingBox> = coverage.boxes().collect();
    let slopes: Vec<f64> = boxes.iter().map(|centre| slope_m2(&regressor, centre)).collect();
    let mut counts = vec![0.0; boxes.len()];
    for row in &rows.rows {
        counts[coverage.nearest(&row.bounding_box)] += 1.0;
    }
    let total: f64 = counts.iter().sum();
    let mean = |values: &mut dyn Iterator<Item = f64>| {
        values.zip(&counts).map(|(value, count)| value * count).sum::<f64>() / total
    };
    // Errors in pixels grow with the metres that a pixel spans; half of the error goes with that.
    let usual_slope_m2 = mean(&mut slopes.iter().copied()).max(1e-12);
    coverage.errors_m2 = slopes
        .iter()
        .map(|slope| (error_m2 * (0.5 + 0.5 * (slope / usual_slope_m2).min(20.0))) as f32)
        .collect();
    let height_m2 =
        mean(&mut slopes.iter().zip(&boxes).map(|(slope, centre)| slope * centre.height_px().powi(2)));
    parts.error_scale = height_m2.clamp(1e-9, 1e9);
    parts.parameters.insert("reconstruction_usual".to_owned(), usual);
    parts.parameters.insert("r95_scale".to_owned(), TAIL * R95_PER_SIGMA);
    let image_size = regressor.image_size();
    let cut = rows.rows.iter().filter(|row| row.bounding_box.touches_border(image_size)).count();
    // Where training has seen many cut boxes, their error is in the figures already.
    let rare = (cut as f64) < 0.03 * rows.rows.len() as f64;
    parts.parameters.insert("border_factor".to_owned(), if rare { RARE_BORDER_FACTOR } else { 1.0 });
    parts.parameters.insert("independent_fixes".to_owned(), independent);
    parts.put_coverage(&coverage);
    Ok(Calibration { error_m2, receiver_m2: scatter_m2(&own) + lasting_m2 })
}

/// Values with which the encoder can be built before it is calibrated.
pub(super) fn set_plain(parts: &mut Parts, coverage: &Coverage) {
    parts.put_coverage(coverage);
    parts.parameters.insert("border_factor".to_owned(), 1.0);
    parts.parameters.insert("reconstruction_usual".to_owned(), 1.0);
    parts.parameters.insert("r95_scale".to_owned(), R95_PER_SIGMA);
}

/// How many independent fixes the rows are worth, per axis.
pub(super) fn independent_fixes(rows: &[Row], noise: &FixNoise) -> f64 {
    let stays = 1.0 - noise.white_share;
    let mut sum = 0.0;
    for pass in rows.chunk_by(|one, other| one.pass == other.pass) {
        let seconds = pass[pass.len() - 1].time_s - pass[0].time_s;
        let spells = (1.0 + 0.5 * seconds / noise.time_constant_s).min(pass.len() as f64);
        sum += 1.0 / (noise.white_share / pass.len() as f64 + stays / spells);
    }
    sum.max(1.0)
}

/// Variance per axis of what stays the same for a whole block of time, m2: held-out fixes scatter
/// more about a map that other blocks have made than a map's own fixes do, by it and by the share
/// of it that those other blocks left in the map.
fn lasting_m2(held_out: &[[f64; 2]], own: &[[f64; 2]]) -> f64 {
    let others = f64::from(BLOCKS - 1);
    (scatter_m2(held_out) - scatter_m2(own)).max(0.0) * others / (others + 1.0)
}

/// Variance per axis of residuals by their median, which a few wild ones do not move, m2.
fn scatter_m2(residuals: &[[f64; 2]]) -> f64 {
    let squares = residuals.iter().map(|[east, north]| 0.5 * (east * east + north * north));
    median(squares.collect()) / std::f64::consts::LN_2
}

/// Variance per axis that the passes through one patch share, over all patches, m2, with
/// its own standard error on top; `None` where too few patches have three passes.
fn shared_error(rows: &Rows, coverage: &Coverage, residuals: &[[f64; 2]]) -> Option<f64> {
    let patches = coverage.coarse(PATCHES);
    let mut means: Vec<Vec<(f64, [f64; 2])>> = vec![Vec::new(); PATCHES];
    let mut at = 0;
    for pass in rows.rows.chunk_by(|one, other| one.pass == other.pass) {
        let mut sums = vec![(0.0, [0.0; 2]); PATCHES];
        for (row, residual) in pass.iter().zip(&residuals[at..]) {
            let (count, sum) = &mut sums[patches.nearest(&row.bounding_box)];
            *count += 1.0;
            (sum[0], sum[1]) = (sum[0] + residual[0], sum[1] + residual[1]);
        }
        at += pass.len();
        for (patch, (count, sum)) in means.iter_mut().zip(sums).filter(|(_, sum)| sum.0 > 0.0) {
            patch.push((count, sum.map(|sum| sum / count)));
        }
    }
    let (mut sum, mut squares, mut weights, mut weights2) = (0.0, 0.0, 0.0, 0.0);
    let mut used = 0;
    for patch in means.iter().filter(|patch| patch.len() >= 3) {
        let count = patch.len() as f64;
        let rows: f64 = patch.iter().map(|(rows, _)| rows).sum();
        let mut own = 0.0;
        for axis in 0..2 {
            // Medians and means agree without outliers; the bound keeps one bad pass harmless.
            let middle = median(patch.iter().map(|(_, mean)| mean[axis]).collect());
            let spread = 1.48 * median(patch.iter().map(|(_, mean)| (mean[axis] - middle).abs()).collect());
            let bound = 3.0 * spread + 1e-9;
            let bounded = |mean: &[f64; 2]| mean[axis].clamp(middle - bound, middle + bound);
            let mean = patch.iter().map(|(_, mean)| bounded(mean)).sum::<f64>() / count;
            let scatter = patch.iter().map(|(_, at)| (bounded(at) - mean).powi(2)).sum::<f64>();
            own += 0.5 * (mean * mean - scatter / (count * (count - 1.0)));
        }
        used += 1;
        sum += rows * own;
        squares += rows * rows * own * own;
        weights += rows;
        weights2 += rows * rows;
    }
    if used < 6 || weights < 0.5 * rows.rows.len() as f64 {
        return None;
    }
    let mean = sum / weights;
    let standard =
        (squares / (weights * weights) - mean * mean * weights2 / (weights * weights)).max(0.0).sqrt();
    Some(mean.max(0.0) + standard)
}

/// Where passes are too few to compare: the plain difference, not trusted below what so few
/// independent fixes can tell.
fn few_passes_error(residuals: &[[f64; 2]], noise: &FixNoise, independent: f64) -> f64 {
    let doubt_m2 = noise.variance_m2 / independent.sqrt();
    (scatter_m2(residuals) - noise.variance_m2).max(doubt_m2)
}

/// Variance per axis of the frame-to-frame unrest of regressed positions, m2, from their second
/// differences; what a steady target's box noise makes of them.
fn jitter_m2(rows: &[Row], points: &[EastNorth]) -> f64 {
    let mut jumps = Vec::new();
    for (rows, points) in rows.windows(3).zip(points.windows(3)) {
        let (first_s, second_s) = (rows[1].time_s - rows[0].time_s, rows[2].time_s - rows[1].time_s);
        let even = first_s > 0.0 && first_s < 2.5 && (first_s - second_s).abs() < 0.1 * first_s;
        if even && rows[0].pass == rows[2].pass {
            let jump = |of: &dyn Fn(EastNorth) -> f64| of(points[2]) - 2.0 * of(points[1]) + of(points[0]);
            jumps.push(jump(&|point| point.east_m).powi(2) + jump(&|point| point.north_m).powi(2));
        }
    }
    jumps.sort_by(f64::total_cmp);
    // The largest few are halts and turns; a mean of the rest, since far targets jitter more.
    jumps.truncate((jumps.len() as f64 * 0.97) as usize);
    jumps.iter().sum::<f64>() / (2.0 * 6.0 * jumps.len().max(1) as f64)
}

/// Variance per axis in m2 that one pixel of noise in both coordinates of the foot makes.
fn slope_m2(regressor: &Regressor, centre: &BoundingBox) -> f64 {
    let moved = |right_px: f64, down_px: f64| {
        let [left, top, width, height] = centre.sides_px();
        BoundingBox::new(left + right_px, top + down_px, width, height)
            .map_or(EastNorth::default(), |moved| regressor.regress(&moved, None).regressed)
    };
    let across_m = moved(1.0, 0.0).distance_m(moved(-1.0, 0.0)) / 2.0;
    let along_m = moved(0.0, 1.0).distance_m(moved(0.0, -1.0)) / 2.0;
    0.5 * (across_m * across_m + along_m * along_m)
}
