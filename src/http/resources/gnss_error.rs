//! `/v1/cameras/{camera}/gnss-error`: a receiver's error from many fixes at one fixed point.

use axum::extract::Request;
use axum::response::Response;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::samples::RejectedRow;
use crate::app::{GnssErrorEstimate, Spooled};
use crate::domain::{Error, Result};
use crate::exchange::{FixFormat, RowError, TimedFix, read_fixes, wire};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::body;
use crate::http::plumbing::extract::{CameraPath, media_type, not_read};
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(estimate_gnss_error))
}

/// Fixes of a receiver that stood still.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct Fixes {
    /// At least ten.
    #[schema(min_items = 10)]
    fixes: Vec<wire::Fix>,
}

/// The error of a receiver, estimated from its fixes.
#[derive(Serialize, ToSchema)]
struct Estimate {
    /// Fixes that were read.
    fixes: u64,
    /// Their mean position.
    mean: wire::Position,
    /// Variance of the east component.
    east_variance_m2: f64,
    /// Variance of the north component.
    north_variance_m2: f64,
    /// The mean of the two, per axis.
    e_gnss_m2: f64,
    /// Its square root, for the camera's `gnss_error`.
    sigma_m: f64,
    /// Mean distance from the mean position.
    mean_distance_m: f64,
    /// Rows that are no fix.
    rejected: u64,
    /// The first 100 of these.
    rejected_rows: Vec<RejectedRow>,
}

/// Estimate a receiver's error
///
/// From fixes taken while the receiver stood still: CSV with the columns `longitude` and
/// `latitude`, NMEA 0183 with GGA sentences, or JSON. Nothing is stored: `sigma_m` goes into the
/// camera's `gnss_error`.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/gnss-error", tag = "cameras", params(("camera" = String, Path, description = "The camera's id")),
    request_body(content((String = "text/csv"), (String = "text/plain"), (Fixes = "application/json"))),
    responses((status = 200, description = "The receiver's error", body = Estimate))
)]
async fn estimate_gnss_error(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    request: Request,
) -> ApiResult<Response> {
    let (parts, content) = request.into_parts();
    let time_bounds = app.samples().row_rules(&id).await?.time_bounds;
    let limits = &app.limits;
    let source = match media_type(&parts.headers) {
        Some("application/json") => {
            let json = body::whole(&parts.headers, content, limits.body_bytes).await?;
            let Fixes { fixes } = wire::parse_json(&json)?;
            FixSource::Given(fixes)
        }
        given => {
            let format = given.and_then(FixFormat::from_media_type);
            let format = format.ok_or_else(|| not_read(&["text/csv", "text/plain", "application/json"]))?;
            FixSource::File(body::spooled(&app, &parts, content).await?, format)
        }
    };
    let tell_at_most = limits.rejected_rows;
    let estimating = tokio::task::spawn_blocking(move || match source {
        FixSource::Given(fixes) => from_given(&fixes, tell_at_most),
        FixSource::File(file, format) => {
            GnssErrorEstimate::from_rows(read_fixes(file, format, time_bounds)?, tell_at_most)
        }
    });
    Ok(json(&estimate(estimating.await.map_err(Error::fault)??))?)
}

enum FixSource {
    Given(Vec<wire::Fix>),
    File(Spooled, FixFormat),
}

fn from_given(fixes: &[wire::Fix], tell_at_most: usize) -> Result<GnssErrorEstimate> {
    let rows = (1..).zip(fixes).map(|(line, given)| match given.to_domain() {
        Ok(fix) => Ok(Ok(TimedFix { time: None, fix })),
        Err(error) => RowError::of(line, error).map(Err),
    });
    GnssErrorEstimate::from_rows(rows, tell_at_most)
}

fn estimate(estimate: GnssErrorEstimate) -> Estimate {
    Estimate {
        fixes: estimate.fixes,
        mean: estimate.mean.into(),
        east_variance_m2: estimate.east_variance_m2,
        north_variance_m2: estimate.north_variance_m2,
        e_gnss_m2: estimate.e_gnss_m2,
        sigma_m: estimate.sigma_m,
        mean_distance_m: estimate.mean_distance_m,
        rejected: estimate.rejected,
        rejected_rows: estimate.rejected_rows.into_iter().map(RejectedRow::from).collect(),
    }
}
