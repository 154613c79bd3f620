//! `/v1/demonstration`: the end of what `serve --demo` shows.

use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::empty;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(end_demonstration))
}

/// End the demonstration
///
/// Stops its simulated cameras, phones and ship, and removes its cameras, site and connections with all that they have
/// stored. Training runs of its cameras are cancelled first. Does nothing if none is shown; `demonstration` of `/v1/server`
/// says so.
#[utoipa::path(
    delete, path = "/v1/demonstration", tag = "service",
    responses(
        (status = 204, description = "None is shown now"),
        (status = 409, description = "One of its cameras was given another training run meanwhile; repeat it", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn end_demonstration(CallerApp(app): CallerApp) -> ApiResult {
    app.end_demonstration().await?;
    Ok(empty())
}
