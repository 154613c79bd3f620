//! `/v1/cameras/{camera}/fusions`: positions of targets.

use axum::response::Response;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Rest;
use super::access::CallerApp;
use super::extract::{CameraPath, JsonBody};
use super::problem::{ApiResult, Problem};
use super::wire::json_of_about;
use crate::app::App;
use crate::domain::{Error, Observation, Result, convert_all};
use crate::exchange::{RowRules, wire};

/// Typical size of a fused position as JSON, to reserve memory.
const ITEM_BYTES: usize = 640;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(fuse))
}

/// One observation as it is, or many as `observations`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Request<'a> {
    #[serde(borrow)]
    observations: Option<Vec<wire::Observation<'a>>>,
    #[serde(borrow)]
    time: Option<wire::Text<'a>>,
    #[serde(borrow)]
    target_id: Option<wire::Text<'a>>,
    bounding_box: Option<wire::BoundingBox>,
    fix: Option<wire::Fix>,
}

/// Observations of one camera.
#[derive(ToSchema)]
#[expect(dead_code, reason = "the shape of a batch, for the description alone")]
pub(super) struct Batch {
    /// Boxes, fixes, or both.
    #[schema(min_items = 1)]
    observations: Vec<wire::Observation<'static>>,
}

/// One observation, or a batch of them.
#[derive(ToSchema)]
#[schema(title = "FusionRequest")]
#[serde(untagged)]
#[expect(dead_code, reason = "the shape of a request, for the description alone")]
pub(super) enum FusionRequest {
    One(wire::Observation<'static>),
    Many(Batch),
}

/// One answer per observation, in their order.
#[derive(Serialize, ToSchema)]
struct Fusions<'a> {
    /// Positions.
    items: Vec<wire::FusedFix<'a>>,
}

/// Fuse observations into positions
///
/// The body is one observation, or an object with the array `observations`. Each has a box, a fix,
/// or both: without a fix the position comes from the box alone, without a box the fix passes
/// through. All are answered by the same model version.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/fusions", tag = "fusion", params(("camera" = String, Path, description = "The camera's id")),
    request_body = FusionRequest,
    responses(
        (status = 200, description = "Positions", body = Fusions<'static>),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn fuse(CallerApp(app): CallerApp, CameraPath(id): CameraPath, body: JsonBody) -> ApiResult<Response> {
    let camera = app.active_camera(&id).await?;
    let rules = camera.row_rules(app.clock.now());
    let observations = observations(&app, &body.read()?, &rules)?;
    let fused = app.fuse(camera, &observations).await?;
    let items = fused.iter().map(wire::FusedFix::from).collect();
    Ok(json_of_about(&Fusions { items }, 64 + ITEM_BYTES * fused.len())?)
}

pub(super) fn observations(app: &App, request: &Request<'_>, rules: &RowRules) -> Result<Vec<Observation>> {
    let RowRules { time_bounds, image_size } = rules;
    let Some(batch) = &request.observations else {
        let one = wire::Observation {
            time: request.time.clone().ok_or_else(|| Error::invalid("time", "is required"))?,
            target_id: request.target_id.clone(),
            bounding_box: request.bounding_box,
            fix: request.fix,
        };
        return Ok(vec![one.to_domain(time_bounds, *image_size)?]);
    };
    let beside = [
        ("time", request.time.is_some()),
        ("target_id", request.target_id.is_some()),
        ("bounding_box", request.bounding_box.is_some()),
        ("fix", request.fix.is_some()),
    ];
    if let Some((field, _)) = beside.into_iter().find(|(_, given)| *given) {
        return Err(Error::invalid(field, "belongs into one of the observations"));
    }
    app.check_batch(batch.len())?;
    convert_all("observations", batch, |observation| observation.to_domain(time_bounds, *image_size))
}
