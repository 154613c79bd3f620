//! `/v1/nodes`: the processes that share the database.

use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::NodeStatus;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(list_nodes))
}

/// One run of a process.
#[derive(Serialize, ToSchema)]
struct Node {
    /// Its id, another one for every start.
    id: String,
    /// Where clients reach it; missing for workers, and where it is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "https://node-1.example.org:8443")]
    url: Option<String>,
    /// `both`, `serve` or `train`.
    #[schema(example = "serve")]
    role: String,
    /// The node's version of the program.
    #[schema(example = "0.1.0")]
    version: String,
    /// When it was started.
    #[schema(value_type = String, format = DateTime)]
    started_at: Timestamp,
    /// When it was heard of last, by the clock of the database.
    #[schema(value_type = String, format = DateTime)]
    seen_at: Timestamp,
    /// Seconds of silence after which another node takes its cameras over.
    lease_s: f64,
    /// True if the node is shutting down.
    is_draining: bool,
    /// Cameras whose live state it has.
    cameras: u64,
    /// True if it is the node that answers.
    is_this: bool,
}

impl From<NodeStatus> for Node {
    fn from(status: NodeStatus) -> Self {
        let NodeStatus { node, cameras, is_this } = status;
        Self {
            id: node.id.to_string(),
            url: node.profile.url,
            role: node.profile.role,
            version: node.profile.version,
            started_at: node.profile.started_at,
            seen_at: node.renewed_at,
            lease_s: node.profile.lease.as_secs_f64(),
            is_draining: node.is_draining,
            cameras,
            is_this,
        }
    }
}

/// The processes that share the database.
#[derive(Serialize, ToSchema)]
struct Nodes {
    /// By the time of their start.
    items: Vec<Node>,
}

/// List the processes that share the database
///
/// Those that are registered now, each with the number of cameras whose tracks, pairing and events it has. A server on a
/// data folder lists itself, as the owner of all cameras.
#[utoipa::path(
    get, path = "/v1/nodes", tag = "service",
    responses((status = 200, description = "Nodes, by the time of their start", body = Nodes))
)]
async fn list_nodes(CallerApp(app): CallerApp) -> ApiResult {
    let items = app.nodes().list().await?.into_iter().map(Into::into).collect();
    Ok(json(&Nodes { items })?)
}
