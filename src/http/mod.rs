//! The REST transport over [`crate::app`]: routes, conversion of JSON, problems, OpenAPI.
//!
//! Route and description are declared together, a file per resource. What never happens here:
//! gRPC, SQL, statuses chosen by hand (they come from [`crate::status`]), numbers checked (that is
//! done by the constructors of [`crate::domain`]), a body without a limit.

mod body;
mod cameras;
mod description;
mod extract;
mod fusions;
mod gnss_error;
mod models;
mod problem;
mod receivers;
mod samples;
mod service;
#[cfg(test)]
mod tests;
mod tracks;
mod training_runs;
mod wire;

use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::FromRef;
use axum::middleware::from_fn;
use axum::response::Response;
use tokio::sync::Semaphore;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_swagger_ui::{Config, SwaggerUi};

use crate::app::App;
use crate::domain::Error;
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

/// What the handlers share.
#[derive(Clone)]
struct Rest {
    app: App,
    shutdown: Shutdown,
    /// Places for event streams.
    event_streams: Arc<Semaphore>,
}

impl FromRef<Rest> for App {
    fn from_ref(rest: &Rest) -> Self {
        rest.app.clone()
    }
}

/// All REST routes, the description at `/openapi.json` and its page at `/docs`.
///
/// Requests carry their [`RequestId`] as an extension.
pub fn router(app: App, shutdown: Shutdown) -> Router {
    let event_streams = Arc::new(Semaphore::new(app.limits.event_streams));
    let rest = Rest { app, shutdown, event_streams };
    let (routes, described) = described().split_for_parts();
    // The page would otherwise ask a server on the internet whether the description is well formed.
    let page = SwaggerUi::new("/docs")
        .url("/openapi.json", described)
        .config(Config::default().validator_url("none").use_base_layout());
    routes
        .merge(page)
        .with_state(rest)
        // As one layer: axum boxes every request anew for each.
        .layer((from_fn(problem::tell), CatchPanicLayer::custom(problem::panicked)))
}

/// The description of the REST interface, by OpenAPI 3.1.
#[must_use]
pub fn openapi() -> OpenApi {
    described().into_openapi()
}

/// The answer to a request that was refused before it reached a route.
#[must_use]
pub fn refusal(error: &Error, id: &RequestId) -> Response<Body> {
    problem::response(error, id, None)
}

fn described() -> OpenApiRouter<Rest> {
    let mut router = OpenApiRouter::with_openapi(description::head())
        .merge(cameras::routes())
        .merge(samples::routes())
        .merge(training_runs::routes())
        .merge(models::routes())
        .merge(fusions::routes())
        .merge(tracks::routes())
        .merge(gnss_error::routes())
        .merge(service::routes());
    description::add_problems(router.get_openapi_mut());
    router
}
