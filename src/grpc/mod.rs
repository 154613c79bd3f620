//! The gRPC transport of `sightfix.v1` over [`crate::app`]: convert, call the use case, convert.
//!
//! Does not contain checks on numbers (the constructors of [`crate::domain`] make them), status
//! codes other than those of [`crate::status`], and streams that outlive the server's end.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod audit;
mod bounded_codec;
mod cameras;
mod cancel_on_shutdown;
pub mod client;
mod convert;
mod evaluations;
mod fusion;
mod history;
mod idempotency;
mod inference;
mod keys;
mod mask;
mod message_memory;
mod models;
mod outbox;
mod pages;
mod pairings;
mod places;
mod runs;
mod samples;
mod sites;
mod statuses;
mod stream;
mod tracks;
mod training;
mod world_tracks;

use bytes::{BufMut as _, Bytes, BytesMut};
use futures_util::FutureExt as _;
use hyper::Response;
use prost::Message as _;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;
use tonic_health::server::{HealthReporter, HealthService};

use crate::admission::RequestClass;
use crate::app::App;
use crate::domain::Error;
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;
use cancel_on_shutdown::CancelOnShutdown;
use inference_proto::grpc_inference_service_server::GrpcInferenceServiceServer;
use proto::audit_service_server::AuditServiceServer;
use proto::camera_service_server::CameraServiceServer;
use proto::evaluation_service_server::EvaluationServiceServer;
use proto::fusion_service_server::FusionServiceServer;
use proto::history_service_server::HistoryServiceServer;
use proto::key_service_server::KeyServiceServer;
use proto::model_service_server::ModelServiceServer;
use proto::place_service_server::PlaceServiceServer;
use proto::sample_service_server::SampleServiceServer;
use proto::site_service_server::SiteServiceServer;
use proto::track_service_server::TrackServiceServer;
use proto::training_service_server::TrainingServiceServer;

pub use statuses::{explain, owner, trailers};
pub(crate) use stream::HALF_CLOSE_GRACE;

/// Messages, services and clients generated from `proto/`.
#[expect(clippy::allow_attributes, reason = "generated code")]
#[expect(clippy::large_enum_variant, reason = "answers with a position, the large variant, are nearly all")]
pub mod proto {
    tonic::include_proto!("sightfix.v1");

    /// The descriptors of all files of `proto/`, for server reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = tonic::include_file_descriptor_set!("sightfix_descriptor");
}

/// Messages and service of the Open Inference Protocol, generated from `proto/inference`.
#[expect(clippy::allow_attributes, reason = "generated code")]
pub mod inference_proto {
    tonic::include_proto!("inference");
}

/// All services, health and reflection. Requests carry their [`RequestId`] as an extension; pass
/// the answers through [`explain`].
#[must_use]
pub fn router(app: &App, shutdown: &Shutdown) -> Routes {
    let most = app.limits.message_bytes;
    let cameras = CameraServiceServer::new(cameras::Cameras::new(app)).max_decoding_message_size(most);
    let samples =
        SampleServiceServer::new(samples::Samples::new(app, shutdown)).max_decoding_message_size(most);
    let training =
        TrainingServiceServer::new(training::Training::new(app, shutdown)).max_decoding_message_size(most);
    let models = ModelServiceServer::new(models::Models::new(app)).max_decoding_message_size(most);
    let fusion = FusionServiceServer::new(fusion::Fusion::new(app, shutdown)).max_decoding_message_size(most);
    let keys = KeyServiceServer::new(keys::Keys::new(app)).max_decoding_message_size(most);
    let audit = AuditServiceServer::new(audit::Audit::new(app)).max_decoding_message_size(most);
    let sites = SiteServiceServer::new(sites::Sites::new(app, shutdown)).max_decoding_message_size(most);
    let places = PlaceServiceServer::new(places::Places::new(app, shutdown)).max_decoding_message_size(most);
    let tracks = TrackServiceServer::new(tracks::Tracks::new(app, shutdown)).max_decoding_message_size(most);
    let evaluations =
        EvaluationServiceServer::new(evaluations::Evaluations::new(app)).max_decoding_message_size(most);
    let histories =
        HistoryServiceServer::new(history::Histories::new(app, shutdown)).max_decoding_message_size(most);
    let inference = GrpcInferenceServiceServer::new(inference::Inference::new(app, shutdown))
        .max_decoding_message_size(most);
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    #[expect(clippy::expect_used, reason = "every start tests it")]
    let reflection_v1 = reflection().build_v1().expect("the build wrote the descriptors");
    // All that Python's client speaks, and older releases of others.
    #[expect(clippy::expect_used, reason = "every start tests it")]
    let reflection_v1alpha = reflection().build_v1alpha().expect("the build wrote the descriptors");
    Routes::default()
        .add_service(health(shutdown))
        .add_service(CancelOnShutdown::new(reflection_v1, shutdown))
        .add_service(CancelOnShutdown::new(reflection_v1alpha, shutdown))
        .add_service(cameras)
        .add_service(samples)
        .add_service(training)
        .add_service(models)
        .add_service(fusion)
        .add_service(keys)
        .add_service(audit)
        .add_service(sites)
        .add_service(places)
        .add_service(tracks)
        .add_service(evaluations)
        .add_service(histories)
        .add_service(inference)
        .prepare()
}

/// The class of a request, by its path.
#[must_use]
pub fn class(path: &str) -> RequestClass {
    match path {
        "/grpc.health.v1.Health/Check" => RequestClass::Probe,
        "/inference.GRPCInferenceService/ServerLive" | "/inference.GRPCInferenceService/ServerReady" => {
            RequestClass::Probe
        }
        "/sightfix.v1.FusionService/Fuse" | "/inference.GRPCInferenceService/ModelInfer" => {
            RequestClass::Fusion
        }
        "/sightfix.v1.SampleService/ImportSamples" | "/sightfix.v1.SampleService/PairSamples" => {
            RequestClass::ImportStream
        }
        "/sightfix.v1.FusionService/Stream" => RequestClass::LiveStream,
        _ => RequestClass::Other,
    }
}

/// The message, with its head, by which a live stream that another node answers asks its client to reconnect, because this node
/// shuts down.
pub(crate) fn reconnect_message() -> Bytes {
    let reconnect = proto::StreamReconnect { reason: stream::SERVER_IS_ENDING.to_owned() };
    let message = proto::StreamResponse { kind: Some(proto::stream_response::Kind::Reconnect(reconnect)) };
    let message = message.encode_to_vec();
    // Not compressed, then its length.
    let mut bytes = BytesMut::with_capacity(5 + message.len());
    bytes.put_u8(0);
    bytes.put_u32(message.len() as u32);
    bytes.put_slice(&message);
    bytes.freeze()
}

/// A refusal before any service was asked, as a whole answer.
#[must_use]
pub fn refusal<B: Default>(error: &Error, id: &RequestId) -> Response<B> {
    statuses::to_status(error, id).into_http()
}

/// The services whose health is reported; the empty name is the server as a whole.
const HEALTHY: [&str; 14] = [
    "",
    CameraServiceServer::<()>::NAME,
    SampleServiceServer::<()>::NAME,
    TrainingServiceServer::<()>::NAME,
    ModelServiceServer::<()>::NAME,
    FusionServiceServer::<()>::NAME,
    KeyServiceServer::<()>::NAME,
    AuditServiceServer::<()>::NAME,
    SiteServiceServer::<()>::NAME,
    PlaceServiceServer::<()>::NAME,
    TrackServiceServer::<()>::NAME,
    EvaluationServiceServer::<()>::NAME,
    HistoryServiceServer::<()>::NAME,
    GrpcInferenceServiceServer::<()>::NAME,
];

/// Serving until the end begins; then watchers get a last status, and their streams end.
fn health(shutdown: &Shutdown) -> tonic_health::pb::health_server::HealthServer<HealthService> {
    let mut reporter = HealthReporter::new();
    for name in HEALTHY {
        // Nobody else holds the reporter's lock yet, so this never waits.
        let set = reporter.set_service_status(name, ServingStatus::Serving).now_or_never();
        debug_assert!(set.is_some(), "the reporter is new");
    }
    let service = HealthService::from_health_reporter(reporter.clone());
    let ending = shutdown.clone();
    shutdown.spawn(async move {
        ending.draining().await;
        for name in HEALTHY {
            reporter.set_service_status(name, ServingStatus::NotServing).await;
            reporter.clear_service_status(name).await;
        }
    });
    tonic_health::pb::health_server::HealthServer::new(service)
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    #[test]
    fn every_service_can_be_reflected() {
        let set =
            prost_types::FileDescriptorSet::decode(super::proto::FILE_DESCRIPTOR_SET).expect("descriptors");
        let services = set.file.iter().flat_map(|file| &file.service);
        let names: Vec<&str> = services.map(prost_types::ServiceDescriptorProto::name).collect();
        let own = [
            "CameraService",
            "SampleService",
            "TrainingService",
            "ModelService",
            "FusionService",
            "KeyService",
            "AuditService",
            "SiteService",
            "PlaceService",
            "TrackService",
            "EvaluationService",
            "HistoryService",
            "GRPCInferenceService",
        ];
        assert_eq!(names, own);
    }
}
