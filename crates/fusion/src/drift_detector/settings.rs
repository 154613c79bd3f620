//! Parameters of the drift detector.

use crate::domain::NoiseCorrelation;

/// Error model, thresholds and bounds of a drift detector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriftDetectorSettings {
    /// Temporal correlation of the receivers' error over seconds.
    pub gnss: NoiseCorrelation,
    /// Length of a block, s.
    pub block_s: f64,
    /// A block is closed when its target was not sampled for longer than this, s.
    pub gap_s: f64,
    /// Standard deviation of the slow error of one receiver (site, satellites), divided by that of its
    /// bias.
    pub receiver_share: f64,
    /// The same for the slow error common to all receivers.
    pub common_share: f64,
    /// Slow errors further apart in time than this are independent, s.
    pub slow_correlation_s: f64,
    /// Side of a cell of ground within which the model's error is constant, m.
    pub cell_m: f64,
    /// Standard deviation of the constant offset left by the training, divided by that of the bias.
    pub offset_prior_share: f64,
    /// The statistic that raises the alarm: chi-square with 2 degrees of freedom at one given onset
    /// without a change.
    pub threshold: f64,
    /// The statistic that must remain without any one target.
    pub leave_one_out_threshold: f64,
    /// Blocks retained; earlier onsets are not distinguished.
    pub max_blocks: usize,
    /// Targets with an open block at once.
    pub max_targets: usize,
}

impl Default for DriftDetectorSettings {
    fn default() -> Self {
        Self {
            gnss: NoiseCorrelation::PHONE,
            block_s: 120.0,
            gap_s: 30.0,
            receiver_share: 0.4,
            common_share: 0.25,
            slow_correlation_s: 3_600.0,
            cell_m: 10.0,
            offset_prior_share: 0.5,
            // One false alarm in 48 simulated months, 24 with one receiver and 24 with four.
            threshold: 25.0,
            leave_one_out_threshold: 8.0,
            max_blocks: 512,
            max_targets: 64,
        }
    }
}
