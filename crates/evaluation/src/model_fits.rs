//! Fits the models that a set of methods needs, from the training samples alone, once per seed.

use std::ops::ControlFlow;

use super::options::EvaluateOptions;
use crate::domain::{EpochReport, GnssBiasSigma, GnssError, Method, Recipe};
use crate::model::{FitEvent, FitInput, FitOptions, Regressor, fit};

/// The result of a computation, or the reason why it failed, with the CPU time that it took.
pub(super) struct Timed<T> {
    pub(super) outcome: Result<T, String>,
    pub(super) cpu_s: f64,
}

impl<T> Timed<T> {
    /// Runs a computation and measures its CPU time by the options' clock.
    pub(super) fn run(options: &EvaluateOptions, compute: impl FnOnce() -> Result<T, String>) -> Self {
        let start_s = (options.cpu_s)();
        let outcome = compute();
        Self { outcome, cpu_s: (options.cpu_s)() - start_s }
    }
}

/// A recipe's model with its training curve.
pub(super) struct RecipeModel {
    pub(super) regressor: Regressor,
    pub(super) curve: Vec<EpochReport>,
}

/// The recipes whose models these methods use, each once.
pub(super) fn recipes_of(methods: &[Method], default: Recipe) -> Vec<Recipe> {
    Recipe::ALL
        .iter()
        .copied()
        .filter(|recipe| methods.iter().any(|method| method.recipe(default) == Some(*recipe)))
        .collect()
}

/// Fits one recipe; `progress` receives the phase of the fit in words.
pub(super) fn fit_recipe(
    recipe: Recipe,
    seed: u64,
    train: FitInput<'_>,
    options: &EvaluateOptions,
    progress: &mut dyn FnMut(&str) -> ControlFlow<()>,
) -> Timed<RecipeModel> {
    let fit_options = FitOptions {
        recipe,
        seed,
        epochs: options.epochs,
        image_size: options.image_size,
        gnss_error: options.gnss_sigma.map_or(GnssError::Unknown, GnssError::Known),
        gnss_bias_sigma_m: options.gnss_bias_sigma.map(GnssBiasSigma::metres),
    };
    Timed::run(options, || {
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
