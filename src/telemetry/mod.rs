//! Logs and metrics.

mod logging;
mod metrics;
pub mod process;
mod registry;
mod request_metrics;
#[cfg(feature = "otel")]
mod traces;

pub use logging::{LogControl, REQUEST_ID, REQUESTS, RequestId, start_log};
pub use metrics::{CloseReason, JobMetrics, Metrics, OpenConnection, OutsideFigures, SiteItemOutcome};
pub use request_metrics::{OTHER_RPC, Route, RpcCall};
#[cfg(feature = "otel")]
pub use traces::continue_trace;
