//! Detects that a camera's pose has changed since its model was trained: a camera that was
//! bumped or re-aimed otherwise continues to give confident wrong positions.
//!
//! The difference d between regressed position and fix is averaged over blocks of two minutes per
//! target. A generalised likelihood ratio test over all onsets k (Basseville and Nikiforov 1993, 2.4)
//! compares the mean difference since the onset with the mean before:
//! `T = max_k |m_post - m_pre|^2 / (v_post + v_pre)`, with variances v per axis that account for
//! correlated errors: the receiver's bias of tens of seconds, its slower error of about an hour, the
//! part of it common to all receivers, and the model's own error, which depends on the place.
//! Does not raise an alarm for one receiver among several, for one stop, or for a constant offset that was there from
//! the start.

mod block;
mod pooling;
mod settings;
#[cfg(test)]
mod tests;
mod time_aligner;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use jiff::Timestamp;

pub use self::block::ResidualSample;
pub use self::settings::DriftDetectorSettings;
pub use self::time_aligner::{TimeAligner, TimedEstimate};

use self::block::{Block, GroundCell, OpenBlock};
use self::pooling::{MeanDifference, PooledBlocks, SpatialCoverage, combine, glr_statistic, offset_prior};
use crate::domain::TargetId;
use crate::geo::EastNorth;

/// Cells of ground that are remembered beyond the retained blocks.
const MAX_ARCHIVED_CELLS: usize = 1_024;
/// Independent epochs, and cells of ground, that the only target of a camera must cover.
const MIN_SINGLE_TARGET_EPOCHS: u32 = 3;
/// The variance of the archived offset is at least that of the slow errors of this number of epochs: a day.
const MAX_ARCHIVED_EPOCHS: f64 = 24.0;

/// The camera's pose has changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriftAlarm {
    /// The onset that maximises the likelihood ratio.
    pub onset_at: Timestamp,
    /// When the statistic crossed the threshold.
    pub detected_at: Timestamp,
    /// The statistic T of the likelihood ratio.
    pub glr_statistic: f64,
    /// Mean change of regressed position less fix at the onset.
    pub shift: EastNorth,
    /// Targets compared since the onset.
    pub supporting_targets: usize,
}

/// The change detector of one camera and one model version.
#[derive(Debug, Clone)]
pub struct DriftDetector {
    settings: DriftDetectorSettings,
    open: BTreeMap<TargetId, OpenBlock>,
    /// In order of closing.
    blocks: VecDeque<Block>,
    /// The constant offset as estimated from the blocks that are no longer retained.
    archived_prior: Option<MeanDifference>,
    /// Ground covered by those blocks.
    archived_cells: BTreeSet<GroundCell>,
    alarm: Option<DriftAlarm>,
}

impl DriftDetector {
    /// A detector without samples.
    #[must_use]
    pub const fn new(settings: DriftDetectorSettings) -> Self {
        Self {
            settings,
            open: BTreeMap::new(),
            blocks: VecDeque::new(),
            archived_prior: None,
            archived_cells: BTreeSet::new(),
            alarm: None,
        }
    }

    /// The alarm, once raised; it is never cleared.
    #[must_use]
    pub const fn alarm(&self) -> Option<DriftAlarm> {
        self.alarm
    }

    /// Processes one sample. Returns the alarm when it is raised, and only then.
    pub fn observe(&mut self, sample: &ResidualSample) -> Option<DriftAlarm> {
        let is_usable = sample.e_regression_m2 > 0.0 && sample.e_gnss_m2 > 0.0;
        if self.alarm.is_some() || !is_usable {
            return None;
        }
        let is_complete = self
            .open
            .get(&sample.target_id)
            .is_some_and(|block| block.is_complete(sample.time, &self.settings));
        if is_complete && let Some(block) = self.open.remove(&sample.target_id) {
            self.close(sample.target_id.clone(), block);
        }
        self.evict_for(&sample.target_id);
        self.open
            .entry(sample.target_id.clone())
            .or_insert_with(|| OpenBlock::new(sample.time))
            .add(sample, &self.settings);
        if is_complete { self.detect(sample.time) } else { None }
    }

    /// Closes the block of the target that was not seen for longest, if a new target needs its place.
    fn evict_for(&mut self, target_id: &TargetId) {
        if self.open.len() < self.settings.max_targets || self.open.contains_key(target_id) {
            return;
        }
        let stalest = self.open.iter().min_by_key(|(_, block)| block.latest()).map(|(id, _)| id.clone());
        if let Some(id) = stalest
            && let Some(block) = self.open.remove(&id)
        {
            self.close(id, block);
        }
    }

    fn close(&mut self, target_id: TargetId, open: OpenBlock) {
        self.blocks.extend(open.close(target_id, &self.settings));
        if self.blocks.len() > self.settings.max_blocks
            && let Some(oldest) = self.blocks.pop_front()
        {
            self.archived_prior = Some(self.archive(&oldest));
            if self.archived_cells.len() < MAX_ARCHIVED_CELLS {
                self.archived_cells.extend(&oldest.cells);
            }
        }
    }

    /// The archived offset with one more block, by a scalar Kalman update per axis. The slow errors of
    /// a block are those of its whole epoch, so a block counts for its share of an epoch only.
    fn archive(&self, block: &Block) -> MeanDifference {
        let settings = &self.settings;
        let prior = self.archived_prior.unwrap_or_else(|| offset_prior(settings, block.bias_m2));
        let slow_share = settings.receiver_share.powi(2) + settings.common_share.powi(2);
        let length_s = block.ended_at.duration_since(block.began_at).as_secs_f64();
        let epoch_share = (length_s / settings.slow_correlation_s).clamp(1e-3, 1.0);
        let variance_m2 = (slow_share * block.bias_m2 + block.e_regression_m2) / epoch_share
            + block.independent_variance_m2;
        let gain = prior.variance_m2 / (prior.variance_m2 + variance_m2);
        let mean_m = [0, 1].map(|axis| prior.mean_m[axis] + gain * (block.mean_m[axis] - prior.mean_m[axis]));
        let min_variance_m2 = slow_share * block.bias_m2 / MAX_ARCHIVED_EPOCHS;
        MeanDifference { mean_m, variance_m2: ((1.0 - gain) * prior.variance_m2).max(min_variance_m2) }
    }

    /// The likelihood ratio test over all retained onsets.
    fn detect(&mut self, now: Timestamp) -> Option<DriftAlarm> {
        let pre_change = self.pre_change_estimates();
        // Without the model's error on new ground the statistic is an upper bound; as long as that is
        // below the threshold the coverage need not be computed.
        let (upper_bound, _) = self.best_onset(&pre_change, &[])?;
        if upper_bound < self.settings.threshold {
            return None;
        }
        let coverage = self.spatial_coverage();
        let (statistic, onset) = self.best_onset(&pre_change, &coverage)?;
        if statistic < self.settings.threshold {
            return None;
        }
        let shift = self.confirmed_shift(onset, coverage[onset], pre_change[onset])?;
        self.alarm = Some(DriftAlarm {
            onset_at: self.blocks[onset].began_at,
            detected_at: now,
            glr_statistic: statistic,
            shift: EastNorth { east_m: shift[0], north_m: shift[1] },
            supporting_targets: self.since(onset).targets(),
        });
        self.alarm
    }

    /// The largest statistic over the onsets, and the index of that onset.
    fn best_onset(
        &self,
        pre_change: &[MeanDifference],
        coverage: &[SpatialCoverage],
    ) -> Option<(f64, usize)> {
        let mut post_change = PooledBlocks::new(&self.settings);
        let mut best: Option<(f64, usize)> = None;
        for index in (0..self.blocks.len()).rev() {
            post_change.add(&self.blocks[index]);
            let coverage = coverage.get(index).copied().unwrap_or_default();
            let statistic = glr_statistic(post_change.estimate(None, coverage), pre_change[index]);
            if best.is_none_or(|(highest, _)| statistic > highest) {
                best = Some((statistic, index));
            }
        }
        best
    }

    /// The ground covered from each retained block on. On ground covered before an onset the model's
    /// error is the same after it, and cancels in the comparison.
    fn spatial_coverage(&self) -> Vec<SpatialCoverage> {
        let mut first_block = BTreeMap::new();
        for (index, block) in self.blocks.iter().enumerate() {
            for cell in &block.cells {
                first_block.entry(*cell).or_insert(index);
            }
        }
        let mut covered = BTreeSet::new();
        let mut coverage = SpatialCoverage::default();
        let mut by_onset = vec![coverage; self.blocks.len()];
        for (index, block) in self.blocks.iter().enumerate().rev() {
            for cell in &block.cells {
                coverage.cells += u32::from(covered.insert(*cell));
                let is_new = first_block.get(cell) == Some(&index) && !self.archived_cells.contains(cell);
                coverage.new_cells += u32::from(is_new);
            }
            by_onset[index] = coverage;
        }
        by_onset
    }

    /// The constant offset as estimated from all that precedes each retained block.
    fn pre_change_estimates(&self) -> Vec<MeanDifference> {
        let mut pooled = PooledBlocks::new(&self.settings);
        let mut estimates = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let prior = self.archived_prior.unwrap_or_else(|| offset_prior(&self.settings, block.bias_m2));
            let pre_change = pooled.estimate(None, SpatialCoverage::default());
            estimates.push(pre_change.map_or(prior, |estimate| combine(prior, estimate)));
            pooled.add(block);
        }
        estimates
    }

    fn since(&self, onset: usize) -> PooledBlocks<'_> {
        let mut pooled = PooledBlocks::new(&self.settings);
        for block in self.blocks.range(onset..) {
            pooled.add(block);
        }
        pooled
    }

    /// The shift per axis in m, if it does not depend on one target: the statistic without any one
    /// target must reach `leave_one_out_threshold`; the only target of a camera must cover several
    /// independent epochs and cells of ground.
    fn confirmed_shift(
        &self,
        onset: usize,
        coverage: SpatialCoverage,
        pre_change: MeanDifference,
    ) -> Option<[f64; 2]> {
        let post_change = self.since(onset);
        let is_confirmed = match post_change.only_target() {
            Some(only) => {
                self.blocks.iter().all(|block| &block.target_id == only)
                    && post_change.epochs() >= MIN_SINGLE_TARGET_EPOCHS
                    && coverage.cells >= MIN_SINGLE_TARGET_EPOCHS
            }
            None => post_change.target_ids().all(|target_id| {
                let statistic = glr_statistic(post_change.estimate(Some(target_id), coverage), pre_change);
                statistic >= self.settings.leave_one_out_threshold
            }),
        };
        let mean_m = post_change.estimate(None, coverage)?.mean_m;
        is_confirmed.then(|| [0, 1].map(|axis| mean_m[axis] - pre_change.mean_m[axis]))
    }
}
