//! `/v1/history/heat-map`: where targets spent their time.

use axum::response::Response;
use hyper::Uri;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::history::{SelectionParams, selection};
use crate::app::{HeatCell, HeatMap};
use crate::domain::{Error, Result};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::Params;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::geojson;

/// Extent of a cell unless one is asked for, m.
const CELL_M: f64 = 1.0;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_heat_map))
}

/// Cells on the ground as GeoJSON.
#[derive(Serialize, ToSchema)]
struct HeatMapFeatures {
    #[schema(inline)]
    r#type: FeatureCollection,
    /// Extent of a cell.
    cell_m: f64,
    /// Cells where targets were, from south to north and from west to east.
    features: Vec<HeatFeature>,
}

/// A kind of GeoJSON object.
#[derive(Serialize, ToSchema)]
enum FeatureCollection {
    FeatureCollection,
}

/// A kind of GeoJSON object.
#[derive(Serialize, ToSchema)]
enum Feature {
    Feature,
}

/// A kind of GeoJSON geometry.
#[derive(Serialize, ToSchema)]
enum Polygon {
    Polygon,
}

/// One cell.
#[derive(Serialize, ToSchema)]
struct HeatFeature {
    #[schema(inline)]
    r#type: Feature,
    geometry: CellOutline,
    properties: CellHeat,
}

/// The outline of a cell.
#[derive(Serialize, ToSchema)]
struct CellOutline {
    #[schema(inline)]
    r#type: Polygon,
    /// One closed ring of longitudes and latitudes, degrees.
    coordinates: [[[f64; 2]; 5]; 1],
}

/// The figures of a cell.
#[derive(Serialize, ToSchema)]
struct CellHeat {
    /// Time that all targets together spent there.
    seconds: f64,
    /// How often a track came into it.
    visits: u64,
}

impl From<&HeatCell> for HeatFeature {
    fn from(cell: &HeatCell) -> Self {
        let [west, south] = [cell.south_west.longitude_deg(), cell.south_west.latitude_deg()];
        let [east, north] = [cell.north_east.longitude_deg(), cell.north_east.latitude_deg()];
        let ring = [[west, south], [east, south], [east, north], [west, north], [west, south]];
        Self {
            r#type: Feature::Feature,
            geometry: CellOutline { r#type: Polygon::Polygon, coordinates: [ring] },
            properties: CellHeat { seconds: cell.seconds, visits: cell.visits },
        }
    }
}

/// Show where targets spent their time
///
/// The positions of a selection of the history in a grid on the ground, as GeoJSON. A position stands for the time until the
/// next one of its track.
#[utoipa::path(
    get, path = "/v1/history/heat-map", tag = "history",
    params(
        SelectionParams,
        ("cell_m" = Option<f64>, Query, minimum = 0.1, maximum = 10_000.0, description = "Extent of a cell, m; 1 if left out"),
    ),
    responses(
        (status = 200, description = "Cells where targets were", body = HeatMapFeatures, content_type = "application/geo+json"),
        (status = 404, description = "No such camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_heat_map(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let (scope, selection) = selection(&mut params)?;
    let cell_m = params.take("cell_m", |text| {
        text.parse().map_err(|_| Error::invalid("cell_m", "must be a number of metres"))
    })?;
    params.end()?;
    let map = app.history().heat_map(scope, selection, cell_m.unwrap_or(CELL_M)).await?;
    Ok(features(&map)?)
}

fn features(map: &HeatMap) -> Result<Response> {
    geojson(&HeatMapFeatures {
        r#type: FeatureCollection::FeatureCollection,
        cell_m: map.cell_m,
        features: map.cells.iter().map(Into::into).collect(),
    })
}
