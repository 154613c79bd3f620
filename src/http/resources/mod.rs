//! The resources, a file each: route, description and conversion together.

mod audit;
mod authority;
mod camera_statuses;
mod cameras;
mod connections;
mod console;
mod demonstration;
mod evaluations;
mod features;
mod fusions;
mod gnss_error;
mod heat_map;
mod history;
mod inference;
mod inference_body;
mod keys;
mod learning;
mod models;
mod nodes;
mod openid;
mod pairings;
mod pictures;
mod place_events;
mod places;
mod receivers;
mod runs;
mod samples;
mod server_info;
mod service;
pub(super) mod session;
mod site_training_runs;
mod sites;
mod tiles;
mod tracks;
mod training_runs;
mod world_tracks;

use axum::Router;
use utoipa_axum::router::OpenApiRouter;

use crate::config::Console;
use crate::http::plumbing::state::Rest;

pub use session::session_token;

/// All that the description names.
pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .merge(cameras::routes())
        .merge(camera_statuses::routes())
        .merge(pictures::routes())
        .merge(sites::routes())
        .merge(site_training_runs::routes())
        .merge(world_tracks::routes())
        .merge(places::routes())
        .merge(place_events::routes())
        .merge(connections::routes())
        .merge(samples::routes())
        .merge(pairings::routes())
        .merge(training_runs::routes())
        .merge(models::routes())
        .merge(fusions::routes())
        .merge(tracks::routes())
        .merge(history::routes())
        .merge(heat_map::routes())
        .merge(gnss_error::routes())
        .merge(evaluations::routes())
        .merge(inference::routes())
        .merge(features::routes())
        .merge(keys::routes())
        .merge(learning::routes())
        .merge(audit::routes())
        .merge(session::routes())
        .merge(openid::routes())
        .merge(nodes::routes())
        .merge(server_info::routes())
        .merge(demonstration::routes())
        .merge(tiles::routes())
        .merge(service::routes())
}

/// Probes and metrics.
pub(super) fn monitoring() -> OpenApiRouter<Rest> {
    service::routes()
}

/// The operator's console, and what a browser asks for beside it.
pub(super) fn pages(console: &Console) -> Router<Rest> {
    console::routes(console).merge(authority::routes()).merge(openid::callback())
}
