//! Compares methods: every way to estimate a position, on the same test rows, against the truth.
//!
//! Whatever is fitted or tuned is fitted on the training samples alone; no choice depends on a test
//! row.

pub(crate) mod axis;
pub mod baselines;
pub(crate) mod chart;
mod metrics;
mod options;
pub(crate) mod plots;
mod positions;
mod predictors;
mod report;
mod runner;
pub mod site;
#[cfg(test)]
mod tests;
mod traces;
mod training;
mod truth;

pub use crate::domain::{Method, Truth};
pub use metrics::{BOUNDS_M, ErrorMetrics, ScoredPrediction};
pub use options::{EvaluateOptions, Progress, TestRow};
pub use plots::plots;
pub use positions::{EvaluatedPosition, ReportWithPositions};
pub use report::{MethodReport, Report};
pub use runner::evaluate;
pub use traces::{Curve, Evaluation, Trace, TracePoint};
