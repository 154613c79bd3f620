//! From samples to a model: the candidates are compared on held-out blocks of time, then the best is fitted
//! to all samples.

mod candidates;
mod held_out;
mod pipeline;
mod report;

pub use self::pipeline::{FitOptions, FitOverrides, fit, fit_with};
