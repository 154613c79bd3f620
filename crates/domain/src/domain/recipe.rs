//! The recipes: ways to train a camera's model.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};
use utoipa::ToSchema;

use super::error::Error;

/// A way to train a camera's model; `docs/explanation/method.md` describes each.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Hash,
    Default,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
    Serialize,
    Deserialize,
    ToSchema,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_recipe)]
pub enum Recipe {
    /// Liang et al. 2022 as published: raw pixels, standardised degrees, weights 1 : 2000, Es by (4).
    Paper,
    /// The same hybrid loss in metres and scaled inputs, box-only encoder, robust Es.
    Hybrid,
    /// A learned homography of the foot point with a small residual network.
    Projective,
    /// A projective map with a Gaussian-process residual under coloured noise per receiver.
    GaussianProcess,
    /// Trains the candidates and selects the best on held-out blocks of time.
    #[default]
    Auto,
}

impl Recipe {
    /// All recipes.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Name in profiles, commands and reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

fn unknown_recipe(_: &str) -> Error {
    let names: Vec<&str> = Recipe::ALL.iter().map(|recipe| recipe.as_str()).collect();
    Error::invalid("recipe", format!("must be one of {}", names.join(", ")))
}
