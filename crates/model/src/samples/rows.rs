//! Training samples in the form that every recipe is fitted to: in metres, sorted by target and time,
//! divided into traverses and into blocks of time.
//!
//! A *traverse* is an interval of one target's samples without a gap. The true position that a sample may
//! state is never read here.

use std::collections::HashMap;

use jiff::Timestamp;
use sha2::{Digest, Sha256};

use super::target_groups::groups_of_targets;
use super::unpaired::TargetBox;
use crate::domain::{BoundingBox, Error, ErrorKind, GaussMarkovNoise, KnownPoint, Result, Sample};
use crate::filters::{Traverse, smooth_traverse, tune_acceleration};
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::statistics::{median, std_dev};

/// Fewer samples do not determine a camera's map against the noise of the fixes.
pub const FEWEST_SAMPLES: u64 = 20;
/// Fixes within this distance of each other are all at one position, m.
pub const SMALLEST_SPREAD_M: f64 = 1.0;
/// Half an hour without any row ends a session.
pub(crate) const SESSION_GAP_S: f64 = 1800.0;
/// Neighbouring rows that thinning keeps together.
const NEIGHBOURS: usize = 8;
/// Blocks of time that are held out in turn.
pub(crate) const HELD_OUT_BLOCKS: u32 = 4;
/// A gap in a target's samples ends a traverse if it exceeds both this, s, and [`GAP_INTERVALS`].
const TRAVERSE_GAP_S: f64 = 3.0;
/// The same in median intervals between samples.
const GAP_INTERVALS: f64 = 10.0;

/// One training sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TrainingRow {
    /// Index of the sample that it is made of.
    pub(crate) sample: u32,
    /// Time since the first sample, s.
    pub(crate) time_s: f64,
    /// Index of the target, from 0.
    pub(crate) target: u32,
    /// Index of the traverse, from 0; the rows of one are adjacent and in order of time.
    pub(crate) traverse: u32,
    pub(crate) bounding_box: BoundingBox,
    pub(crate) position: Position,
    /// The regression target: the fix in the plane, or the smoothed position.
    pub(crate) label: EastNorth,
    /// Error variance per axis that the receiver stated, m2.
    pub(crate) stated_variance_m2: Option<f64>,
}

/// All samples of a fit.
#[derive(Debug, Clone)]
pub(crate) struct TrainingRows {
    pub(crate) plane: LocalPlane,
    pub(crate) rows: Vec<TrainingRow>,
    pub(crate) targets: u32,
    pub(crate) traverses: u32,
}

impl TrainingRows {
    /// Sorts the samples by target and time, projects them into a plane and numbers their traverses.
    ///
    /// # Errors
    /// Refuses sets that are empty, smaller than [`FEWEST_SAMPLES`], mostly one repeated row, or all
    /// at one position in the image or on the ground.
    pub(crate) fn new(samples: &[Sample]) -> Result<Self> {
        check_count(samples.len())?;
        let mut sorted: Vec<(u32, &Sample)> = (0..).zip(samples).collect();
        sorted.sort_by(|(_, left), (_, right)| {
            (&left.target_id, left.time).cmp(&(&right.target_id, right.time))
        });
        let plane = central_plane(samples);
        let first = samples.iter().map(|sample| sample.time).min().unwrap_or(Timestamp::UNIX_EPOCH);
        let mut rows = Vec::with_capacity(sorted.len());
        let mut target = 0;
        for (at, (index, sample)) in sorted.iter().enumerate() {
            target += u32::from(at > 0 && sorted[at - 1].1.target_id != sample.target_id);
            rows.push(TrainingRow {
                sample: *index,
                time_s: (sample.time.as_microsecond() - first.as_microsecond()) as f64 * 1e-6,
                target,
                traverse: 0,
                bounding_box: sample.bounding_box,
                position: sample.fix.position,
                label: plane.to_plane(sample.fix.position),
                stated_variance_m2: sample.fix.sigma_m.map(|sigma| sigma.variance_m2()),
            });
        }
        let traverses = number_traverses(&mut rows);
        let all = Self { plane, rows, targets: target + 1, traverses };
        all.check_repetition()?;
        all.check_spread()?;
        Ok(all)
    }

    /// Refuses sets in which more than half of the samples repeat one box and fix, from a detector or receiver that is
    /// stuck: such rows outweigh all others, and a model that reproduces them has the least error.
    fn check_repetition(&self) -> Result<()> {
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

    fn check_spread(&self) -> Result<()> {
        let spread = |value: &dyn Fn(&TrainingRow) -> f64| std_dev(self.rows.iter().map(value));
        let in_image_px = spread(&|row| row.bounding_box.foot_px()[0])
            .max(spread(&|row| row.bounding_box.foot_px()[1]))
            .max(spread(&|row| row.bounding_box.height_px()));
        if in_image_px < 1.0 {
            return Err(unusable(format!(
                "all {} boxes are at one spot of the image (they vary by {in_image_px:.1} px); let the target \
                 walk through the whole picture while samples are taken",
                self.rows.len()
            )));
        }
        let on_ground_m = spread(&|row| row.label.east_m).max(spread(&|row| row.label.north_m));
        if on_ground_m < 0.1 * SMALLEST_SPREAD_M {
            return Err(unusable(format!(
                "all {} fixes are at one spot (they vary by {on_ground_m:.2} m) though the boxes move; check \
                 that boxes and fixes are paired by time",
                self.rows.len()
            )));
        }
        Ok(())
    }

    /// Index of the held-out group of each row, from 0, and the number of groups, at most `most`: whole
    /// targets, because the error of a target's receiver outlasts its rows; blocks of time where one
    /// receiver has nearly all fixes.
    pub(crate) fn held_out_groups(&self, most: u32) -> (Vec<u32>, u32) {
        let mut rows_of_target = vec![0; self.targets as usize];
        self.rows.iter().for_each(|row| rows_of_target[row.target as usize] += 1);
        match groups_of_targets(&rows_of_target, most as usize) {
            Some((groups, count)) => {
                (self.rows.iter().map(|row| groups[row.target as usize] as u32).collect(), count as u32)
            }
            None => (self.blocks(most), most),
        }
    }

    /// Number of sessions: half an hour without any row ends one.
    pub(crate) fn sessions(&self) -> usize {
        let mut times_s: Vec<f64> = self.rows.iter().map(|row| row.time_s).collect();
        times_s.sort_by(f64::total_cmp);
        1 + times_s.windows(2).filter(|pair| pair[1] - pair[0] > SESSION_GAP_S).count()
    }

    /// Index of the block of time of each row, 0 to `count - 1`: blocks of about equal size, cut at the
    /// largest gaps near the equal shares, so that traverses stay whole where possible. Rows of all
    /// targets at one time are in one block.
    pub(crate) fn blocks(&self, count: u32) -> Vec<u32> {
        let mut times: Vec<f64> = self.rows.iter().map(|row| row.time_s).collect();
        times.sort_by(f64::total_cmp);
        let share = times.len() / count as usize;
        let cuts: Vec<f64> =
            (1..count as usize).map(|cut| cut_near(&times, cut * share, share / 3)).collect();
        let blocks: Vec<u32> = self
            .rows
            .iter()
            .map(|row| cuts.iter().filter(|cut| row.time_s >= **cut).count() as u32)
            .collect();
        let least = (0..count).map(|block| blocks.iter().filter(|of| **of == block).count()).min();
        if least.unwrap_or(0) * 4 >= share { blocks } else { self.blocks_by_rank(count) }
    }

    /// Blocks of equal size in the order of time, for rows of which too many have the same time.
    fn blocks_by_rank(&self, count: u32) -> Vec<u32> {
        let mut order: Vec<usize> = (0..self.rows.len()).collect();
        order.sort_by(|one, other| self.rows[*one].time_s.total_cmp(&self.rows[*other].time_s));
        let mut blocks = vec![0; self.rows.len()];
        for (rank, at) in order.into_iter().enumerate() {
            blocks[at] = (rank * count as usize / self.rows.len()) as u32;
        }
        blocks
    }

    /// At most about this number of the rows: runs of neighbours in time, evenly spaced, since the noise of
    /// receivers and detectors shows between neighbours.
    pub(crate) fn thinned(self, most: usize) -> Self {
        let stride = self.rows.len().div_ceil(most).max(1);
        if stride == 1 { self } else { self.filtered(|row| (row / NEIGHBOURS).is_multiple_of(stride)) }
    }

    /// Some of the rows, in the same plane.
    pub(crate) fn filtered(&self, keep: impl Fn(usize) -> bool) -> Self {
        let rows = self.rows.iter().enumerate().filter(|(at, _)| keep(*at)).map(|(_, row)| *row).collect();
        Self { rows, ..*self }
    }

    /// The same rows with the fixes of each traverse smoothed by a kinematic smoother as labels.
    pub(crate) fn smoothed(&self, noise: &GaussMarkovNoise) -> Self {
        let traverses: Vec<Traverse> = traverses(&self.rows)
            .map(|traverse| traverse.iter().map(|row| (row.time_s, row.label)).unzip())
            .collect();
        let acceleration_m_s2 = tune_acceleration(&traverses, noise);
        let labels = traverses
            .iter()
            .flat_map(|(times_s, fixes)| smooth_traverse(times_s, fixes, noise, acceleration_m_s2));
        let mut smoothed = self.clone();
        for (row, label) in smoothed.rows.iter_mut().zip(labels) {
            row.label = label.position;
        }
        smoothed
    }

    /// Mean of the error variances that the receiver stated, m2; `None` unless every fix has one.
    pub(crate) fn stated_variance_m2(&self) -> Option<f64> {
        let sum = self.rows.iter().try_fold(0.0, |sum, row| Some(sum + row.stated_variance_m2?))?;
        Some(sum / self.rows.len() as f64)
    }
}

/// The rows of each traverse.
pub(crate) fn traverses(rows: &[TrainingRow]) -> impl Iterator<Item = &[TrainingRow]> {
    rows.chunk_by(|one, other| one.traverse == other.traverse)
}

/// The time after the largest gap within `reach` ranks of a rank; the nearest of equal gaps.
fn cut_near(times: &[f64], rank: usize, reach: usize) -> f64 {
    let (low, high) = (rank - reach, rank + reach);
    let gap = |at: usize| times[at] - times[at - 1];
    let at = (low.max(1)..=high.min(times.len() - 1))
        .max_by(|left, right| {
            gap(*left).total_cmp(&gap(*right)).then_with(|| right.abs_diff(rank).cmp(&left.abs_diff(rank)))
        })
        .unwrap_or(rank);
    times[at]
}

/// SHA-256 of time, target, box and fix of each sample, then of target and box of each box without a fix, then of the known
/// points, in their order, hexadecimal.
pub(crate) fn sha256_of(samples: &[Sample], unpaired: &[TargetBox], known: &[KnownPoint]) -> String {
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
    for own in unpaired {
        hash.update(own.target.to_le_bytes());
        for side in own.bounding_box.sides_px() {
            hash.update(side.to_le_bytes());
        }
    }
    for point in known {
        let [x_px, y_px] = point.image_px;
        let position = point.position;
        let sigma_m = point.sigma_m.metres();
        for value in [x_px, y_px, position.longitude_deg(), position.latitude_deg(), sigma_m] {
            hash.update(value.to_le_bytes());
        }
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn check_count(count: usize) -> Result<()> {
    if count == 0 {
        return Err(unusable("there are none; import samples that have a box and a fix first".into()));
    }
    if (count as u64) < FEWEST_SAMPLES {
        return Err(unusable(format!(
            "there are {count}, a fit needs at least {FEWEST_SAMPLES}; import more, best of several passes \
             through different parts of the image"
        )));
    }
    Ok(())
}

fn unusable(message: String) -> Error {
    Error::field(ErrorKind::UnusableSamples, "samples", message)
}

/// The plane about the median fix. The medians are taken in a plane about the first fix, so that fixes
/// on both sides of the antimeridian are handled.
fn central_plane(samples: &[Sample]) -> LocalPlane {
    let Some(first) = samples.first() else {
        unreachable!("the samples have been counted");
    };
    let plane = LocalPlane::new(first.fix.position);
    let points: Vec<EastNorth> = samples.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
    let centre = EastNorth {
        east_m: median(points.iter().map(|point| point.east_m).collect()),
        north_m: median(points.iter().map(|point| point.north_m).collect()),
    };
    LocalPlane::new(plane.to_position(centre))
}

/// Numbers the traverses of rows sorted by target and time; returns how many there are.
fn number_traverses(rows: &mut [TrainingRow]) -> u32 {
    let intervals = rows
        .windows(2)
        .filter(|pair| pair[0].target == pair[1].target)
        .map(|pair| pair[1].time_s - pair[0].time_s)
        .collect();
    let gap_s = (GAP_INTERVALS * median(intervals)).max(TRAVERSE_GAP_S);
    let mut traverse = 0;
    for at in 1..rows.len() {
        let same = rows[at].target == rows[at - 1].target && rows[at].time_s - rows[at - 1].time_s <= gap_s;
        traverse += u32::from(!same);
        rows[at].traverse = traverse;
    }
    traverse + 1
}
