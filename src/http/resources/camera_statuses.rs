//! `/v1/camera-statuses`: all cameras at a glance.

use hyper::Uri;
use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::cameras::Camera;
use crate::app::{self, App};
use crate::exchange::{wire, write_cursor};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::Params;
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{JobState, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(list_camera_statuses))
}

/// A camera with its latest run, its model and what happens in its view.
#[derive(Serialize, ToSchema)]
struct CameraStatus {
    /// The profile, with the number of its samples.
    camera: Camera,
    /// The latest training run.
    #[serde(skip_serializing_if = "Option::is_none")]
    latest_run: Option<LatestRun>,
    /// The active model, if it can be used.
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<ModelSummary>,
    /// Targets that are tracked now.
    targets: usize,
    /// Open live streams.
    streams: usize,
    /// When a live observation came last, by the server's clock; missing if none came since the server was
    /// started.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    last_observed_at: Option<Timestamp>,
    /// Since when every live box has been frozen, by the server's clock: the same to the pixel for longer than a standing
    /// target shows. The picture or the detector stands still.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    frozen_since: Option<Timestamp>,
}

/// The latest training run of a camera.
#[derive(Serialize, ToSchema)]
struct LatestRun {
    /// The run's id.
    #[schema(format = "uuid")]
    id: String,
    /// State of the run.
    state: JobState,
}

/// How well the active model does, and where.
#[derive(Serialize, ToSchema)]
struct ModelSummary {
    /// Mean horizontal distance from the regressed position to the fix on held-out samples, m; missing if the
    /// samples formed too few blocks.
    #[serde(skip_serializing_if = "Option::is_none")]
    held_out_mean_to_fix_m: Option<f64>,
    /// Median 95 % radius of a position from a box alone, over the boxes that the training covers, m.
    median_r95_m: f64,
    /// Corners of the area on the ground that the training covers, counterclockwise.
    view_area: Vec<wire::Position>,
}

impl From<&app::ModelSummary> for ModelSummary {
    fn from(summary: &app::ModelSummary) -> Self {
        Self {
            held_out_mean_to_fix_m: summary.held_out.as_ref().map(|held_out| held_out.mean_to_fix_m),
            median_r95_m: summary.view_area().median_r95_m,
            view_area: summary.view_area().hull.iter().copied().map(Into::into).collect(),
        }
    }
}

impl CameraStatus {
    fn of(app: &App, status: app::CameraStatus) -> Self {
        let app::CameraStatus { camera, latest_run, model_summary, activity } = status;
        Self {
            camera: Camera::of(app, camera),
            latest_run: latest_run.map(|(run, state)| LatestRun { id: run.to_string(), state: state.into() }),
            model: model_summary.as_deref().map(Into::into),
            targets: activity.targets,
            streams: activity.streams,
            last_observed_at: activity.last_observed_at,
            frozen_since: activity.frozen_since,
        }
    }
}

/// A page of statuses, by camera id.
#[derive(Serialize, ToSchema)]
struct CameraStatusPage {
    /// A page of statuses.
    items: Vec<CameraStatus>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// List the statuses of all cameras by id
///
/// Each is the camera's profile with its latest training run, its model's error and area, and what happens in
/// its view.
#[utoipa::path(
    get, path = "/v1/camera-statuses", tag = "cameras",
    params(
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of statuses", body = CameraStatusPage))
)]
async fn list_camera_statuses(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.cursor()?;
    params.end()?;
    let page = app.camera_statuses().list(after.as_ref(), limit).await?;
    Ok(json(&CameraStatusPage {
        items: page.items.into_iter().map(|status| CameraStatus::of(&app, status)).collect(),
        next_cursor: page.next.map(|id| write_cursor(&id)),
    })?)
}
