//! Methods side by side: every way to tell a position, over one test file, against the truth.
//!
//! What never happens here: a choice made on test rows. All that is learnt, and all that is tuned,
//! comes from the training samples alone.

pub mod baselines;
mod metrics;
mod plots;
mod report;
mod runner;
#[cfg(test)]
mod tests;
mod training;
mod truth;

// What is evaluated by which, in the words of the domain, where jobs keep them.
pub use crate::domain::{Method, Step, Truth};
pub use metrics::{BOUNDS_M, Judged, Metrics};
pub use plots::plots;
pub use report::{MethodReport, Report};
pub use runner::{Curve, Doing, EvaluateOptions, Evaluation, TestRow, Trace, TracePoint, evaluate};
