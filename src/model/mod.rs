//! Recipes, training loop, fast forward pass and model artifacts; the only floor that knows candle.
//!
//! [`fit`] turns samples into an [`Artifact`]; [`Artifact::load`] turns that into a [`Regressor`],
//! which answers box by box from flat weights. What never happens here: storage, transport, clocks,
//! threads of its own.

mod artifact;
mod cells;
mod coverage;
pub mod dnn;
mod file;
mod fit;
pub mod homography;
mod hybrid;
mod kernel;
pub mod net;
mod paper;
mod probe;
mod projection;
mod projective;
mod regressor;
mod rows;
mod run;
mod select;
mod tensors;
mod track_beliefs;
pub mod train;
mod uncertainty;
mod whitening;

pub use artifact::{Artifact, FORMAT};
pub use fit::{FitError, FitEvent, FitOptions, Trial, fit, fit_trial};
pub use regressor::{R95_PER_SIGMA, Regression, Regressor};
pub use rows::{FEWEST_SAMPLES, SMALLEST_SPREAD_M};
pub use tensors::LARGEST_WEIGHTS_BYTES;
pub use track_beliefs::TrackBeliefs;

#[cfg(test)]
mod tests;

#[cfg(test)]
mod behaviour_tests;
