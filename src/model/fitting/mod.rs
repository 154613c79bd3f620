//! From samples to a model: the candidates are compared on held-out blocks of time, then the best is fitted
//! to all samples.

mod candidates;
mod findings;
mod gnss_noise;
mod held_out;
mod pipeline;
mod report;
mod track_noise;
mod widening;

pub use self::gnss_noise::{TimedResidual, estimate_gnss_noise};
pub use self::pipeline::{FitInput, FitOptions, FitOverrides, fit, fit_with};
