//! Training samples in the form that every recipe learns from: metres, sorted by target and time,
//! cut into passes and into blocks of time.
//!
//! What never happens here: learning; a look at a sample's truth.

use std::collections::HashMap;

use jiff::Timestamp;
use sha2::{Digest, Sha256};

use super::FitError;
use super::whitening::FixNoise;
use crate::domain::{BoundingBox, Error, ErrorKind, Sample};
use crate::filters::{FixError, smooth_traverse, tune_acceleration};
use crate::geo::{EastNorth, LocalPlane, Position};

/// Fewer samples cannot tell a camera from its noise.
pub const FEWEST_SAMPLES: u64 = 20;
/// Fixes that reach less far apart are all at one spot, m.
pub const SMALLEST_SPREAD_M: f64 = 1.0;
/// A hole in a target's samples beyond this, and beyond ten times their usual step, ends a pass.
const PASS_HOLE_S: f64 = 3.0;

/// One training sample.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row {
    /// Seconds since the first sample.
    pub(super) time_s: f64,
    /// Counts targets from 0.
    pub(super) target: u32,
    /// Counts passes from 0; rows of a pass stand together in the order of time.
    pub(super) pass: u32,
    pub(super) bounding_box: BoundingBox,
    /// The fix.
    pub(super) position: Position,
    /// The fix in the plane, or what the smoother made of it.
    pub(super) label: EastNorth,
    /// Error variance per axis that the receiver itself gave, m2.
    pub(super) own_variance_m2: Option<f64>,
}

/// All samples of a fit.
#[derive(Debug, Clone)]
pub(super) struct Rows {
    pub(super) plane: LocalPlane,
    pub(super) rows: Vec<Row>,
    pub(super) targets: u32,
    pub(super) passes: u32,
}

impl Rows {
    /// Sorts, projects and cuts the samples.
    ///
    /// # Errors
    /// Refuses sets that are empty, smaller than [`FEWEST_SAMPLES`], mostly one repeated row, or all at one
    /// spot.
    pub(super) fn new(samples: &[Sample]) -> Result<Self, FitError> {
        if samples.is_empty() {
            return Err(unusable("there are none; import samples that have a box and a fix first".into()));
        }
        if (samples.len() as u64) < FEWEST_SAMPLES {
            return Err(unusable(format!(
                "there are {}, a fit needs at least {FEWEST_SAMPLES}; import more, best of several passes \
                 through different parts of the image",
                samples.len()
            )));
        }
        let mut sorted: Vec<&Sample> = samples.iter().collect();
        sorted.sort_by(|left, right| (&left.target_id, left.time).cmp(&(&right.target_id, right.time)));
        let plane = central_plane(&sorted);
        let first = sorted.iter().map(|sample| sample.time).min().unwrap_or(Timestamp::UNIX_EPOCH);
        let mut rows = Vec::with_capacity(sorted.len());
        let mut target = 0;
        for (at, sample) in sorted.iter().enumerate() {
            target += u32::from(at > 0 && sorted[at - 1].target_id != sample.target_id);
            rows.push(Row {
                time_s: (sample.time.as_microsecond() - first.as_microsecond()) as f64 * 1e-6,
                target,
                pass: 0,
                bounding_box: sample.bounding_box,
                position: sample.fix.position,
                label: plane.to_plane(sample.fix.position),
                own_variance_m2: sample.fix.sigma_m.map(|sigma| sigma.variance_m2()),
            });
        }
        let passes = number_passes(&mut rows);
        let all = Self { plane, rows, targets: target + 1, passes };
        all.refuse_repeated()?;
        all.refuse_one_spot()?;
        Ok(all)
    }

    /// Refuses sets of which more than half is one and the same box and fix: a stuck detector or receiver.
    /// Such rows would outweigh all others, and a model that only repeats them would have the least error.
    fn refuse_repeated(&self) -> Result<(), FitError> {
        let mut counts: HashMap<[u64; 6], usize> = HashMap::new();
        for row in &self.rows {
            let [left, top, width, height] = row.bounding_box.sides_px();
            let values =
                [left, top, width, height, row.position.longitude_deg(), row.position.latitude_deg()];
            *counts.entry(values.map(f64::to_bits)).or_default() += 1;
        }
        let most = counts.into_values().max().unwrap_or(0);
        if 2 * most > self.rows.len() {
            return Err(unusable(format!(
                "{most} of {} repeat one and the same box and fix, so detector or receiver were stuck; \
                 delete those (DELETE /v1/cameras/{{camera}}/samples?from=...&until=...), or train on a \
                 range of time without them",
                self.rows.len()
            )));
        }
        Ok(())
    }

    fn refuse_one_spot(&self) -> Result<(), FitError> {
        let spread = |value: &dyn Fn(&Row) -> f64| spread(self.rows.iter().map(value));
        let in_image = spread(&|row| row.bounding_box.foot_px()[0])
            .max(spread(&|row| row.bounding_box.foot_px()[1]))
            .max(spread(&|row| row.bounding_box.height_px()));
        if in_image < 1.0 {
            return Err(unusable(format!(
                "all {} boxes are at one spot of the image (they vary by {in_image:.1} px); let the target \
                 walk through the whole picture while samples are taken",
                self.rows.len()
            )));
        }
        let on_ground = spread(&|row| row.label.east_m).max(spread(&|row| row.label.north_m));
        if on_ground < 0.1 * SMALLEST_SPREAD_M {
            return Err(unusable(format!(
                "all {} fixes are at one spot (they vary by {on_ground:.2} m) though the boxes move; check \
                 that boxes and fixes are paired by time",
                self.rows.len()
            )));
        }
        Ok(())
    }

    /// Block of time of each row, 0 to `count - 1`: cuts at the largest holes near equal shares, so
    /// that passes stay whole where they can. Rows of all targets at one time share a block.
    pub(super) fn blocks(&self, count: u32) -> Vec<u32> {
        let mut times: Vec<f64> = self.rows.iter().map(|row| row.time_s).collect();
        times.sort_by(f64::total_cmp);
        let share = times.len() / count as usize;
        let cuts: Vec<f64> = (1..count as usize)
            .map(|cut| {
                let (low, high) = (cut * share - share / 3, cut * share + share / 3);
                let hole = |at: usize| times[at] - times[at - 1];
                let at = (low.max(1)..=high.min(times.len() - 1))
                    .max_by(|left, right| {
                        hole(*left)
                            .total_cmp(&hole(*right))
                            .then_with(|| right.abs_diff(cut * share).cmp(&left.abs_diff(cut * share)))
                    })
                    .unwrap_or(cut * share);
                times[at]
            })
            .collect();
        let blocks: Vec<u32> = self
            .rows
            .iter()
            .map(|row| cuts.iter().filter(|cut| row.time_s >= **cut).count() as u32)
            .collect();
        let least = (0..count).map(|block| blocks.iter().filter(|of| **of == block).count()).min();
        if least.unwrap_or(0) * 4 >= share {
            return blocks;
        }
        // Too many rows at one instant to cut by time: by rank then.
        let mut order: Vec<usize> = (0..self.rows.len()).collect();
        order.sort_by(|one, other| self.rows[*one].time_s.total_cmp(&self.rows[*other].time_s));
        let mut blocks = vec![0; self.rows.len()];
        for (rank, at) in order.into_iter().enumerate() {
            blocks[at] = (rank * count as usize / self.rows.len()) as u32;
        }
        blocks
    }

    /// Some of the rows, in the same plane.
    pub(super) fn filtered(&self, keep: impl Fn(usize) -> bool) -> Self {
        let rows = self.rows.iter().enumerate().filter(|(at, _)| keep(*at)).map(|(_, row)| *row).collect();
        Self { rows, ..*self }
    }

    /// The same rows with labels that a kinematic smoother made of each pass's fixes.
    pub(super) fn smoothed(&self, noise: &FixNoise) -> Self {
        let error = FixError {
            white_m: (noise.variance_m2 * noise.white_share).sqrt().max(0.01),
            coloured_m: (noise.variance_m2 * (1.0 - noise.white_share)).sqrt(),
            time_constant_s: noise.time_constant_s,
        };
        let passes: Vec<(Vec<f64>, Vec<EastNorth>)> = self
            .rows
            .chunk_by(|one, other| one.pass == other.pass)
            .map(|pass| pass.iter().map(|row| (row.time_s, row.label)).unzip())
            .collect();
        let acceleration_mps2 = tune_acceleration(&passes, &error);
        let labels = passes
            .iter()
            .flat_map(|(times_s, fixes)| smooth_traverse(times_s, fixes, &error, acceleration_mps2));
        let mut smoothed = self.clone();
        for (row, label) in smoothed.rows.iter_mut().zip(labels) {
            row.label = label.position;
        }
        smoothed
    }

    /// Mean of the variances that the receiver gave itself, where every fix has one.
    pub(super) fn own_variance_m2(&self) -> Option<f64> {
        let sum = self.rows.iter().try_fold(0.0, |sum, row| Some(sum + row.own_variance_m2?))?;
        Some(sum / self.rows.len() as f64)
    }
}

/// SHA-256 of the samples in their order: time, target, box and fix of each.
pub(super) fn hash_of(samples: &[Sample]) -> String {
    let mut hash = Sha256::new();
    for sample in samples {
        hash.update(sample.time.as_microsecond().to_le_bytes());
        hash.update((sample.target_id.as_str().len() as u64).to_le_bytes());
        hash.update(sample.target_id.as_str());
        for side in sample.bounding_box.sides_px() {
            hash.update(side.to_le_bytes());
        }
        let fix = sample.fix;
        hash.update(fix.position.longitude_deg().to_le_bytes());
        hash.update(fix.position.latitude_deg().to_le_bytes());
        hash.update(fix.sigma_m.map_or(0.0, |sigma| sigma.metres()).to_le_bytes());
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(super) fn unusable(message: String) -> FitError {
    FitError::Unusable(Error::field(ErrorKind::UnusableSamples, "samples", message))
}

/// Standard deviation.
pub(super) fn spread(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Middle value; 0 for none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Smallest share of second differences, by size, that steady motion explains; and what share of
/// the mean of exponential squares the smallest so many hold.
const STEADY: f64 = 0.97;
const STEADY_SHARE: f64 = 0.89;

/// Squared second differences, m2, of positions of rows that follow each other evenly within a pass,
/// with the row in the middle. White noise of a variance per axis makes 12 times that.
pub(super) fn second_differences<'a>(
    rows: &'a [Row],
    points: &'a [EastNorth],
) -> impl Iterator<Item = (usize, f64)> + 'a {
    (1..rows.len().saturating_sub(1)).filter_map(|at| {
        let (first, middle, last) = (&rows[at - 1], &rows[at], &rows[at + 1]);
        let (first_s, second_s) = (middle.time_s - first.time_s, last.time_s - middle.time_s);
        let even = first_s > 0.0 && first_s < 2.5 && (first_s - second_s).abs() < 0.1 * first_s;
        let jump =
            |of: fn(&EastNorth) -> f64| of(&points[at + 1]) - 2.0 * of(&points[at]) + of(&points[at - 1]);
        let square_m2 = jump(|point| point.east_m).powi(2) + jump(|point| point.north_m).powi(2);
        (even && first.pass == last.pass).then_some((at, square_m2))
    })
}

/// Mean of squares without the largest few, which are halts, turns and wild boxes; `None` of none.
pub(super) fn steady_mean(mut squares: Vec<f64>) -> Option<f64> {
    squares.sort_by(f64::total_cmp);
    squares.truncate((squares.len() as f64 * STEADY).ceil() as usize);
    let count = squares.len() as f64;
    (count > 0.0).then(|| squares.iter().sum::<f64>() / (count * STEADY_SHARE))
}

/// The plane about the median fix; medians are taken in a first plane, so that the antimeridian
/// does no harm.
fn central_plane(samples: &[&Sample]) -> LocalPlane {
    let Some(first) = samples.first() else {
        unreachable!("callers have samples");
    };
    let plane = LocalPlane::new(first.fix.position);
    let points: Vec<EastNorth> = samples.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
    let middle = EastNorth {
        east_m: median(points.iter().map(|point| point.east_m).collect()),
        north_m: median(points.iter().map(|point| point.north_m).collect()),
    };
    LocalPlane::new(plane.to_position(middle))
}

/// Numbers the passes of rows sorted by target and time; returns how many there are.
fn number_passes(rows: &mut [Row]) -> u32 {
    let steps = rows
        .windows(2)
        .filter(|pair| pair[0].target == pair[1].target)
        .map(|pair| pair[1].time_s - pair[0].time_s)
        .collect();
    let hole_s = (10.0 * median(steps)).max(PASS_HOLE_S);
    let mut pass = 0;
    for at in 1..rows.len() {
        let same = rows[at].target == rows[at - 1].target && rows[at].time_s - rows[at - 1].time_s <= hole_s;
        pass += u32::from(!same);
        rows[at].pass = pass;
    }
    pass + 1
}
