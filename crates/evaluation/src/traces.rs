//! An evaluation's output: the report, and the predictions and curves that its plots show.

use super::report::Report;
use crate::domain::{EpochReport, Recipe};
use crate::geo::PlaneCovariance;
use crate::geo::Position;

/// A position predicted with the first seed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TracePoint {
    /// Index of the test row.
    pub row: usize,
    /// The predicted position.
    pub position: Position,
    /// Its horizontal error, m; `None` where the truth is unknown.
    pub error_m: Option<f64>,
    /// The 95 % radius that the method states, m, if it states one.
    pub r95_m: Option<f64>,
    /// The covariance of its error, if the method states one.
    pub covariance: Option<PlaneCovariance>,
}

/// All predictions of a method with the first seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// The method's name.
    pub method: String,
    /// In order of target, then time.
    pub points: Vec<TracePoint>,
}

/// The training curve of a recipe with the first seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The recipe.
    pub recipe: Recipe,
    /// One report per epoch of the final fit.
    pub epochs: Vec<EpochReport>,
}

/// A report with the predictions and training curves of the first seed.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Evaluation {
    /// Error figures of every method.
    pub report: Report,
    /// Predictions, one trace per method.
    pub traces: Vec<Trace>,
    /// Training curves, one per recipe.
    pub curves: Vec<Curve>,
}
