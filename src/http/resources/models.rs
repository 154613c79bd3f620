//! `/v1/cameras/{camera}/models` and `.../active-model`: what training runs yield.

use axum::body::Body;
use axum::extract::Request;
use axum::response::Response;
use hyper::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use hyper::http::HeaderValue;
use hyper::{StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::domain::{self, Error, ModelFormat, ModelMetadata};
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::body;
use crate::http::plumbing::extract::{CameraPath, JsonBody, ModelPath, Params, media_type, not_read};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{created, empty, json};

/// Weights with the metadata in their header.
const SAFETENSORS: &str = "application/vnd.safetensors";
const OCTET_STREAM: &str = "application/octet-stream";

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(list_models, import_model))
        .routes(routes!(get_model, delete_model))
        .routes(routes!(download_model))
        .routes(routes!(get_active_model, activate_model))
        .routes(routes!(roll_back_model))
}

/// An immutable model of one camera.
#[derive(Serialize, ToSchema)]
struct ModelVersion {
    /// The camera of the model.
    camera_id: String,
    /// Counts from 1 per camera.
    number: u32,
    /// The run that yielded it; missing if it was imported.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = "uuid")]
    run_id: Option<String>,
    /// When it was stored.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// Size of the weights.
    weights_bytes: u64,
    /// The version's own description.
    metadata: ModelMetadata,
}

impl From<domain::ModelVersion> for ModelVersion {
    fn from(model: domain::ModelVersion) -> Self {
        Self {
            camera_id: model.camera_id.as_str().to_owned(),
            number: model.number,
            run_id: model.run_id.map(|run| run.to_string()),
            created_at: model.created_at,
            weights_bytes: model.weights_bytes,
            metadata: model.metadata,
        }
    }
}

/// A page of model versions, newest first.
#[derive(Serialize, ToSchema)]
struct ModelPage {
    /// A page of versions.
    items: Vec<ModelVersion>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Which version shall answer.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Activation {
    /// Number of the version.
    #[schema(minimum = 1, example = 1)]
    number: u32,
}

/// List model versions, newest first
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/models", tag = "models",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of versions", body = ModelPage))
)]
async fn list_models(CallerApp(app): CallerApp, CameraPath(id): CameraPath, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let before = params.cursor()?;
    params.end()?;
    let page = app.models().list(&id, before, limit).await?;
    Ok(json(&ModelPage {
        items: page.items.into_iter().map(ModelVersion::from).collect(),
        next_cursor: page.next.map(|number| write_cursor(&number)),
    })?)
}

/// Inspect a model version
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/models/{model}", tag = "models",
    params(("camera" = String, Path, description = "The camera's id"), ("model" = u32, Path, description = "The version's number")),
    responses((status = 200, description = "The version", body = ModelVersion))
)]
async fn get_model(CallerApp(app): CallerApp, ModelPath(id, number): ModelPath) -> ApiResult {
    Ok(json(&ModelVersion::from(app.models().get(&id, number).await?))?)
}

/// Delete a model version
///
/// The active version cannot be deleted. The number of a deleted version is never assigned again.
#[utoipa::path(
    delete, path = "/v1/cameras/{camera}/models/{model}", tag = "models",
    params(("camera" = String, Path, description = "The camera's id"), ("model" = u32, Path, description = "The version's number")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 409, description = "The version is active", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_model(CallerApp(app): CallerApp, ModelPath(id, number): ModelPath) -> ApiResult {
    app.models().delete(&id, number).await?;
    Ok(empty())
}

/// A model's file, as bytes.
#[derive(ToSchema)]
#[schema(value_type = String, format = Binary)]
#[expect(dead_code, reason = "for the description alone")]
struct ModelFile(Vec<u8>);

/// The format of a model version's file.
#[derive(ToSchema)]
#[schema(rename_all = "snake_case")]
#[expect(dead_code, reason = "for the description alone")]
enum FileFormat {
    /// Weights and metadata, for import on another server.
    Safetensors,
    /// A graph for other runtimes.
    Onnx,
}

/// Download a model version
///
/// A safetensors file: the weights, and the metadata in its header. It can be imported on another
/// server. With `format=onnx` an ONNX graph (operators of version 18, float64) for other runtimes: the input `boxes`
/// has a row of left, top, width and height in pixels per box; the outputs are `position_m` (east, north of the origin
/// in the metadata), `position_deg`, `covariance_m2`, `r95_m` and `outside_training`, as the service answers a box
/// alone. It cannot be imported.
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/models/{model}/file", tag = "models",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("model" = u32, Path, description = "The version's number"),
        ("format" = inline(Option<FileFormat>), Query, description = "`safetensors` if left out"),
    ),
    responses((status = 200, description = "The file", content(
        (ModelFile = "application/vnd.safetensors"), (ModelFile = "application/octet-stream"),
    )))
)]
async fn download_model(CallerApp(app): CallerApp, ModelPath(id, number): ModelPath, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let format = params.take("format", str::parse)?.unwrap_or_default();
    params.end()?;
    let mut response = Response::new(Body::from(app.models().download(&id, number, format).await?));
    let name = format!("attachment; filename=\"{id}-{number}.{format}\"");
    let content_type = match format {
        ModelFormat::Safetensors => SAFETENSORS,
        // ONNX has no registered media type.
        ModelFormat::Onnx => OCTET_STREAM,
    };
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
    headers.insert(CONTENT_DISPOSITION, HeaderValue::from_str(&name).map_err(Error::fault)?);
    Ok(response)
}

/// Import a model version
///
/// From a file that a download gave, here or on another server. It does not become active by
/// itself.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/models", tag = "models", params(("camera" = String, Path, description = "The camera's id")),
    request_body(content((ModelFile = "application/vnd.safetensors"), (ModelFile = "application/octet-stream"))),
    responses((status = 201, description = "The stored version", body = ModelVersion, headers(("location" = String, description = "Its path"))))
)]
async fn import_model(CallerApp(app): CallerApp, CameraPath(id): CameraPath, request: Request) -> ApiResult {
    let (parts, content) = request.into_parts();
    let readable = [SAFETENSORS, OCTET_STREAM];
    if !media_type(&parts.headers).is_some_and(|given| readable.contains(&given)) {
        return Err(not_read(&readable).into());
    }
    let file = body::whole(&parts.headers, content, app.limits.body_bytes).await?;
    let model = app.models().import(&id, &file).await?;
    let location = format!("/v1/cameras/{id}/models/{}", model.number);
    Ok(created(StatusCode::CREATED, &location, &ModelVersion::from(model))?)
}

/// Inspect the active model version
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/active-model", tag = "models", params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "The version that answers", body = ModelVersion),
        (status = 409, description = "No version is active", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_active_model(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    Ok(json(&ModelVersion::from(app.models().active(&id).await?))?)
}

/// Activate a model version
#[utoipa::path(
    put, path = "/v1/cameras/{camera}/active-model", tag = "models", params(("camera" = String, Path, description = "The camera's id")),
    request_body = Activation,
    responses((status = 200, description = "The version that answers now", body = ModelVersion))
)]
async fn activate_model(CallerApp(app): CallerApp, CameraPath(id): CameraPath, body: JsonBody) -> ApiResult {
    let Activation { number } = body.read()?;
    app.models().activate(&id, number).await?;
    Ok(json(&ModelVersion::from(app.models().get(&id, number).await?))?)
}

/// Roll back to the version that answered before
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/active-model/roll-back", tag = "models", params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "The version that answers now", body = ModelVersion),
        (status = 409, description = "No version answered before", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn roll_back_model(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    app.models().roll_back(&id).await?;
    Ok(json(&ModelVersion::from(app.models().active(&id).await?))?)
}
