//! Logs and metrics.

mod logging;
mod metrics;

pub use logging::{REQUEST_ID, RequestId, start_log};
pub use metrics::{CloseReason, JobMetrics, Metrics, OpenConnection, SiteItemOutcome};
