//! Averages the residuals of one target over a block of time.

use std::collections::BTreeSet;

use jiff::Timestamp;

use super::settings::DriftDetectorSettings;
use crate::domain::TargetId;
use crate::geo::EastNorth;

/// Differences longer than this many standard deviations are shortened to it: a box on the wrong
/// target is one outlier, not a change of pose.
const CLIP_SIGMAS: f64 = 4.0;
/// A block with fewer samples is discarded.
const MIN_SAMPLES: u32 = 3;
/// Cells of ground that one block records.
const MAX_CELLS: usize = 16;

/// A square cell of ground, counted from the plane's origin towards east and north.
pub(super) type GroundCell = (i64, i64);

/// Regressed position and fix of one target at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct ResidualSample {
    /// Time of the fix; not descending per target.
    pub time: Timestamp,
    /// The target.
    pub target_id: TargetId,
    /// Position regressed from the bounding box alone.
    pub regressed: EastNorth,
    /// Position from the receiver.
    pub fix: EastNorth,
    /// Error variance per axis of the regressed position, m2.
    pub e_regression_m2: f64,
    /// Error variance per axis of the fix, m2.
    pub e_gnss_m2: f64,
}

/// A closed block of one target.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub(super) target_id: TargetId,
    pub(super) began_at: Timestamp,
    pub(super) ended_at: Timestamp,
    /// Mean of regressed position less fix (east, north), m.
    pub(super) mean_m: [f64; 2],
    /// Variance per axis of that mean, without the errors that blocks have in common, m2.
    pub(super) independent_variance_m2: f64,
    /// Variance per axis of the receiver's bias, m2: the scale of its slow errors.
    pub(super) bias_m2: f64,
    /// Mean error variance per axis of the regressed positions, m2.
    pub(super) e_regression_m2: f64,
    pub(super) cells: BTreeSet<GroundCell>,
}

/// A block that still accepts samples.
#[derive(Debug, Clone)]
pub(super) struct OpenBlock {
    began_at: Timestamp,
    latest: Timestamp,
    sum_m: [f64; 2],
    samples: u32,
    e_regression_m2: f64,
    e_gnss_m2: f64,
    cells: BTreeSet<GroundCell>,
}

impl OpenBlock {
    pub(super) fn new(time: Timestamp) -> Self {
        Self {
            began_at: time,
            latest: time,
            sum_m: [0.0; 2],
            samples: 0,
            e_regression_m2: 0.0,
            e_gnss_m2: 0.0,
            cells: BTreeSet::new(),
        }
    }

    /// Time of the latest sample.
    pub(super) const fn latest(&self) -> Timestamp {
        self.latest
    }

    /// True if a sample of that time belongs to the next block.
    pub(super) fn is_complete(&self, time: Timestamp, settings: &DriftDetectorSettings) -> bool {
        let elapsed_s = |since: Timestamp| time.duration_since(since).as_secs_f64();
        elapsed_s(self.latest) > settings.gap_s || elapsed_s(self.began_at) >= settings.block_s
    }

    pub(super) fn add(&mut self, sample: &ResidualSample, settings: &DriftDetectorSettings) {
        let east_m = sample.regressed.east_m - sample.fix.east_m;
        let north_m = sample.regressed.north_m - sample.fix.north_m;
        let max_length_m = CLIP_SIGMAS * (sample.e_regression_m2 + sample.e_gnss_m2).sqrt();
        let scale = (max_length_m / east_m.hypot(north_m).max(1e-9)).min(1.0);
        self.sum_m[0] += scale * east_m;
        self.sum_m[1] += scale * north_m;
        self.samples += 1;
        self.latest = self.latest.max(sample.time);
        // Running means.
        let weight = 1.0 / f64::from(self.samples);
        self.e_regression_m2 += weight * (sample.e_regression_m2 - self.e_regression_m2);
        self.e_gnss_m2 += weight * (sample.e_gnss_m2 - self.e_gnss_m2);
        if self.cells.len() < MAX_CELLS {
            let cell = |metres: f64| (metres / settings.cell_m).floor() as i64;
            self.cells.insert((cell(sample.fix.east_m), cell(sample.fix.north_m)));
        }
    }

    /// The closed block; `None` for too few samples.
    ///
    /// The mean of a Gauss-Markov process of variance v and time constant tau over a length T has the
    /// variance `2 v tau / T` for `T >> tau`, bounded here by that of one value, v.
    pub(super) fn close(self, target_id: TargetId, settings: &DriftDetectorSettings) -> Option<Block> {
        if self.samples < MIN_SAMPLES {
            return None;
        }
        let length_s = self.latest.duration_since(self.began_at).as_secs_f64();
        let noise = settings.gnss;
        let bias_share = (2.0 * noise.time_constant_s / length_s.max(1.0)).min(1.0);
        let white_share = noise.white_share / f64::from(self.samples);
        let bias_m2 = (1.0 - noise.white_share) * self.e_gnss_m2;
        Some(Block {
            target_id,
            began_at: self.began_at,
            ended_at: self.latest,
            mean_m: self.sum_m.map(|sum| sum / f64::from(self.samples)),
            independent_variance_m2: bias_m2 * bias_share + self.e_gnss_m2 * white_share,
            bias_m2,
            e_regression_m2: self.e_regression_m2,
            cells: self.cells,
        })
    }
}
