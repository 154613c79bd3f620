//! `/v1/cameras/{camera}/picture`: a still picture of what the camera sees.

use axum::body::Body;
use axum::extract::Request;
use axum::response::Response;
use hyper::header::{CACHE_CONTROL, CONTENT_TYPE};
use hyper::http::HeaderValue;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::connect::fetch_snapshot;
use crate::domain::{Picture, PictureFormat};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::body;
use crate::http::plumbing::extract::{CameraPath, media_type, not_read};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::empty;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_picture, fetch_picture, set_picture, delete_picture))
}

/// A picture's file, as bytes.
#[derive(ToSchema)]
#[schema(value_type = String, format = Binary)]
#[expect(dead_code, reason = "for the description alone")]
struct PictureFile(Vec<u8>);

/// Show the picture of what a camera sees
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/picture", tag = "cameras",
    params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "The picture", content((PictureFile = "image/jpeg"), (PictureFile = "image/png"))),
        (status = 204, description = "Nobody has set one"),
    )
)]
async fn get_picture(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    Ok(app.pictures().get(&id).await?.map_or_else(empty, shown))
}

/// Fetch a new picture of what a camera sees
///
/// From the address `snapshot` of its profile. The picture is stored, and is the answer.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/picture", tag = "cameras",
    params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "The picture", content((PictureFile = "image/jpeg"), (PictureFile = "image/png"))),
        (status = 502, description = "The address gave no picture", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "There is no space for it", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn fetch_picture(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    Ok(shown(fetch_snapshot(&app, &id).await?))
}

fn shown(picture: Picture) -> Response {
    let content_type = HeaderValue::from_static(picture.format().media_type());
    let mut response = Response::new(Body::from(picture.into_content()));
    response.headers_mut().insert(CONTENT_TYPE, content_type);
    response.headers_mut().insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

/// Set the picture of what a camera sees
///
/// A JPEG or PNG of at most `limits.picture_bytes`. The console shows it under boxes; it takes no part in training.
#[utoipa::path(
    put, path = "/v1/cameras/{camera}/picture", tag = "cameras",
    params(("camera" = String, Path, description = "The camera's id")),
    request_body(content((PictureFile = "image/jpeg"), (PictureFile = "image/png"))),
    responses(
        (status = 204, description = "It is set"),
        (status = 507, description = "There is no space for it", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn set_picture(CallerApp(app): CallerApp, CameraPath(id): CameraPath, request: Request) -> ApiResult {
    let (parts, content) = request.into_parts();
    let readable = [PictureFormat::Jpeg, PictureFormat::Png];
    let given = media_type(&parts.headers);
    let format = readable.into_iter().find(|format| given == Some(format.media_type()));
    let format = format.ok_or_else(|| not_read(&readable.map(PictureFormat::media_type)))?;
    let content = body::whole(&parts.headers, content, app.limits.picture_bytes).await?;
    app.pictures().set(&id, Some(&Picture::new(format, content.into())?)).await?;
    Ok(empty())
}

/// Remove the picture of what a camera sees
#[utoipa::path(
    delete, path = "/v1/cameras/{camera}/picture", tag = "cameras",
    params(("camera" = String, Path, description = "The camera's id")),
    responses((status = 204, description = "There is none now"))
)]
async fn delete_picture(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    app.pictures().set(&id, None).await?;
    Ok(empty())
}
