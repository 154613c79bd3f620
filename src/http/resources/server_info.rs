//! `/v1/server`: what the server is, and what it allows.

use std::collections::BTreeMap;

use axum::extract::State;
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::tiles::TILES_PATH;
use crate::config::Console;
use crate::domain::Error;
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_server))
}

/// Version and limits of the server, and the map tiles of the console.
#[derive(Serialize, ToSchema)]
struct Server {
    /// Version of the program.
    #[schema(example = "0.1.0")]
    version: &'static str,
    /// The limits in force, by the name of the setting below `limits`.
    #[schema(value_type = BTreeMap<String, f64>)]
    limits: BTreeMap<String, Value>,
    /// True while the server shows its demonstration: what it answers is simulated.
    demonstration: bool,
    /// Map tiles that the operator's console may show, if they are set.
    #[serde(skip_serializing_if = "Option::is_none")]
    tiles: Option<Tiles>,
    /// Map tiles of another server that the console offers to its user, who must agree first.
    #[serde(skip_serializing_if = "Option::is_none")]
    offered_tiles: Option<Tiles>,
}

/// How map tiles are stored.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum TileFormat {
    /// An image per tile, each under a URL of its own.
    Images,
    /// One file that is read by ranges of bytes (PMTiles, version 3).
    Pmtiles,
}

/// Map tiles.
#[derive(Serialize, ToSchema)]
struct Tiles {
    /// Where they are: with `{z}`, `{x}` and `{y}` for images, without for a PMTiles file.
    url: String,
    /// How they are stored there.
    format: TileFormat,
    /// The attribution that their provider asks for.
    attribution: String,
}

/// Read what the server is and what it allows
#[utoipa::path(
    get, path = "/v1/server", tag = "service",
    responses((status = 200, description = "Version, limits and map tiles", body = Server))
)]
async fn get_server(State(rest): State<Rest>) -> ApiResult {
    let limits = serde_json::to_value(&rest.app.limits).and_then(serde_json::from_value);
    let mut limits: BTreeMap<String, Value> = limits.map_err(Error::fault)?;
    // The others are policies, such as `sample_overflow`.
    limits.retain(|_, value| value.is_number());
    let offered_tiles = rest.console.offered_tiles().map(|(url, attribution)| Tiles {
        url: url.to_owned(),
        format: TileFormat::Images,
        attribution: attribution.to_owned(),
    });
    let (version, tiles) = (env!("CARGO_PKG_VERSION"), tiles_of(&rest.console));
    let demonstration = rest.app.demonstration.is_shown();
    Ok(json(&Server { version, limits, demonstration, tiles, offered_tiles })?)
}

fn tiles_of(settings: &Console) -> Option<Tiles> {
    let (url, format) = match (&settings.tile_url, &settings.tile_file) {
        (Some(url), _) => (url.clone(), TileFormat::Images),
        (None, Some(_)) => (TILES_PATH.to_owned(), TileFormat::Pmtiles),
        (None, None) => return None,
    };
    Some(Tiles { url, format, attribution: settings.tile_attribution.clone().unwrap_or_default() })
}
