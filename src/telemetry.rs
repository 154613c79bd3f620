//! Logs and metrics.

mod logging;
mod metrics;
pub mod process;
mod registry;
mod request_metrics;

pub use logging::{LogControl, REQUEST_ID, RequestId, start_log};
pub use metrics::{CloseReason, JobMetrics, Metrics, OpenConnection};
pub use request_metrics::{MatchedRoute, OTHER_RPC, Route, RpcCall};
