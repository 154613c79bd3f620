//! Learns what a set of methods needs, from the training samples alone, once per seed.

use std::ops::ControlFlow;

use super::runner::EvaluateOptions;
use crate::domain::{EpochReport, GnssError, Method, Recipe, Sample};
use crate::filters::{ImmUkf, ImmUkfOptions, Traverse};
use crate::model::{FitEvent, FitOptions, Regressor, fit};

/// Accelerations that the IMM-UKF is tuned over, m/s2.
const ACCELERATIONS_MPS2: [f64; 7] = [0.03, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2];

/// Something learnt, or why it could not be, with what it cost.
pub(super) struct Learnt<T> {
    pub(super) outcome: Result<T, String>,
    pub(super) cpu_s: f64,
}

impl<T> Learnt<T> {
    /// Runs and times.
    pub(super) fn by(options: &EvaluateOptions, learn: impl FnOnce() -> Result<T, String>) -> Self {
        let begun_s = (options.cpu_s)();
        let outcome = learn();
        Self { outcome, cpu_s: (options.cpu_s)() - begun_s }
    }
}

/// A recipe's model with the curve of its fit.
pub(super) struct RecipeModel {
    pub(super) regressor: Regressor,
    pub(super) curve: Vec<EpochReport>,
}

/// The recipes that some methods need, each once.
pub(super) fn recipes_of(methods: &[Method], default: Recipe) -> Vec<Recipe> {
    Recipe::ALL
        .iter()
        .copied()
        .filter(|recipe| methods.iter().any(|method| method.recipe(default) == Some(*recipe)))
        .collect()
}

/// Fits one recipe.
pub(super) fn learn_recipe(
    recipe: Recipe,
    seed: u64,
    train: &[Sample],
    options: &EvaluateOptions,
    progress: &mut dyn FnMut(&str) -> ControlFlow<()>,
) -> Learnt<RecipeModel> {
    let fit_options = FitOptions {
        recipe,
        seed,
        epochs: options.epochs,
        image_size: options.image_size,
        gnss_error: options.gnss_sigma.map_or(GnssError::Unknown, GnssError::Known),
    };
    Learnt::by(options, || {
        let mut curve = Vec::new();
        let artifact = fit(train, &fit_options, &mut |event| match event {
            FitEvent::Progress(run) => {
                progress(&format!("{recipe}, seed {seed}, {} {}/{}", run.phase, run.epoch, run.epochs))
            }
            FitEvent::Epoch(epoch) => {
                curve.push(*epoch);
                ControlFlow::Continue(())
            }
            FitEvent::HeldOut(_) | FitEvent::Note(_) => ControlFlow::Continue(()),
        });
        let regressor =
            artifact.map_err(|error| error.to_string())?.load().map_err(|error| error.to_string())?;
        Ok(RecipeModel { regressor, curve })
    })
}

/// The IMM-UKF whose acceleration makes the training fixes likeliest, the receiver's variance given.
///
/// Coloured errors look like motion, so the likelihood alone would follow every fix; the track's own
/// split into white and coloured is not this baseline's to know.
pub(super) fn tune_imm_ukf(traverses: &[Traverse], variance_m2: f64) -> ImmUkfOptions {
    let likelihood = |acceleration_mps2: f64| -> f64 {
        let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(acceleration_mps2));
        let mut sum = 0.0;
        for (times_s, fixes) in traverses {
            filter.step(1e9, None);
            for (index, fix) in fixes.iter().enumerate() {
                let seconds = if index == 0 { 0.0 } else { times_s[index] - times_s[index - 1] };
                let estimate = filter.step(seconds, Some((*fix, variance_m2)));
                sum += estimate.map_or(0.0, |estimate| estimate.log_likelihood);
            }
        }
        sum
    };
    let scored = ACCELERATIONS_MPS2.map(|candidate| (likelihood(candidate), candidate));
    let best = scored.into_iter().max_by(|one, other| one.0.total_cmp(&other.0));
    ImmUkfOptions::from_acceleration(best.map_or(0.4, |(_, candidate)| candidate))
}
