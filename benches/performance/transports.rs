//! Fusions over REST and gRPC, against bare handlers that parse and return the same messages.

use std::net::SocketAddr;
use std::time::Instant;

use axum::Router;
use axum::body::Bytes;
use axum::http::header::CONTENT_TYPE;
use axum::routing::post;
use serde::Deserialize;
use sightfix::domain::Observation;
use sightfix::exchange::wire;
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::fusion_service_server::{FusionService, FusionServiceServer};
use tokio::net::TcpListener;

use crate::load::{self, CONNECTIONS};
use crate::ratio::{self, in_turn};
use crate::served::{Served, runtime};

/// Requests of each connection in a round.
const EACH: usize = 2_000;

/// The body of a fusion request.
pub(crate) fn request_body(observations: &[Observation]) -> String {
    let items: Vec<_> = observations
        .iter()
        .map(|observation| {
            let bounding_box = observation.bounding_box.expect("a box");
            let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
            let fix = observation.fix.expect("a fix").position;
            serde_json::json!({
                "time": observation.time.to_string(),
                "target_id": observation.target_id.as_ref().map(|target| target.as_str()),
                "bounding_box":
                    {"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px},
                "fix": {"longitude_deg": fix.longitude_deg(), "latitude_deg": fix.latitude_deg()},
            })
        })
        .collect();
    serde_json::json!({ "observations": items }).to_string()
}

#[derive(Deserialize)]
struct BareRequest<'a> {
    #[serde(borrow)]
    observations: Vec<wire::Observation<'a>>,
}

/// A handler that parses the request and gives a made answer, under axum's own server.
async fn bare_axum(answer: Vec<wire::OwnedFusedFix>) -> SocketAddr {
    let answer = std::sync::Arc::new(answer);
    let handler = move |body: Bytes| {
        let answer = answer.clone();
        async move {
            let request: BareRequest<'_> = serde_json::from_slice(&body).expect("the bench's own request");
            assert_eq!(request.observations.len(), answer.len(), "an answer for each");
            let body = serde_json::to_vec(&serde_json::json!({}) ).expect("JSON");
            ([(CONTENT_TYPE, "application/json")], body)
        }
    };
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("an address");
    let router = Router::new().route("/v1/cameras/{camera}/fusions", post(handler));
    tokio::spawn(async move { axum::serve(listener, router).await });
    address
}
