//! The candidates of each recipe.

use crate::domain::{GaussMarkovNoise, ImageSize, Recipe};
use crate::encoder::projective::Variant;
use crate::encoder::{FittedEncoder, gaussian_process, hybrid, paper, projective};
use crate::network::LossWeights;
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;
use crate::samples::unpaired::TargetBox;
use crate::uncertainty::coverage::Coverage;
use crate::uncertainty::error_model::set_uncalibrated;

/// One way to fit a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Candidate {
    /// Name in the model's report.
    pub(super) name: &'static str,
    pub(super) estimator: Estimator,
    /// True if the labels are smoothed by a kinematic smoother.
    smoothed: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Estimator {
    Paper,
    Hybrid,
    Projective(Variant),
    GaussianProcess,
}

const HOMOGRAPHY: Candidate =
    candidate("projective/foot", Estimator::Projective(variant(false, false)), false);
const SIZE: Candidate = candidate("projective/sides", Estimator::Projective(variant(true, false)), false);
const RESIDUAL: Candidate =
    candidate("projective/residual", Estimator::Projective(variant(true, true)), false);
const SIZE_SMOOTHED: Candidate =
    candidate("projective/sides+smoothed", Estimator::Projective(variant(true, false)), true);
const HYBRID: Candidate = candidate("hybrid", Estimator::Hybrid, false);
const HYBRID_SMOOTHED: Candidate = candidate("hybrid+smoothed", Estimator::Hybrid, true);
const GAUSSIAN_PROCESS: Candidate = candidate("gaussian_process", Estimator::GaussianProcess, false);
const PAPER: Candidate = candidate("paper", Estimator::Paper, false);

const fn candidate(name: &'static str, estimator: Estimator, smoothed: bool) -> Candidate {
    Candidate { name, estimator, smoothed }
}

const fn variant(uses_size: bool, residual: bool) -> Variant {
    Variant { uses_size, residual }
}

/// The candidates of a recipe, the one to keep unless another is clearly better first.
pub(super) const fn of_recipe(recipe: Recipe) -> &'static [Candidate] {
    match recipe {
        Recipe::Paper => &[PAPER],
        Recipe::Hybrid => &[HYBRID, HYBRID_SMOOTHED],
        Recipe::Projective => &[HOMOGRAPHY, SIZE, SIZE_SMOOTHED, RESIDUAL],
        Recipe::GaussianProcess => &[GAUSSIAN_PROCESS],
        Recipe::Auto => {
            &[GAUSSIAN_PROCESS, HOMOGRAPHY, SIZE, SIZE_SMOOTHED, RESIDUAL, HYBRID, HYBRID_SMOOTHED]
        }
    }
}

/// The context that all fits of a run share.
#[derive(Debug, Clone, Copy)]
pub(super) struct FitContext<'a> {
    /// Error variance per axis of the receiver, m2.
    pub(super) e_gnss_m2: f64,
    pub(super) e_gnss_is_estimated: bool,
    /// Standard deviation per axis of what all fixes have in common, m, if known.
    pub(super) gnss_bias_sigma_m: Option<f64>,
    pub(super) image_size: Option<ImageSize>,
    /// Boxes without a fix, in the order of target and time.
    pub(super) unpaired: &'a [TargetBox],
    /// Median height of the targets, m, and the standard deviation of its logarithm.
    pub(super) target_height_m: (f64, f64),
    /// Noise of the fixes about the geometric map.
    pub(super) noise: GaussMarkovNoise,
    /// Number of epochs that replaces the recipe's own.
    pub(super) epochs: Option<u32>,
    pub(super) seed: u64,
    /// Loss weights that replace the recipe's own.
    pub(super) loss_weights: Option<LossWeights>,
}

impl FitContext<'_> {
    fn map_settings(&self) -> gaussian_process::Settings<'_> {
        gaussian_process::Settings {
            e_gnss_m2: self.e_gnss_m2,
            e_gnss_is_estimated: self.e_gnss_is_estimated,
            gnss_bias_sigma_m: self.gnss_bias_sigma_m,
            white_share: self.noise.correlation.white_share,
            image_size: self.image_size,
            unpaired: self.unpaired,
            target_height_m: self.target_height_m,
            seed: self.seed,
        }
    }
}

impl Candidate {
    /// True if the labels are smoothed.
    pub(super) const fn is_smoothed(&self) -> bool {
        self.smoothed
    }

    /// Epochs of the training of one network.
    pub(super) fn epochs(&self, context: &FitContext<'_>) -> u32 {
        let default = match self.estimator {
            Estimator::Paper => paper::EPOCHS,
            Estimator::Hybrid => hybrid::EPOCHS,
            Estimator::Projective(_) => projective::EPOCHS,
            Estimator::GaussianProcess => gaussian_process::EPOCHS,
        };
        context.epochs.unwrap_or(default).max(1)
    }

    /// Epochs of one fit, over all of its networks, and what its map counts as; the final one of `gaussian_process` has a
    /// network.
    pub(super) fn total_epochs(&self, context: &FitContext<'_>, is_final: bool) -> u32 {
        let networks = match self.estimator {
            Estimator::Paper => 2,
            Estimator::Hybrid => 1,
            Estimator::Projective(variant) => u32::from(variant.residual),
            Estimator::GaussianProcess => u32::from(is_final),
        };
        networks.saturating_mul(self.epochs(context)).saturating_add(self.map_epochs())
    }

    /// Epochs of a network that take as long as the map of a fit, which has none, at some thousand rows: progress counts
    /// it as these.
    const fn map_epochs(&self) -> u32 {
        match self.estimator {
            Estimator::Paper | Estimator::Hybrid => 0,
            Estimator::Projective(_) => 20,
            Estimator::GaussianProcess => 150,
        }
    }

    /// Fits the encoder to rows; its error is not calibrated.
    pub(super) fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        phase.advance(0)?;
        let smoothed = self.smoothed.then(|| rows.smoothed(&context.noise));
        let rows = smoothed.as_ref().unwrap_or(rows);
        let (e_gnss_m2, epochs) = (context.e_gnss_m2, self.epochs(context));
        let mut fitted = match self.estimator {
            Estimator::Paper => paper::fit(rows, e_gnss_m2, epochs, phase),
            Estimator::Hybrid => hybrid::fit(rows, e_gnss_m2, epochs, phase),
            Estimator::Projective(variant) => projective::fit(rows, variant, e_gnss_m2, epochs, phase),
            Estimator::GaussianProcess => gaussian_process::fit(rows, &context.map_settings(), epochs, phase),
        }?;
        phase.advance(self.map_epochs())?;
        let coverage = Coverage::new(rows.rows.iter().map(|row| row.bounding_box));
        match self.estimator {
            Estimator::Paper => coverage.put(&mut fitted.parts.tensors),
            _ => set_uncalibrated(&mut fitted.parts, &coverage),
        }
        Ok(fitted)
    }
}
