//! Compares methods: every way to estimate a position, on the same test rows, against the truth.
//!
//! Whatever is fitted or tuned is fitted on the training samples alone; no choice depends on a test
//! row.
//!
//! | module | contents |
//! |---|---|
//! | [`evaluate`], [`Report`] | all methods on the same rows, and their figures |
//! | [`baselines`] | what a method is compared with: a homography, a linear regression |
//! | [`plots()`] | charts of a report as SVG |
//! | [`site`] | the figures of world tracks |
//! | [`paper_experiments`] | the cases of docs/explanation/accuracy.md, their marks, tables and pictures; imports from all others |
//!
//! Nothing here does input or output. The CPU time of a fit is measured by a function that is handed in.

#![warn(missing_docs)]

pub(crate) mod axis;
pub mod baselines;
pub(crate) mod chart;
mod metrics;
mod model_fits;
mod options;
pub mod paper_experiments;
pub(crate) mod plots;
mod positions;
mod predictors;
mod report;
mod runner;
pub mod site;
#[cfg(test)]
mod tests;
mod traces;
mod truth;

pub use crate::domain::{Method, Truth};
pub use metrics::{BOUNDS_M, ErrorMetrics, ScoredPrediction};
pub use options::{EvaluateOptions, Progress, TestRow};
pub use plots::plots;
pub use positions::{EvaluatedPosition, ReportWithPositions};
pub use report::{MethodReport, Report};
pub use runner::evaluate;
pub use traces::{Curve, Evaluation, Trace, TracePoint};
pub use truth::truth_from_geojson;

use sightfix_domain::{domain, geo, statistics};
use sightfix_fusion as fusion;
use sightfix_model::{self as model, filters};
use sightfix_places as places;
use sightfix_simulation as simulation;
