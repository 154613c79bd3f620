//! The REST transport over [`crate::app`]: routes, conversion of JSON, problems, OpenAPI.
//!
//! `resources` has a file per resource, with route and description together, `plumbing` the parts that they share. Does not contain gRPC, SQL, statuses chosen by
//! hand (they come from [`crate::status`]), checks on numbers (the constructors of [`crate::domain`] make them), or
//! a body without a limit.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod description_page;
mod plumbing;
mod resources;
#[cfg(test)]
mod tests;

use std::panic::AssertUnwindSafe;

use axum::Router;
use axum::body::Body;
use axum::response::Response;
use futures_util::FutureExt as _;
use hyper::{Method, Request};
use tower::Service as _;
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;

use crate::admission::RequestClass;
use crate::app::App;
use crate::config::Console;
use crate::domain::Error;
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

use plumbing::state::Rest;
use plumbing::{access, body_coding, description, problem};

pub use plumbing::path_key::{path_key, shown_path};
pub use resources::session_token;

/// All REST routes, the description at `/openapi.json` and its page at `/docs`, the operator's console at `/`.
#[derive(Clone)]
pub struct Transport(Router);

impl Transport {
    /// The transport over an application.
    #[must_use]
    pub fn new(app: App, console: Console, shutdown: Shutdown) -> Self {
        let pages = resources::pages(&console);
        let rest = Rest::new(app, console, shutdown);
        let (routes, described) = described().split_for_parts();
        let authorize = access::AuthorizeLayer::of(&described);
        let page = description_page::routes(described);
        Self(routes.route_layer(authorize).merge(page).merge(pages).with_state(rest))
    }

    /// Probes and metrics alone, for the listener of the setting `metrics_listen`.
    #[must_use]
    pub fn monitoring(app: App, shutdown: Shutdown) -> Self {
        let rest = Rest::new(app, Console::default(), shutdown);
        let (routes, described) = resources::monitoring().split_for_parts();
        Self(routes.route_layer(access::AuthorizeLayer::of(&described)).with_state(rest))
    }

    /// Answers a request, which carries its [`RequestContext`](crate::request::RequestContext) as an extension.
    /// Whatever part of the router refuses it, or panics, the answer is a problem.
    pub async fn answer(&self, request: Request<Body>) -> Response<Body> {
        // Not as layers of the router: axum would box the service and the future of every request for each.
        let coding = body_coding::AcceptedCoding::of(&request);
        let refused = problem::Refused::of(&request);
        let answer = AssertUnwindSafe(self.0.clone().call(request)).catch_unwind().await;
        let answer =
            answer.map_or_else(problem::panicked, |answer| answer.unwrap_or_else(|never| match never {}));
        coding.encode(refused.explain(answer)).await
    }
}

/// The class of a request, by its method and path.
#[must_use]
pub fn class(method: &Method, path: &str) -> RequestClass {
    let last = path.rsplit('/').next().unwrap_or_default();
    if path.starts_with("/v2/models/") && method == Method::POST && last == "infer" {
        return RequestClass::Fusion;
    }
    match path.strip_prefix("/v1/") {
        None if matches!(
            path,
            "/livez" | "/readyz" | "/metrics" | "/v2/health/live" | "/v2/health/ready"
        ) =>
        {
            RequestClass::Probe
        }
        Some(_) if method == Method::POST => match last {
            "fusions" | "tracks" => RequestClass::Fusion,
            "samples" | "pairings" | "gnss-error" => RequestClass::Import,
            _ => RequestClass::Other,
        },
        _ => RequestClass::Other,
    }
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
    let mut router = OpenApiRouter::with_openapi(description::head()).merge(resources::routes());
    description::add_problems(router.get_openapi_mut());
    description::add_security(router.get_openapi_mut());
    router
}
