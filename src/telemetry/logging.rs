//! The log of the process, and the id by which it names a request.

use std::io::IsTerminal as _;

use anyhow::Context as _;
use hyper::http::{HeaderName, HeaderValue};
#[cfg(feature = "otel")]
use tracing::Level;
#[cfg(feature = "otel")]
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _, Registry, fmt, reload};

#[cfg(feature = "otel")]
use super::traces;
use crate::config::{Config, LogFormat};

/// Changes what is logged while the process runs.
#[derive(Clone)]
pub struct LogControl {
    filter: reload::Handle<EnvFilter, Registry>,
    #[cfg(feature = "otel")]
    traces: Option<opentelemetry_sdk::trace::SdkTracerProvider>,
}

impl LogControl {
    /// Logs what another filter selects.
    ///
    /// # Errors
    /// A filter that cannot be read; the previous one stays.
    pub fn set_filter(&self, filter: &str) -> anyhow::Result<()> {
        self.filter.reload(EnvFilter::try_new(filter)?).context("cannot change the log's filter")
    }

    /// Sends the traces that are not sent yet, before the process ends.
    pub fn close(&self) {
        #[cfg(feature = "otel")]
        if let Some(Err(error)) = self.traces.as_ref().map(|traces| traces.shutdown()) {
            tracing::warn!(%error, "the latest traces could not be sent");
        }
    }
}

/// Target of the spans and the log lines of requests.
pub const REQUESTS: &str = "sightfix::requests";

/// Starts the log of the process, on standard error, and its traces where they are set up. Must be called within a
/// tokio runtime.
///
/// # Errors
/// A filter that cannot be read, or a log that was started before.
pub fn start_log(config: &Config) -> anyhow::Result<LogControl> {
    let (filter, control) = reload::Layer::new(EnvFilter::try_new(&config.log_filter)?);
    let lines = fmt::layer()
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        // A line that cannot be written is lost: reported by `eprintln!`, it would end the server.
        .log_internal_errors(false);
    let lines = match config.log_format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    };
    let log = tracing_subscriber::registry().with(lines.with_filter(filter));
    #[cfg(feature = "otel")]
    let (log, traces) = {
        let traces = config.trace_endpoint.as_deref().map(traces::exporter).transpose()?;
        let spans = traces.as_ref().map(|traces| {
            let requests = Targets::new().with_target(REQUESTS, Level::DEBUG);
            tracing_opentelemetry::layer().with_tracer(traces::tracer(traces)).with_filter(requests)
        });
        (log.with(spans), traces)
    };
    #[cfg(not(feature = "otel"))]
    anyhow::ensure!(
        config.trace_endpoint.is_none(),
        "the setting trace_endpoint needs a build with the cargo feature otel"
    );
    log.try_init().context("cannot start the log")?;
    Ok(LogControl {
        filter: control,
        #[cfg(feature = "otel")]
        traces,
    })
}

/// Header that carries the request id, in and out.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Names one request in the log, in its answer's header and in its problem.
#[derive(Debug, Clone)]
pub struct RequestId(HeaderValue);

impl RequestId {
    /// From visible ASCII.
    #[must_use]
    pub const fn new(id: HeaderValue) -> Self {
        Self(id)
    }

    /// As a header's value.
    #[must_use]
    pub const fn header(&self) -> &HeaderValue {
        &self.0
    }

    #[must_use]
    pub fn as_str(&self) -> &str {
        self.0.to_str().unwrap_or_default()
    }
}

impl std::fmt::Display for RequestId {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str(self.as_str())
    }
}
