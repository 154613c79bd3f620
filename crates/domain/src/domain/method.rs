//! The estimation methods that an evaluation compares, and their names.

use std::fmt;
use std::str::FromStr;

use super::error::{Error, Result};
use super::recipe::Recipe;

/// How a recipe's model is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InferenceMode {
    /// The regressed position.
    OneStep,
    /// The regressed position and the fix, weighted by (6) to (8).
    TwoStep,
    /// The regressed position from the box alone (GNSS denied).
    Denied,
}

/// A method of position estimation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// The raw fix.
    Gnss,
    /// The IMM-UKF over fixes.
    ImmUkf,
    /// The supervised DNN over box and fix.
    Dnn,
    /// The supervised DNN over the box.
    DnnDenied,
    /// The robust homography of the foot point.
    HomographyDenied,
    /// A recipe's model.
    Recipe(Recipe, InferenceMode),
    /// Sequence fusion over the default recipe.
    Track,
    /// Sequence fusion without fixes.
    TrackDenied,
}

impl Method {
    /// All methods, in the order of the table.
    #[must_use]
    pub fn all() -> Vec<Self> {
        let mut all = vec![Self::Gnss, Self::ImmUkf, Self::Dnn, Self::DnnDenied, Self::HomographyDenied];
        for &recipe in Recipe::ALL {
            all.extend(
                [InferenceMode::OneStep, InferenceMode::TwoStep, InferenceMode::Denied]
                    .map(|mode| Self::Recipe(recipe, mode)),
            );
        }
        all.extend([Self::Track, Self::TrackDenied]);
        all
    }

    /// Methods from a comma-separated list of names, or `all`.
    ///
    /// # Errors
    /// Names `methods` for an unknown name.
    pub fn list(text: &str) -> Result<Vec<Self>> {
        if text == "all" {
            return Ok(Self::all());
        }
        text.split(',').map(|name| name.trim().parse()).collect()
    }

    /// The recipe whose model it uses; `default` is that of the tracks.
    #[must_use]
    pub const fn recipe(self, default: Recipe) -> Option<Recipe> {
        match self {
            Self::Recipe(recipe, _) => Some(recipe),
            Self::Track | Self::TrackDenied => Some(default),
            _ => None,
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Gnss => out.pad("gnss"),
            Self::ImmUkf => out.pad("imm_ukf"),
            Self::Dnn => out.pad("dnn"),
            Self::DnnDenied => out.pad("dnn.denied"),
            Self::HomographyDenied => out.pad("homography.denied"),
            Self::Track => out.pad("track"),
            Self::TrackDenied => out.pad("track.denied"),
            Self::Recipe(recipe, mode) => {
                let mode = match mode {
                    InferenceMode::OneStep => "one_step",
                    InferenceMode::TwoStep => "two_step",
                    InferenceMode::Denied => "denied",
                };
                out.pad(&format!("{recipe}.{mode}"))
            }
        }
    }
}

impl FromStr for Method {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::all().into_iter().find(|method| method.to_string() == name).ok_or_else(|| {
            let names: Vec<String> = Self::all().iter().map(Self::to_string).collect();
            Error::invalid("methods", format!("{name:?} is not one of all, {}", names.join(", ")))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_parsed() {
        let all = Method::all();
        assert_eq!(all.len(), 7 + 3 * Recipe::ALL.len());
        for method in &all {
            assert_eq!(method.to_string().parse::<Method>().expect("a name"), *method);
        }
        assert_eq!(Method::list("all").expect("all"), all);
        let two = Method::list("gnss, auto.denied").expect("two");
        assert_eq!(two, [Method::Gnss, Method::Recipe(Recipe::Auto, InferenceMode::Denied)]);
        assert!(Method::list("gnss,guess").is_err());
    }
}
