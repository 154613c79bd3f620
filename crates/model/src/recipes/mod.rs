//! The recipes, each in a folder of its own: the candidates of its fit, its encoder, and the encoder as an ONNX graph.
//!
//! A recipe is registered by its name in [`Recipe`] and its line in [`definition`].

mod candidate;
mod fit_context;
pub(crate) mod gaussian_process;
mod hybrid;
mod paper;
mod projective;

use std::sync::Arc;

use crate::artifact::ModelParts;
use crate::domain::{Error, Recipe, Result};
use crate::encoder::Encoder;

pub(crate) use candidate::{Candidate, Estimator};
pub(crate) use fit_context::FitContext;

/// How the models of a recipe are fitted and loaded.
pub(crate) struct Definition {
    /// The ways to fit it, the one to keep unless another is clearly better first.
    candidates: &'static [Candidate],
    /// Takes the encoder's tensors out of the parts of a model.
    load: fn(&mut ModelParts) -> Result<Arc<dyn Encoder>>,
    error_source: ErrorSource,
}

/// Where the stated error of a recipe's answers comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ErrorSource {
    /// A formula of the recipe alone, which nothing calibrates.
    Formula,
    /// The recipe's fit, calibrated on targets that it leaves out.
    LeftOutTargets,
    /// The error model, calibrated by the residuals of held-out rows.
    HeldOutRows,
}

/// The recipes that `auto` chooses among, the one to keep unless another is clearly better first.
const AUTO: [Recipe; 3] = [Recipe::GaussianProcess, Recipe::Projective, Recipe::Hybrid];

/// The table of recipes. `auto` has no model of its own.
fn definition(recipe: Recipe) -> Option<&'static Definition> {
    match recipe {
        Recipe::Paper => Some(&paper::DEFINITION),
        Recipe::Hybrid => Some(&hybrid::DEFINITION),
        Recipe::Projective => Some(&projective::DEFINITION),
        Recipe::GaussianProcess => Some(&gaussian_process::DEFINITION),
        Recipe::Auto => None,
    }
}

/// The candidates of a recipe, the one to keep unless another is clearly better first.
pub(crate) fn candidates(recipe: Recipe) -> impl Iterator<Item = &'static Candidate> {
    let recipes = if recipe == Recipe::Auto { AUTO.to_vec() } else { vec![recipe] };
    recipes.into_iter().filter_map(definition).flat_map(|definition| definition.candidates)
}

/// Takes the encoder's tensors out of the parts of a model.
///
/// # Errors
/// Names the tensor or metadata field that is missing or cannot be used.
pub(crate) fn load(parts: &mut ModelParts) -> Result<Arc<dyn Encoder>> {
    let Some(definition) = definition(parts.recipe) else {
        let names = AUTO.map(Recipe::as_str).join(", ");
        let message = format!("must be the recipe that auto has chosen: one of {names}");
        return Err(Error::invalid("metadata.recipe", message));
    };
    (definition.load)(parts)
}

/// Where the stated error of a recipe's answers comes from.
pub(crate) fn error_source(recipe: Recipe) -> ErrorSource {
    definition(recipe).map_or(ErrorSource::HeldOutRows, |definition| definition.error_source)
}
