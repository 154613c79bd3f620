//! `/v1/cameras/{camera}/fusions`: positions of targets.

use axum::body::Body;
use axum::response::Response;
use hyper::HeaderMap;
use hyper::header::{CONTENT_TYPE, VARY};
use hyper::http::HeaderValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::App;
use crate::domain::{Error, Observation, Receivers, Result, convert_all};
use crate::exchange::{Format, RowRules, read_observation_features, read_observations, wire, write_fused};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{CameraPath, FormattedBody, negotiate};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json_of_about;

/// The formats from which observations are read, and in which positions are written.
const FORMATS: [Format; 4] = [Format::Json, Format::Csv, Format::Ndjson, Format::GeoJson];
/// Typical size of a fused position as JSON, to reserve memory.
const ITEM_BYTES: usize = 800;

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
    #[serde(borrow)]
    receiver_id: Option<wire::Text<'a>>,
    #[serde(borrow)]
    tracker_id: Option<wire::Text<'a>>,
    bounding_box: Option<wire::BoundingBox>,
    fix: Option<wire::Fix>,
    #[serde(borrow)]
    class: Option<wire::Text<'a>>,
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
    /// The fused positions.
    items: Vec<wire::FusedFix<'a>>,
}

/// Fuse observations into positions
///
/// The body is one observation, or an object with the array `observations`. Each has a box, a fix,
/// or both: without a fix the position comes from the box alone, without a box the fix passes
/// through. All are answered by the same model version.
///
/// Observations also come as CSV or NDJSON, in the columns and fields of samples, or as a GeoJSON feature
/// collection whose properties are those fields and whose points are fixes. The positions are written as the
/// header `accept` asks. If any observation is at fault, nothing is answered but the faults.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/fusions", tag = "fusion", params(("camera" = String, Path, description = "The camera's id")),
    request_body(content(
        (FusionRequest = "application/json"),
        (String = "text/csv", example = "time,target_id,left,top,width,height\n2020-12-14T14:41:48+08:00,person-1,475,11,28,77\n"),
        (String = "application/x-ndjson", example = "{\"time\":\"2020-12-14T14:41:48+08:00\",\"target_id\":\"person-1\",\"bounding_box\":{\"left_px\":475,\"top_px\":11,\"width_px\":28,\"height_px\":77}}\n"),
        (Object = "application/geo+json"),
    )),
    responses(
        (status = 200, description = "Positions", content(
            (Fusions<'static> = "application/json"),
            (String = "text/csv"), (String = "application/x-ndjson"), (Object = "application/geo+json"),
        )),
        (status = 406, description = "None of the accepted types can be written", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn fuse(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    headers: HeaderMap,
    body: FormattedBody,
) -> ApiResult<Response> {
    let written = negotiate(&headers, &FORMATS.map(|format| (format.media_type(), format)))?;
    let camera = app.active_camera(&id).await?;
    let rules = camera.row_rules(app.clock.now());
    let observations = match &body {
        FormattedBody::Json(json) => observations(&app, &json.read()?, &rules, &camera.receivers)?,
        FormattedBody::Rows(rows, format) => observed_rows(&app, rows, *format, &rules)?,
    };
    let fused = app.fusion().fuse(camera, &observations).await?;
    let mut response = match written {
        Format::Json => {
            let items = fused.iter().map(wire::FusedFix::from).collect();
            json_of_about(&Fusions { items }, 64 + ITEM_BYTES * fused.len())?
        }
        format => {
            let file = write_fused(Vec::with_capacity(64 + ITEM_BYTES * fused.len()), format, &fused);
            let mut response = Response::new(Body::from(file.map_err(Error::fault)?));
            let content_type = HeaderValue::from_static(format.media_type());
            response.headers_mut().insert(CONTENT_TYPE, content_type);
            response
        }
    };
    response.headers_mut().insert(VARY, HeaderValue::from_static("accept"));
    Ok(response)
}

/// Observations of a file; a fault of one refuses them all.
fn observed_rows(app: &App, content: &[u8], format: Format, rules: &RowRules) -> Result<Vec<Observation>> {
    if format == Format::GeoJson {
        return read_observation_features(content, rules);
    }
    // Reads at most limit + 1 observations, to detect an oversized batch.
    let rows = read_observations(content, format, rules)?.take(app.limits.batch_observations + 1);
    let rows = rows.collect::<Result<Vec<_>>>()?;
    app.limits.check_batch(rows.len())?;
    let faults = rows.iter().filter_map(|row| row.as_ref().err());
    let violations = faults.map(|row| (format!("line {}: {}", row.line, row.field), row.reason.clone()));
    Error::check_all("nothing was done, for the rows at fault", violations)?;
    Ok(rows.into_iter().flatten().map(|row| row.observation).collect())
}

pub(super) fn observations(
    app: &App,
    request: &Request<'_>,
    rules: &RowRules,
    receivers: &Receivers,
) -> Result<Vec<Observation>> {
    let RowRules { time_bounds, image_size } = rules;
    let Some(batch) = &request.observations else {
        let one = wire::Observation {
            time: request.time.clone().ok_or_else(|| Error::invalid("time", "is required"))?,
            target_id: request.target_id.clone(),
            receiver_id: request.receiver_id.clone(),
            tracker_id: request.tracker_id.clone(),
            bounding_box: request.bounding_box,
            fix: request.fix,
            class: request.class.clone(),
        };
        return Ok(vec![one.to_domain(time_bounds, *image_size, receivers)?]);
    };
    let beside = [
        ("time", request.time.is_some()),
        ("target_id", request.target_id.is_some()),
        ("receiver_id", request.receiver_id.is_some()),
        ("tracker_id", request.tracker_id.is_some()),
        ("bounding_box", request.bounding_box.is_some()),
        ("fix", request.fix.is_some()),
        ("class", request.class.is_some()),
    ];
    if let Some((field, _)) = beside.into_iter().find(|(_, given)| *given) {
        return Err(Error::invalid(field, "belongs into one of the observations"));
    }
    app.limits.check_batch(batch.len())?;
    convert_all("observations", batch, |observation| {
        observation.to_domain(time_bounds, *image_size, receivers)
    })
}
