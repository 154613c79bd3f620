//! A watch on the camera: a knocked or re-aimed camera goes on giving confident wrong positions.
//!
//! Per camera, regressed positions are compared with fixes. The difference is averaged over blocks
//! of two minutes, and each block is worth what coloured errors leave of it: the receiver's bias of tens
//! of seconds, its slower error of an hour, what all receivers of an hour share, and the model's own
//! error by place. A generalised likelihood ratio over all possible onsets compares the mean since
//! then with the mean before. What never happens here: one receiver alone among several, or one
//! stop, raising the alarm; a model being blamed for a constant offset that was there from the start.

mod meeting;
mod pool;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use jiff::Timestamp;

pub use self::meeting::{Meeting, Spot};
use self::pool::{Block, Cell, Estimate, Ground, Pool, combined, reference, statistic};
use super::track::GnssNoise;
use crate::domain::TargetId;
use crate::geo::EastNorth;

/// Differences beyond so many standard deviations are cut to that.
const CLIP_SIGMAS: f64 = 4.0;
/// Compared instants a block needs.
const FEWEST_COMPARED: u32 = 3;
/// Cells of ground that one block remembers, and that are remembered beyond the kept blocks.
const CELLS_PER_BLOCK: usize = 16;
const CELLS_REMEMBERED: usize = 1_024;
/// Independent slow units and cells of ground that a camera's only target must bear witness in.
const LONE_UNITS: u32 = 3;

/// What the watch believes and when it speaks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WatchSettings {
    /// How the receivers' error is spread over seconds.
    pub gnss: GnssNoise,
    /// Length of a block, s.
    pub block_s: f64,
    /// A block ends when its target was not compared for this long, s.
    pub gap_s: f64,
    /// Slow error of one receiver (site, satellites), as a share of the sigma of its bias.
    pub receiver_share: f64,
    /// Slow error that all receivers have in common, as such a share.
    pub common_share: f64,
    /// Slow errors of instants further apart than this are independent, s.
    pub slow_s: f64,
    /// Ground over which the model's error is one and the same, m.
    pub length_m: f64,
    /// Constant offset that the training may have left, as a share of the sigma of the bias.
    pub reference_share: f64,
    /// The statistic that raises the alarm; chi-square of 2 degrees at one onset without a change.
    pub threshold: f64,
    /// What must be left of the statistic without any one target.
    pub threshold_without_any: f64,
    /// Blocks kept; onsets before them cannot be told apart.
    pub blocks: usize,
    /// Targets followed at once; the one heard of longest ago gives way.
    pub targets: usize,
}

impl Default for WatchSettings {
    fn default() -> Self {
        Self {
            gnss: GnssNoise::default(),
            block_s: 120.0,
            gap_s: 30.0,
            receiver_share: 0.4,
            common_share: 0.25,
            slow_s: 3_600.0,
            length_m: 10.0,
            reference_share: 0.5,
            // One false alarm in 48 simulated months, 24 of one receiver and 24 of four.
            threshold: 25.0,
            threshold_without_any: 8.0,
            blocks: 512,
            targets: 64,
        }
    }
}

/// One target's regressed position beside its fix.
#[derive(Debug, Clone, PartialEq)]
pub struct Compared {
    /// When; in order of time per target.
    pub time: Timestamp,
    /// Whose.
    pub target_id: TargetId,
    /// From the box alone; it must not have seen the fix.
    pub regressed: EastNorth,
    /// From the receiver.
    pub fix: EastNorth,
    /// Error variance per axis of the regressed position, m2.
    pub e_regression_m2: f64,
    /// Error variance per axis of the fix, m2.
    pub e_gnss_m2: f64,
}

/// The camera no longer looks where it looked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alarm {
    /// The onset that explains the differences best.
    pub began_at: Timestamp,
    /// When the evidence was enough.
    pub raised_at: Timestamp,
    /// The likelihood ratio's statistic.
    pub statistic: f64,
    /// Mean shift of the regressed positions against the fixes since then.
    pub shift: EastNorth,
    /// Targets that bear witness.
    pub targets: usize,
}

/// The watch on one camera. Start a new one with every model.
#[derive(Debug, Clone)]
pub struct CameraWatch {
    settings: WatchSettings,
    open: BTreeMap<TargetId, OpenBlock>,
    blocks: VecDeque<Block>,
    /// What the blocks no longer kept said of the constant offset.
    anchor: Option<Estimate>,
    /// Ground they covered.
    known_cells: BTreeSet<Cell>,
    alarm: Option<Alarm>,
}

#[derive(Debug, Clone)]
struct OpenBlock {
    began_at: Timestamp,
    latest: Timestamp,
    sum: [f64; 2],
    compared: u32,
    e_regression_m2: f64,
    e_gnss_m2: f64,
    cells: BTreeSet<Cell>,
}

impl CameraWatch {
    /// Nothing compared yet.
    #[must_use]
    pub const fn new(settings: WatchSettings) -> Self {
        Self {
            settings,
            open: BTreeMap::new(),
            blocks: VecDeque::new(),
            anchor: None,
            known_cells: BTreeSet::new(),
            alarm: None,
        }
    }

    /// The alarm, once raised; it stays until a new watch is begun.
    #[must_use]
    pub const fn alarm(&self) -> Option<Alarm> {
        self.alarm
    }

    /// Takes up one comparison. `Some` at the moment the alarm is raised, and never again.
    pub fn observe(&mut self, compared: &Compared) -> Option<Alarm> {
        let usable = compared.e_regression_m2 > 0.0 && compared.e_gnss_m2 > 0.0;
        if self.alarm.is_some() || !usable {
            return None;
        }
        let settings = self.settings;
        let ended = self.open.get(&compared.target_id).is_some_and(|block| {
            let since_s = |time: Timestamp| compared.time.duration_since(time).as_secs_f64();
            since_s(block.latest) > settings.gap_s || since_s(block.began_at) >= settings.block_s
        });
        if ended && let Some(block) = self.open.remove(&compared.target_id) {
            self.close(compared.target_id.clone(), block);
        }
        self.make_room(&compared.target_id);
        self.open
            .entry(compared.target_id.clone())
            .or_insert_with(|| OpenBlock::new(compared.time))
            .add(compared, &settings);
        if ended { self.judge(compared.time) } else { None }
    }

    fn make_room(&mut self, target_id: &TargetId) {
        if self.open.len() < self.settings.targets || self.open.contains_key(target_id) {
            return;
        }
        let stalest = self.open.iter().min_by_key(|(_, block)| block.latest).map(|(id, _)| id.clone());
        if let Some(id) = stalest
            && let Some(block) = self.open.remove(&id)
        {
            self.close(id, block);
        }
    }

    fn close(&mut self, target_id: TargetId, open: OpenBlock) {
        if open.compared < FEWEST_COMPARED {
            return;
        }
        self.blocks.push_back(open.finish(target_id, &self.settings));
        if self.blocks.len() > self.settings.blocks
            && let Some(oldest) = self.blocks.pop_front()
        {
            self.anchor = Some(self.folded(&oldest));
            if self.known_cells.len() < CELLS_REMEMBERED {
                self.known_cells.extend(&oldest.cells);
            }
        }
    }

    /// The constant offset as known before the kept blocks, with one more block in it. A block
    /// counts for its share of an hour only, for its slow errors are the hour's.
    fn folded(&self, block: &Block) -> Estimate {
        let settings = &self.settings;
        let prior = self.anchor.unwrap_or_else(|| reference(settings, block.bias_m2));
        let slow = settings.receiver_share.powi(2) + settings.common_share.powi(2);
        let length_s = block.ended_at.duration_since(block.began_at).as_secs_f64();
        let share = (length_s / settings.slow_s).clamp(1e-3, 1.0);
        let variance_m2 = (slow * block.bias_m2 + block.e_regression_m2) / share + block.own_m2;
        let gain = prior.variance_m2 / (prior.variance_m2 + variance_m2);
        let mean = [0, 1].map(|axis| prior.mean[axis] + gain * (block.mean[axis] - prior.mean[axis]));
        // Never surer than the slow errors of a day allow.
        let least_m2 = slow * block.bias_m2 / 24.0;
        Estimate { mean, variance_m2: ((1.0 - gain) * prior.variance_m2).max(least_m2) }
    }

    /// The best onset among the kept blocks, and whether it is beyond doubt.
    fn judge(&mut self, now: Timestamp) -> Option<Alarm> {
        let befores = self.befores();
        // Without the model's error on new ground the statistic is never lower, and the ground need
        // not be gone through as long as even that is not enough.
        let (bound, _) = self.best_onset(&befores, &[])?;
        if bound < self.settings.threshold {
            return None;
        }
        let grounds = self.grounds();
        let (statistic, onset) = self.best_onset(&befores, &grounds)?;
        if statistic < self.settings.threshold {
            return None;
        }
        let alarm = self.beyond_doubt(onset, grounds[onset], statistic, befores[onset], now)?;
        self.alarm = Some(alarm);
        Some(alarm)
    }

    /// The highest statistic over the onsets, and its onset.
    fn best_onset(&self, befores: &[Estimate], grounds: &[Ground]) -> Option<(f64, usize)> {
        let mut since = Pool::new(&self.settings);
        let mut best: Option<(f64, usize)> = None;
        for index in (0..self.blocks.len()).rev() {
            since.add(&self.blocks[index]);
            let ground = grounds.get(index).copied().unwrap_or_default();
            let statistic = statistic(since.estimate(None, ground), befores[index]);
            if best.is_none_or(|(highest, _)| statistic > highest) {
                best = Some((statistic, index));
            }
        }
        best
    }

    /// The ground covered from each kept block on. The model's error on ground known before an onset
    /// is the same after it, and drops out of the comparison.
    fn grounds(&self) -> Vec<Ground> {
        let mut first = BTreeMap::new();
        for (index, block) in self.blocks.iter().enumerate() {
            for cell in &block.cells {
                first.entry(*cell).or_insert(index);
            }
        }
        let mut covered = BTreeSet::new();
        let mut ground = Ground::default();
        let mut grounds = vec![ground; self.blocks.len()];
        for (index, block) in self.blocks.iter().enumerate().rev() {
            for cell in &block.cells {
                ground.cells += u32::from(covered.insert(*cell));
                let new = first.get(cell) == Some(&index) && !self.known_cells.contains(cell);
                ground.new += u32::from(new);
            }
            grounds[index] = ground;
        }
        grounds
    }

    /// What is known of the constant offset before each kept block.
    fn befores(&self) -> Vec<Estimate> {
        let mut pool = Pool::new(&self.settings);
        let mut befores = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let prior = self.anchor.unwrap_or_else(|| reference(&self.settings, block.bias_m2));
            befores.push(
                pool.estimate(None, Ground::default()).map_or(prior, |estimate| combined(prior, estimate)),
            );
            pool.add(block);
        }
        befores
    }

    /// One receiver, or one stop, must not raise the alarm: without any one target enough must be
    /// left; the only target a camera has must bear witness for hours and in several places.
    fn beyond_doubt(
        &self,
        onset: usize,
        ground: Ground,
        statistic: f64,
        before: Estimate,
        now: Timestamp,
    ) -> Option<Alarm> {
        let mut since = Pool::new(&self.settings);
        for block in self.blocks.range(onset..) {
            since.add(block);
        }
        let trusted = if since.targets.len() == 1 {
            let only = self.blocks.iter().all(|block| since.targets.contains_key(&block.target_id));
            only && since.slow.count >= LONE_UNITS && ground.cells >= LONE_UNITS
        } else {
            since.targets.keys().all(|target_id| {
                let rest = self::statistic(since.estimate(Some(target_id), ground), before);
                rest >= self.settings.threshold_without_any
            })
        };
        let mean = since.estimate(None, ground)?.mean;
        let shift = EastNorth { east_m: mean[0] - before.mean[0], north_m: mean[1] - before.mean[1] };
        trusted.then(|| Alarm {
            began_at: self.blocks[onset].began_at,
            raised_at: now,
            statistic,
            shift,
            targets: since.targets.len(),
        })
    }
}

impl OpenBlock {
    fn new(time: Timestamp) -> Self {
        Self {
            began_at: time,
            latest: time,
            sum: [0.0; 2],
            compared: 0,
            e_regression_m2: 0.0,
            e_gnss_m2: 0.0,
            cells: BTreeSet::new(),
        }
    }

    fn add(&mut self, compared: &Compared, settings: &WatchSettings) {
        let (east_m, north_m) = (
            compared.regressed.east_m - compared.fix.east_m,
            compared.regressed.north_m - compared.fix.north_m,
        );
        // A box on the wrong person is one comparison, not a moved camera.
        let longest_m = CLIP_SIGMAS * (compared.e_regression_m2 + compared.e_gnss_m2).sqrt();
        let scale = (longest_m / east_m.hypot(north_m).max(1e-9)).min(1.0);
        self.sum[0] += scale * east_m;
        self.sum[1] += scale * north_m;
        self.compared += 1;
        self.latest = self.latest.max(compared.time);
        let share = 1.0 / f64::from(self.compared);
        self.e_regression_m2 += share * (compared.e_regression_m2 - self.e_regression_m2);
        self.e_gnss_m2 += share * (compared.e_gnss_m2 - self.e_gnss_m2);
        if self.cells.len() < CELLS_PER_BLOCK {
            let cell = |metres: f64| (metres / settings.length_m).floor() as i64;
            self.cells.insert((cell(compared.fix.east_m), cell(compared.fix.north_m)));
        }
    }

    fn finish(self, target_id: TargetId, settings: &WatchSettings) -> Block {
        let length_s = self.latest.duration_since(self.began_at).as_secs_f64();
        let noise = settings.gnss;
        // Long-run variance of a Gauss-Markov mean; never better than one independent value.
        let coloured = (2.0 * noise.time_constant_s / length_s.max(1.0)).min(1.0);
        let white = noise.white_share / f64::from(self.compared);
        let bias_m2 = (1.0 - noise.white_share) * self.e_gnss_m2;
        Block {
            target_id,
            began_at: self.began_at,
            ended_at: self.latest,
            mean: self.sum.map(|sum| sum / f64::from(self.compared)),
            own_m2: bias_m2 * coloured + self.e_gnss_m2 * white,
            bias_m2,
            e_regression_m2: self.e_regression_m2,
            cells: self.cells,
        }
    }
}

#[cfg(test)]
mod tests;
