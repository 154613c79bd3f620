//! Recipes, training loop, fast forward pass and model artifacts; the only floor that knows candle.
//!
//! [`fit`] turns samples into an [`Artifact`]; [`Artifact::load`] turns that into a [`Regressor`],
//! which answers box by box from flat weights. What never happens here: storage, transport, clocks,
//! threads of its own.

mod artifact;
mod encoder;
mod fitting;
pub mod network;
mod progress;
mod regressor;
mod samples;
mod uncertainty;

pub use artifact::{Artifact, FORMAT, LARGEST_WEIGHTS_BYTES, TrackBeliefs};
pub use encoder::projection::{Projection, fit_foot_points};
pub use fitting::fit::{FitOptions, Trial, fit, fit_trial};
pub use progress::{FitError, FitEvent};
pub use regressor::{R95_PER_SIGMA, Regression, Regressor};
pub use samples::rows::{FEWEST_SAMPLES, SMALLEST_SPREAD_M, spread};

#[cfg(test)]
mod tests;
