//! What several blocks say together: means over targets whose shared errors are counted once.
//!
//! What never happens here: onsets, alarms.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use super::WatchSettings;
use crate::domain::TargetId;

/// A square of ground, counted from the origin east and north.
pub(super) type Cell = (i64, i64);

/// Two minutes of one target.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub(super) target_id: TargetId,
    pub(super) began_at: Timestamp,
    pub(super) ended_at: Timestamp,
    pub(super) mean: [f64; 2],
    /// Variance per axis that other blocks do not share, m2.
    pub(super) own_m2: f64,
    /// Variance of the receiver's bias, m2: the scale of its slow errors.
    pub(super) bias_m2: f64,
    pub(super) e_regression_m2: f64,
    pub(super) cells: BTreeSet<Cell>,
}

/// Ground covered since an onset, in cells.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Ground {
    pub(super) cells: u32,
    /// Not covered before.
    pub(super) new: u32,
}

/// A mean with its variance per axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    pub(super) mean: [f64; 2],
    pub(super) variance_m2: f64,
}

/// Blocks put together, their shared errors counted once.
pub(super) struct Pool<'a> {
    pub(super) settings: &'a WatchSettings,
    pub(super) targets: BTreeMap<&'a TargetId, Share>,
    pub(super) slow: SlowUnits,
    pub(super) bias_m2: f64,
    pub(super) e_regression_m2: f64,
    pub(super) blocks: f64,
    /// Over all targets, kept up with every block: a pool is asked after each of them.
    total: Part,
}

/// One target's part of a pool.
#[derive(Default)]
pub(super) struct Share {
    weight: f64,
    sum: [f64; 2],
    bias_m2: f64,
    slow: SlowUnits,
    part: Part,
}

/// A weight, and weighted means.
#[derive(Debug, Clone, Copy, Default)]
struct Part {
    weight: f64,
    sum: [f64; 2],
}

impl Part {
    fn plus(self, other: Self) -> Self {
        Self { weight: self.weight + other.weight, sum: [0, 1].map(|axis| self.sum[axis] + other.sum[axis]) }
    }

    fn less(self, other: Self) -> Self {
        Self { weight: self.weight - other.weight, sum: [0, 1].map(|axis| self.sum[axis] - other.sum[axis]) }
    }
}

impl Share {
    /// What the target adds to a mean, its slow error counted once for each stretch.
    fn part(&self, settings: &WatchSettings) -> Part {
        let slow_m2 = settings.receiver_share.powi(2) * self.bias_m2 / f64::from(self.slow.count);
        let weight = 1.0 / (1.0 / self.weight + slow_m2);
        Part { weight, sum: self.sum.map(|sum| weight * sum / self.weight) }
    }
}

/// Counts stretches of time whose slow errors are independent.
#[derive(Default)]
pub(super) struct SlowUnits {
    pub(super) latest: Option<Timestamp>,
    pub(super) count: u32,
}

impl SlowUnits {
    fn add(&mut self, time: Timestamp, slow_s: f64) {
        let apart = |other: Timestamp| time.duration_since(other).as_secs_f64().abs() >= slow_s;
        if self.latest.is_none_or(apart) {
            self.latest = Some(time);
            self.count += 1;
        }
    }
}

impl<'a> Pool<'a> {
    pub(super) fn new(settings: &'a WatchSettings) -> Self {
        Self {
            settings,
            targets: BTreeMap::new(),
            slow: SlowUnits::default(),
            bias_m2: 0.0,
            e_regression_m2: 0.0,
            blocks: 0.0,
            total: Part::default(),
        }
    }

    pub(super) fn add(&mut self, block: &'a Block) {
        let share = self.targets.entry(&block.target_id).or_default();
        let weight = 1.0 / block.own_m2;
        share.weight += weight;
        for (sum, mean) in share.sum.iter_mut().zip(block.mean) {
            *sum += weight * mean;
        }
        share.bias_m2 = share.bias_m2.max(block.bias_m2);
        share.slow.add(block.began_at, self.settings.slow_s);
        let part = share.part(self.settings);
        self.total = self.total.less(share.part).plus(part);
        share.part = part;
        self.slow.add(block.began_at, self.settings.slow_s);
        self.blocks += 1.0;
        self.bias_m2 += (block.bias_m2 - self.bias_m2) / self.blocks;
        self.e_regression_m2 += (block.e_regression_m2 - self.e_regression_m2) / self.blocks;
    }

    /// Mean over the targets (all but one, if named), and its variance; new ground
    /// brings an error of the model that was not there before.
    pub(super) fn estimate(&self, without: Option<&TargetId>, ground: Ground) -> Option<Estimate> {
        let settings = self.settings;
        let left_out = without.and_then(|target_id| self.targets.get(target_id));
        let others = self.targets.len() > usize::from(left_out.is_some());
        let Part { weight, sum } = self.total.less(left_out.map_or_else(Part::default, |share| share.part));
        let common_m2 = settings.common_share.powi(2) * self.bias_m2 / f64::from(self.slow.count.max(1));
        let cells = f64::from(ground.cells.max(1));
        let model_m2 = self.e_regression_m2 * f64::from(ground.new) / (cells * cells);
        // What is left of a weight that was taken away again is rounding, not evidence.
        (others && weight > 0.0).then(|| Estimate {
            mean: sum.map(|total| total / weight),
            variance_m2: 1.0 / weight + common_m2 + model_m2,
        })
    }
}

/// What is known of the constant offset when nothing was compared.
pub(super) fn reference(settings: &WatchSettings, bias_m2: f64) -> Estimate {
    Estimate { mean: [0.0; 2], variance_m2: settings.reference_share.powi(2) * bias_m2 }
}

pub(super) fn combined(one: Estimate, other: Estimate) -> Estimate {
    let gain = one.variance_m2 / (one.variance_m2 + other.variance_m2);
    Estimate {
        mean: [0, 1].map(|axis| one.mean[axis] + gain * (other.mean[axis] - one.mean[axis])),
        variance_m2: (1.0 - gain) * one.variance_m2,
    }
}

/// Squared distance of two means over its variance.
pub(super) fn statistic(since: Option<Estimate>, before: Estimate) -> f64 {
    since.map_or(0.0, |since| {
        let (east, north) = (since.mean[0] - before.mean[0], since.mean[1] - before.mean[1]);
        (east * east + north * north) / (since.variance_m2 + before.variance_m2)
    })
}
