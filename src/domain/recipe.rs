//! The ways to learn a camera.

use std::fmt;
use std::str::FromStr;

use super::error::{Error, Result};

/// How a camera is learnt; `docs/method.md` tells each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Recipe {
    /// Liang et al. 2022 to the letter: raw pixels, standardised degrees, weights 1 : 2000, Es by (4).
    Paper,
    /// The same hybrid loss in metres and scaled inputs, box-only encoder, robust Es.
    Hybrid,
    /// A learnt homography of the foot point with a small residual network.
    Projective,
    /// Trains the candidates and keeps the best on held-out blocks of time.
    #[default]
    Auto,
}

impl Recipe {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Paper, Self::Hybrid, Self::Projective, Self::Auto];

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Hybrid => "hybrid",
            Self::Projective => "projective",
            Self::Auto => "auto",
        }
    }
}

impl fmt::Display for Recipe {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl FromStr for Recipe {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|recipe| recipe.as_str() == name)
            .ok_or_else(|| Error::invalid("recipe", "must be one of paper, hybrid, projective, auto"))
    }
}
