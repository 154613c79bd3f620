//! Fusions over REST and gRPC, against bare handlers that parse and return the same messages.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::body::Bytes;
use axum::http::header::CONTENT_TYPE;
use axum::routing::post;
use serde::Deserialize;
use serde_json::Value;
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
            let bounding_box = observation.bounding_box().expect("a box");
            let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
            let fix = observation.fix().expect("a fix").position;
            serde_json::json!({
                "time": observation.time().to_string(),
                "target_id": observation.target_id().map(|target| target.as_str()),
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

/// A handler that parses the request and writes a given answer, under axum's own server.
async fn bare_axum(answer: Value) -> SocketAddr {
    let answer = Arc::new(answer);
    let handler = move |body: Bytes| {
        let answer = answer.clone();
        async move {
            let request: BareRequest<'_> = serde_json::from_slice(&body).expect("the bench's own request");
            assert!(!request.observations.is_empty(), "something is asked");
            ([(CONTENT_TYPE, "application/json")], serde_json::to_vec(&*answer).expect("JSON"))
        }
    };
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("an address");
    let router = Router::new().route("/v1/cameras/{camera}/fusions", post(handler));
    tokio::spawn(async move { axum::serve(listener, router.into_make_service()).await });
    address
}

/// REST with 1 and with 32 observations in a request.
pub(crate) fn http() {
    let runtime = runtime();
    let served = runtime.block_on(Served::start());
    ratio::head("REST: POST .../fusions, compared with a bare axum handler of the same JSON", "items/s");
    for items in [1, 32] {
        let body = request_body(&served.observations[..items]);
        let request =
            load::post(&format!("/v1/cameras/{}/fusions", served.camera), "application/json", &body);
        let answer = runtime.block_on(load::one(served.address, &request));
        let answer: Value = serde_json::from_slice(&answer).expect("JSON");
        let bare = runtime.block_on(bare_axum(answer));
        let rate = |address| {
            let (rate, _) = runtime.block_on(load::send(address, &request, EACH));
            rate * items as f64
        };
        let ratio = in_turn(|| rate(served.address), || rate(bare));
        ratio::row(&format!("{items} per request"), &ratio);
    }
    served.end();
}

/// A service that gives a made answer, under tonic's own server.
struct Bare(proto::FuseResponse);

#[tonic::async_trait]
impl FusionService for Bare {
    type StreamStream = futures_util::stream::Empty<Result<proto::StreamResponse, tonic::Status>>;

    async fn stream(
        &self,
        _: tonic::Request<tonic::Streaming<proto::StreamRequest>>,
    ) -> Result<tonic::Response<Self::StreamStream>, tonic::Status> {
        Err(tonic::Status::unimplemented("unary only"))
    }

    async fn fuse(
        &self,
        request: tonic::Request<proto::FuseRequest>,
    ) -> Result<tonic::Response<proto::FuseResponse>, tonic::Status> {
        assert!(!request.into_inner().observations.is_empty(), "something is asked");
        Ok(tonic::Response::new(self.0.clone()))
    }
}

async fn bare_tonic(answer: proto::FuseResponse) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("an address");
    let incoming = tonic::transport::server::TcpIncoming::from(listener).with_nodelay(Some(true));
    let server = tonic::transport::Server::builder().add_service(FusionServiceServer::new(Bare(answer)));
    tokio::spawn(async move { server.serve_with_incoming(incoming).await });
    address
}

type Client = FusionServiceClient<tonic::transport::Channel>;

async fn connect(address: SocketAddr) -> Client {
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{address}")).expect("a URI");
    FusionServiceClient::new(endpoint.tcp_nodelay(true).connect().await.expect("the server listens"))
}

/// Unary gRPC.
pub(crate) fn grpc() {
    let runtime = runtime();
    let served = runtime.block_on(Served::start());
    ratio::head("gRPC: unary Fuse, compared with a bare tonic handler of the same messages", "items/s");
    for items in [1, 32] {
        let request = proto_request(&served, items);
        let answer = runtime.block_on(async {
            connect(served.address).await.fuse(request.clone()).await.expect("an answer").into_inner()
        });
        let bare = runtime.block_on(bare_tonic(answer));
        let rate = |address| runtime.block_on(calls(address, &request)) * items as f64;
        let ratio = in_turn(|| rate(served.address), || rate(bare));
        ratio::row(&format!("{items} per request"), &ratio);
    }
    served.end();
}

fn proto_request(served: &Served, items: usize) -> proto::FuseRequest {
    let observations = served.observations[..items]
        .iter()
        .map(|observation| {
            let [left_px, top_px, width_px, height_px] =
                observation.bounding_box().expect("a box").sides_px().map(Some);
            let fix = observation.fix().expect("a fix").position;
            proto::Observation {
                time: Some(prost_types::Timestamp {
                    seconds: observation.time().as_second(),
                    nanos: observation.time().subsec_nanosecond(),
                }),
                target_id: observation.target_id().map(ToString::to_string),
                bounding_box: Some(proto::BoundingBox { left_px, top_px, width_px, height_px }),
                fix: Some(proto::Fix {
                    longitude_deg: Some(fix.longitude_deg()),
                    latitude_deg: Some(fix.latitude_deg()),
                    sigma_m: None,
                }),
            }
        })
        .collect();
    proto::FuseRequest { camera_id: served.camera.to_string(), observations }
}

/// Calls per second over as many connections as the REST load has.
async fn calls(address: SocketAddr, request: &proto::FuseRequest) -> f64 {
    let began = Instant::now();
    let mut clients = tokio::task::JoinSet::new();
    for _ in 0..CONNECTIONS {
        let request = request.clone();
        clients.spawn(async move {
            let mut client = connect(address).await;
            for _ in 0..EACH {
                client.fuse(request.clone()).await.expect("an answer");
            }
        });
    }
    clients.join_all().await;
    (CONNECTIONS * EACH) as f64 / began.elapsed().as_secs_f64()
}
