//! The context that all fits of a run share.

use crate::domain::{GaussMarkovNoise, ImageSize, KnownPoint};
use crate::network::LossWeights;
use crate::samples::unpaired::TargetBox;

/// The context that all fits of a run share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FitContext<'a> {
    /// Error variance per axis of the receiver, m2.
    pub(crate) e_gnss_m2: f64,
    /// True if that was estimated, and may be replaced by a recipe's own estimate.
    pub(crate) e_gnss_is_estimated: bool,
    /// Standard deviation per axis of the bias that all fixes have in common, m, if known.
    pub(crate) gnss_bias_sigma_m: Option<f64>,
    pub(crate) image_size: Option<ImageSize>,
    /// Boxes without a fix, in the order of target and time.
    pub(crate) unpaired: &'a [TargetBox],
    /// Points of the ground whose place is known.
    pub(crate) known_points: &'a [KnownPoint],
    /// Median height of the targets, m, and the standard deviation of its logarithm.
    pub(crate) target_height_m: (f64, f64),
    /// Noise of the fixes about the geometric map.
    pub(crate) noise: GaussMarkovNoise,
    /// Number of epochs that replaces the recipe's own.
    pub(crate) epochs: Option<u32>,
    pub(crate) seed: u64,
    /// Loss weights that replace the recipe's own.
    pub(crate) loss_weights: Option<LossWeights>,
}
