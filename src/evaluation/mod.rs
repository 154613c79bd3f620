//! Methods side by side: every way to tell a position, over one test file, against the truth.
//!
//! What never happens here: a choice made on test rows. All that is learnt, and all that is tuned,
//! comes from the training samples alone.

mod learners;
mod method;
mod metrics;
mod plots;
mod report;
mod runner;
mod truth;

pub use method::{Method, Step};
pub use metrics::{BOUNDS_M, Judged, Metrics};
pub use plots::plots;
pub use report::{MethodReport, Report};
pub use runner::{Curve, EvaluateOptions, Evaluation, TestRow, Trace, TracePoint, evaluate};
pub use truth::Truth;
