//! The behaviour of any gRPC server to its clients, and a server for these tests.

use std::net::SocketAddr;
use std::time::Duration;

use futures_util::stream;
use hyper::http::HeaderValue;
use hyper::http::uri::Scheme;
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo};
use sightfix::app::App;
use sightfix::app::access::{Caller, Principal};
use sightfix::clock::{Clock, Randomness};
use sightfix::config::Limits;
use sightfix::grpc;
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;
use sightfix::request::{RequestContext, RequestHead};
use sightfix::shutdown::Shutdown;
use sightfix::store::Store;
use sightfix::telemetry::{Metrics, RequestId};
use tempfile::TempDir;
use tokio::net::TcpListener;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
use tonic_types::StatusExt as _;
use tower::Service as _;

/// The id that every request of these tests has.
const REQUEST: &str = "request-1";

/// The transport alone, over an application of its own.
pub(super) struct Server {
    pub(super) app: App,
    pub(super) channel: Channel,
    shutdown: Shutdown,
    _folder: TempDir,
}

impl Server {
    pub(super) async fn start() -> Self {
        Self::with(Limits::default()).await
    }

    pub(super) async fn with(limits: Limits) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let now = "2027-01-01T00:00:00Z".parse().expect("a time");
        let clock = Clock::from_fn(move || now);
        let app =
            App::new(store, clock, Randomness::seeded(1), limits, Metrics::new()).await.expect("an app");
        let shutdown = Shutdown::new();
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("its address");
        tokio::spawn(serve(listener, app.clone(), shutdown.clone()));
        Self { app, channel: channel(address).await, shutdown, _folder: folder }
    }

    pub(super) async fn with_camera(profile: proto::CameraProfile) -> Self {
        let server = Self::start().await;
        let request = proto::CreateCameraRequest { id: "yard".to_owned(), profile: Some(profile) };
        server.cameras().create_camera(request).await.expect("a new camera");
        server
    }

    pub(super) fn begin_shutdown(&self) {
        self.shutdown.drain();
    }

    pub(super) fn cameras(&self) -> CameraServiceClient<Channel> {
        CameraServiceClient::new(self.channel.clone())
    }

    pub(super) fn fusion(&self) -> FusionServiceClient<Channel> {
        FusionServiceClient::new(self.channel.clone())
    }
}

async fn channel(address: SocketAddr) -> Channel {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    endpoint.connect().await.expect("a connection")
}

async fn serve(listener: TcpListener, app: App, shutdown: Shutdown) {
    let router = grpc::router(&app, &shutdown).into_axum_router();
    loop {
        let (stream, address) = listener.accept().await.expect("a connection");
        let (router, quotas) = (router.clone(), app.quotas.clone());
        tokio::spawn(async move {
            let service = service_fn(move |mut request| {
                let id = RequestId::new(HeaderValue::from_static(REQUEST));
                let head = RequestHead {
                    id: id.clone(),
                    is_grpc: true,
                    class: grpc::class(request.uri().path()),
                    scheme: Scheme::HTTP,
                    address: address.ip(),
                };
                let context = RequestContext::new(head, quotas.clone());
                context.authenticated(Caller::new(Principal::Everyone, None, None));
                request.extensions_mut().insert(context);
                let answer = router.clone().call(request);
                async move { answer.await.map(|answer| grpc::explain(answer, &id)) }
            });
            let builder = hyper::server::conn::http2::Builder::new(TokioExecutor::new());
            builder.serve_connection(TokioIo::new(stream), service).await
        });
    }
}

/// Holds a refusal to its code and reason, and gives its message and the fields it names.
#[track_caller]
pub(super) fn refusal_of(status: &Status, code: Code, reason: &str) -> (String, Vec<String>) {
    assert_eq!(status.code(), code, "{status:?}");
    let details = status.get_error_details();
    let info = details.error_info().unwrap_or_else(|| panic!("no ErrorInfo: {status:?}"));
    assert_eq!((info.reason.as_str(), info.domain.as_str()), (reason, "sightfix"));
    assert_eq!(details.request_info().expect("RequestInfo").request_id, REQUEST);
    let fields = details.bad_request().into_iter().flat_map(|bad| &bad.field_violations);
    (status.message().to_owned(), fields.map(|violation| violation.field.clone()).collect())
}

/// Calls a method that no client has been generated for, with these bytes as the message.
async fn call(channel: &Channel, path: &'static str, message: impl Into<Vec<u8>>) -> Status {
    let mut client = tonic::client::Grpc::new(channel.clone());
    client.ready().await.expect("a connection");
    let codec = tonic_prost::ProstCodec::<AsIs, AsIs>::default();
    let path = hyper::http::uri::PathAndQuery::from_static(path);
    client.unary(Request::new(AsIs(message.into())), path, codec).await.expect_err("refused")
}

/// Bytes that are sent as they are.
#[derive(Debug, Default)]
struct AsIs(Vec<u8>);

impl prost::Message for AsIs {
    fn encode_raw(&self, buffer: &mut impl bytes::BufMut) {
        buffer.put_slice(&self.0);
    }

    fn merge_field(
        &mut self,
        tag: u32,
        wire_type: prost::encoding::WireType,
        buffer: &mut impl bytes::Buf,
        context: prost::encoding::DecodeContext,
    ) -> Result<(), prost::DecodeError> {
        prost::encoding::skip_field(wire_type, tag, buffer, context)
    }

    fn encoded_len(&self) -> usize {
        self.0.len()
    }

    fn clear(&mut self) {
        self.0.clear();
    }
}

#[tokio::test]
async fn unknown_services_and_methods_are_told_apart_from_missing_things() {
    let server = Server::start().await;
    for path in ["/sightfix.v1.NoService/Fuse", "/sightfix.v1.FusionService/NoMethod"] {
        let status = call(&server.channel, path, b"").await;
        let (message, _) = refusal_of(&status, Code::Unimplemented, "route-not-found");
        assert!(message.contains("reflection"), "{message}");
    }
}

#[tokio::test]
async fn messages_that_cannot_be_read_are_the_clients_fault() {
    let server = Server::with(Limits { message_bytes: 1_000, ..Limits::default() }).await;
    // Field 1 as a varint, where the camera's id should be.
    let status = call(&server.channel, "/sightfix.v1.FusionService/Fuse", b"\x08\x01").await;
    refusal_of(&status, Code::InvalidArgument, "malformed-body");

    let request = proto::GetCameraRequest { camera_id: "x".repeat(1_001) };
    let status = server.cameras().get_camera(request).await.expect_err("too large");
    refusal_of(&status, Code::ResourceExhausted, "too-large");
}

#[tokio::test]
async fn a_message_has_no_more_elements_than_its_length_has_memory_for() {
    let server = Server::start().await;
    // A field of two bytes, again and again: an empty message, or an empty text.
    let contents =
        [&[0x2a, 0x84, 0x80, 0x20, 0x2a, 0x80, 0x80, 0x20][..], &b"\x42\0".repeat(1 << 18)].concat();
    for (path, message) in [
        ("/sightfix.v1.FusionService/Fuse", b"\x12\0".repeat(1 << 20)),
        ("/sightfix.v1.SampleService/ImportSamples", b"\x12\0".repeat(1 << 20)),
        ("/sightfix.v1.ModelService/EstimateGnssError", b"\x12\0".repeat(1 << 20)),
        ("/sightfix.v1.KeyService/CreateKey", b"\x1a\0".repeat(1 << 20)),
        ("/inference.GRPCInferenceService/ModelInfer", b"\x2a\0".repeat(1 << 20)),
        ("/inference.GRPCInferenceService/ModelInfer", b"\x3a\0".repeat(1 << 20)),
        ("/inference.GRPCInferenceService/ModelInfer", contents),
    ] {
        let status = call(&server.channel, path, message).await;
        let (message, _) = refusal_of(&status, Code::ResourceExhausted, "too-large");
        assert!(message.contains("elements"), "{path}: {message}");
    }
    // A thousand short observations are a batch.
    let fix = b"\x12\x14\x22\x12\x09\0\0\0\0\0\0\x20\x40\x11\0\0\0\0\0\x80\x47\x40";
    let status = call(&server.channel, "/sightfix.v1.FusionService/Fuse", fix.repeat(1_000)).await;
    assert!(!status.message().contains("elements"), "{status:?}");
}

#[tokio::test]
async fn reflection_lists_the_services() {
    let server = Server::start().await;
    let request = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let answers = ServerReflectionClient::new(server.channel.clone())
        .server_reflection_info(stream::iter([request]))
        .await
        .expect("a stream");
    let answer = answers.into_inner().message().await.expect("an answer").expect("one answer");
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else {
        panic!("another answer: {answer:?}")
    };
    let names: Vec<&str> = list.service.iter().map(|service| service.name.as_str()).collect();
    for name in [
        "grpc.health.v1.Health",
        "sightfix.v1.CameraService",
        "sightfix.v1.SampleService",
        "sightfix.v1.TrainingService",
        "sightfix.v1.ModelService",
        "sightfix.v1.FusionService",
    ] {
        assert!(names.contains(&name), "{name} is not among {names:?}");
    }
}

#[tokio::test]
async fn health_is_serving_until_the_end_begins() {
    let server = Server::start().await;
    let mut client = HealthClient::new(server.channel.clone());
    for name in ["", "sightfix.v1.FusionService"] {
        let request = HealthCheckRequest { service: name.to_owned() };
        let status = client.check(request).await.expect("known").into_inner().status();
        assert_eq!(status, ServingStatus::Serving, "{name}");
    }
    let request = HealthCheckRequest { service: String::new() };
    let mut watched = client.watch(request).await.expect("a stream").into_inner();
    let first = watched.message().await.expect("in order").expect("the state now");
    assert_eq!(first.status(), ServingStatus::Serving);
    server.shutdown.drain();
    let last = watched.message().await.expect("in order").expect("a change");
    assert_eq!(last.status(), ServingStatus::NotServing);
    assert!(watched.message().await.expect("in order").is_none());
}

#[tokio::test]
async fn open_streams_end_with_the_server() {
    let server = Server::start().await;
    let pending = || stream::pending::<ServerReflectionRequest>();
    let reflection =
        ServerReflectionClient::new(server.channel.clone()).server_reflection_info(pending()).await;
    let mut reflection = reflection.expect("a stream").into_inner();
    server.shutdown.drain();
    let ended = tokio::time::timeout(Duration::from_secs(20), reflection.message()).await;
    assert!(ended.expect("it ends").expect("in order").is_none());
}

#[tokio::test]
async fn a_watched_run_is_followed_to_the_end_of_the_run_or_of_the_server() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    super::imports::import(&server, super::imports::samples(0..20)).await.expect("stored");
    let mut training = TrainingServiceClient::new(server.channel.clone());
    let request = proto::StartTrainingRunRequest { camera_id: "yard".to_owned(), ..Default::default() };
    let run = training.start_training_run(request).await.expect("queued").into_inner().run.expect("a run");
    assert_eq!(run.state(), proto::TrainingRunState::Queued);
    assert_eq!(run.recipe(), proto::Recipe::Auto);
    let watch = proto::WatchTrainingRunRequest { camera_id: "yard".to_owned(), run_id: run.id.clone() };

    let mut watched = training.watch_training_run(watch.clone()).await.expect("a stream").into_inner();
    let first = watched.message().await.expect("in order").expect("the run now").run;
    assert_eq!(first, Some(run.clone()));
    server.shutdown.drain();
    let status = watched.message().await.expect_err("the server ends");
    refusal_of(&status, Code::Unavailable, "shutting-down");

    let cancel = proto::CancelTrainingRunRequest { camera_id: "yard".to_owned(), run_id: run.id.clone() };
    training.cancel_training_run(cancel.clone()).await.expect("live");
    let status = training.cancel_training_run(cancel).await.expect_err("ended");
    refusal_of(&status, Code::FailedPrecondition, "run-ended");
    let mut watched = training.watch_training_run(watch).await.expect("a stream").into_inner();
    let last = watched.message().await.expect("in order").expect("the run").run.expect("set");
    assert_eq!(last.state(), proto::TrainingRunState::Cancelled);
    assert!(watched.message().await.expect("in order").is_none());

    let unknown = proto::GetTrainingRunRequest { camera_id: "yard".to_owned(), run_id: "7".to_owned() };
    let status = training.get_training_run(unknown).await.expect_err("no such run");
    refusal_of(&status, Code::NotFound, "run-not-found");
}
