//! The score that a detector gives to a detection.

use super::error::{Error, Result};

/// A detector's score, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Score(f64);

impl Score {
    /// # Errors
    /// Refuses what is not within 0..=1; the field is named `score`.
    pub fn new(score: f64) -> Result<Self> {
        if (0.0..=1.0).contains(&score) {
            Ok(Self(score))
        } else {
            Err(Error::invalid("score", "must be from 0 to 1"))
        }
    }

    /// The score, 0 to 1.
    #[must_use]
    pub const fn value(self) -> f64 {
        self.0
    }
}
