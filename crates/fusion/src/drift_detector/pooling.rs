//! Pools blocks into one mean difference, with the errors that blocks have in common counted once.
//!
//! Variance of the pooled mean per axis:
//! `v = 1 / sum_t w_t + s_common^2 b / n + e_regression * new_cells / cells^2`, where target t has the
//! weight `w_t = 1 / (1 / sum_blocks(1 / independent_variance) + s_receiver^2 b_t / n_t)`; b is the
//! variance of the receivers' bias and n the number of independent epochs.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::block::Block;
use super::settings::DriftDetectorSettings;
use crate::domain::TargetId;

/// Ground covered since an onset, in cells.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SpatialCoverage {
    pub(super) cells: u32,
    /// Number of those that were not covered before the onset.
    pub(super) new_cells: u32,
}

/// A mean of regressed position less fix (east, north) in m, with its variance per axis in m2.
#[derive(Debug, Clone, Copy)]
pub(super) struct MeanDifference {
    pub(super) mean_m: [f64; 2],
    pub(super) variance_m2: f64,
}

/// A set of blocks and their pooled mean, updated with every block.
pub(super) struct PooledBlocks<'a> {
    settings: &'a DriftDetectorSettings,
    by_target: BTreeMap<&'a TargetId, TargetAccumulator>,
    epochs: IndependentEpochs,
    /// Running means over the blocks, m2.
    bias_m2: f64,
    e_regression_m2: f64,
    blocks: f64,
    /// Sum of the contributions of all targets.
    total: WeightedSum,
}

/// The blocks of one target.
#[derive(Default)]
struct TargetAccumulator {
    /// Inverse-variance sums over the blocks.
    blocks: WeightedSum,
    bias_m2: f64,
    epochs: IndependentEpochs,
    /// The contribution to [`PooledBlocks::total`].
    contribution: WeightedSum,
}

/// A sum of weights (1/m2) and of weighted means (east, north).
#[derive(Debug, Clone, Copy, Default)]
struct WeightedSum {
    weight: f64,
    sum: [f64; 2],
}

impl WeightedSum {
    fn plus(self, other: Self) -> Self {
        Self { weight: self.weight + other.weight, sum: [0, 1].map(|axis| self.sum[axis] + other.sum[axis]) }
    }

    fn minus(self, other: Self) -> Self {
        Self { weight: self.weight - other.weight, sum: [0, 1].map(|axis| self.sum[axis] - other.sum[axis]) }
    }
}

impl TargetAccumulator {
    /// The target's contribution to a mean over targets: its slow error is drawn once per epoch.
    fn contribution(&self, settings: &DriftDetectorSettings) -> WeightedSum {
        let slow_m2 = settings.receiver_share.powi(2) * self.bias_m2 / f64::from(self.epochs.count);
        let weight = 1.0 / (1.0 / self.blocks.weight + slow_m2);
        WeightedSum { weight, sum: self.blocks.sum.map(|sum| weight * sum / self.blocks.weight) }
    }
}

/// Counts epochs whose slow errors are independent of each other.
#[derive(Default)]
struct IndependentEpochs {
    latest: Option<Timestamp>,
    count: u32,
}

impl IndependentEpochs {
    fn add(&mut self, time: Timestamp, correlation_s: f64) {
        let is_new = |latest: Timestamp| time.duration_since(latest).as_secs_f64().abs() >= correlation_s;
        if self.latest.is_none_or(is_new) {
            self.latest = Some(time);
            self.count += 1;
        }
    }
}

impl<'a> PooledBlocks<'a> {
    pub(super) fn new(settings: &'a DriftDetectorSettings) -> Self {
        Self {
            settings,
            by_target: BTreeMap::new(),
            epochs: IndependentEpochs::default(),
            bias_m2: 0.0,
            e_regression_m2: 0.0,
            blocks: 0.0,
            total: WeightedSum::default(),
        }
    }

    pub(super) fn add(&mut self, block: &'a Block) {
        let target = self.by_target.entry(&block.target_id).or_default();
        let weight = 1.0 / block.independent_variance_m2;
        target.blocks =
            target.blocks.plus(WeightedSum { weight, sum: block.mean_m.map(|mean_m| weight * mean_m) });
        target.bias_m2 = target.bias_m2.max(block.bias_m2);
        target.epochs.add(block.began_at, self.settings.slow_correlation_s);
        let contribution = target.contribution(self.settings);
        self.total = self.total.minus(target.contribution).plus(contribution);
        target.contribution = contribution;
        self.epochs.add(block.began_at, self.settings.slow_correlation_s);
        self.blocks += 1.0;
        self.bias_m2 += (block.bias_m2 - self.bias_m2) / self.blocks;
        self.e_regression_m2 += (block.e_regression_m2 - self.e_regression_m2) / self.blocks;
    }

    /// Number of targets.
    pub(super) fn targets(&self) -> usize {
        self.by_target.len()
    }

    pub(super) fn target_ids(&self) -> impl Iterator<Item = &'a TargetId> {
        self.by_target.keys().copied()
    }

    /// The target, if there is exactly one.
    pub(super) fn only_target(&self) -> Option<&'a TargetId> {
        self.target_ids().next().filter(|_| self.by_target.len() == 1)
    }

    /// Independent epochs over all targets.
    pub(super) const fn epochs(&self) -> u32 {
        self.epochs.count
    }

    /// The mean over all targets, or all but one. `None` without a target.
    pub(super) fn estimate(
        &self,
        without: Option<&TargetId>,
        coverage: SpatialCoverage,
    ) -> Option<MeanDifference> {
        let left_out = without.and_then(|target_id| self.by_target.get(target_id));
        let has_targets = self.by_target.len() > usize::from(left_out.is_some());
        let WeightedSum { weight, sum } = match left_out {
            Some(target) => self.total.minus(target.contribution),
            None => self.total,
        };
        let common_m2 =
            self.settings.common_share.powi(2) * self.bias_m2 / f64::from(self.epochs.count.max(1));
        let cells = f64::from(coverage.cells.max(1));
        let model_m2 = self.e_regression_m2 * f64::from(coverage.new_cells) / (cells * cells);
        // Subtracting the only contribution leaves rounding errors, hence `has_targets`.
        (has_targets && weight > 0.0).then(|| MeanDifference {
            mean_m: sum.map(|total| total / weight),
            variance_m2: 1.0 / weight + common_m2 + model_m2,
        })
    }
}

/// The constant offset before any sample: mean 0.
pub(super) fn offset_prior(settings: &DriftDetectorSettings, bias_m2: f64) -> MeanDifference {
    MeanDifference { mean_m: [0.0; 2], variance_m2: settings.offset_prior_share.powi(2) * bias_m2 }
}

/// The inverse-variance weighted mean of two independent estimates.
pub(super) fn combine(one: MeanDifference, other: MeanDifference) -> MeanDifference {
    let gain = one.variance_m2 / (one.variance_m2 + other.variance_m2);
    MeanDifference {
        mean_m: [0, 1].map(|axis| one.mean_m[axis] + gain * (other.mean_m[axis] - one.mean_m[axis])),
        variance_m2: (1.0 - gain) * one.variance_m2,
    }
}

/// `|m_post - m_pre|^2 / (v_post + v_pre)`; 0 without samples after the change.
pub(super) fn glr_statistic(post_change: Option<MeanDifference>, pre_change: MeanDifference) -> f64 {
    post_change.map_or(0.0, |post_change| {
        let [east_m, north_m] = [0, 1].map(|axis| post_change.mean_m[axis] - pre_change.mean_m[axis]);
        (east_m * east_m + north_m * north_m) / (post_change.variance_m2 + pre_change.variance_m2)
    })
}
