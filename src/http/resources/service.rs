//! Routes for those that watch the server: `/livez`, `/readyz`, `/metrics`.

use std::time::Duration;

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use hyper::header::CONTENT_TYPE;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::DatabaseHistory;
use crate::app::access::Permission;
use crate::domain::{Error, ErrorKind};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;

/// Time for the store's response, below the timeouts that probes of readiness have.
const PING_TIME: Duration = Duration::from_secs(1);

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(livez)).routes(routes!(readyz)).routes(routes!(metrics))
}

/// Check that the process is alive
#[utoipa::path(
    get, path = "/livez", tag = "service",
    responses((status = 200, description = "It is", body = String, content_type = "text/plain"))
)]
async fn livez() -> &'static str {
    "alive\n"
}

/// Cameras that `/readyz` names one by one.
const NAMED_CAMERAS: usize = 100;

/// Check that the server is ready
///
/// The first line is `ready`. The server stays ready in these states, each of which has a line of its own: an active
/// model that cannot be used (`degraded: camera ...`; the camera's fixes still pass through), a full disk
/// (`degraded: insufficient-storage: ...`), and damaged pages, or a database that continues from an earlier state than
/// it had acknowledged (`degraded: database: ...`). Callers that may not read get the first line only.
#[utoipa::path(
    get, path = "/readyz", tag = "service",
    responses(
        (status = 200, description = "It can", body = String, content_type = "text/plain"),
        (status = 503, description = "It is shutting down, or its store does not respond", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn readyz(State(rest): State<Rest>, CallerApp(app): CallerApp) -> ApiResult<String> {
    if rest.shutdown.is_draining() {
        return Err(Error::refused(ErrorKind::ShuttingDown, "the server is ending").into());
    }
    match tokio::time::timeout(PING_TIME, app.store.ping()).await {
        Ok(answered) => answered?,
        Err(_) => return Err(slow_store().into()),
    }
    app.access.check_confirmed(app.clock.monotonic())?;
    let history = app.nodes().database_history();
    if history == DatabaseHistory::Reading {
        let message = "the history of the database has changed; everything is read again";
        return Err(Error::refused(ErrorKind::Overloaded, message).into());
    }
    let mut text = "ready\n".to_owned();
    if app.caller().authorize(Permission::Read).is_err() {
        return Ok(text);
    }
    if let DatabaseHistory::BrokenAt(time) = history {
        text.push_str(&format!(
            "degraded: database: its history changed, as was noticed at {time}; what it had acknowledged last may be lost\n"
        ));
    }
    let faults = app.registry.model_faults();
    if app.store.is_full() {
        text.push_str("degraded: insufficient-storage: imports are refused until space is freed\n");
    }
    if app.store.is_damaged() {
        text.push_str(
            "degraded: database: a damaged page was read; restore a backup: sightfix restore FILE\n",
        );
    }
    for (camera, fault) in faults.iter().take(NAMED_CAMERAS) {
        text.push_str(&format!("degraded: camera {camera}: {}\n", fault.reason));
    }
    if faults.len() > NAMED_CAMERAS {
        text.push_str(&format!("degraded: {} more cameras\n", faults.len() - NAMED_CAMERAS));
    }
    Ok(text)
}

fn slow_store() -> Error {
    let seconds = PING_TIME.as_secs();
    Error::refused(ErrorKind::Overloaded, format!("the store did not answer within {seconds} s"))
}

/// Counters and times, in the text format of Prometheus
#[utoipa::path(
    get, path = "/metrics", tag = "service",
    responses((status = 200, description = "Metrics", body = String, content_type = "text/plain"))
)]
async fn metrics(CallerApp(app): CallerApp) -> Response {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], app.metrics.render()).into_response()
}
