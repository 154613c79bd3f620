//! A client of the live stream, and the camera that it streams for.

use std::time::Duration;

use futures_util::{Stream, stream};
use jiff::Timestamp;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
pub(crate) use sightfix::grpc::proto::stream_request::Kind as Sent;
pub(crate) use sightfix::grpc::proto::stream_response::Kind as Received;
use sightfix::simulation::{Options, SimulatedRow, simulate};
use tokio::sync::mpsc;
use tonic::transport::Channel;
use tonic::{Status, Streaming};

use crate::harness::TestServer;

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");

/// A stream as a client holds it.
pub(crate) struct Client {
    pub(crate) items: mpsc::Sender<proto::StreamRequest>,
    pub(crate) responses: Streaming<proto::StreamResponse>,
    pub(crate) seq: u64,
}

impl Client {
    pub(crate) async fn send(&mut self, kind: Sent) {
        // A stream that the server has ended takes nothing more; its status is looked at instead.
        let _ = self.items.send(proto::StreamRequest { kind: Some(kind) }).await;
    }

    pub(crate) async fn item(&mut self, item: proto::StreamItem) -> u64 {
        self.seq += 1;
        self.send(Sent::Item(proto::StreamItem { seq: self.seq, ..item })).await;
        self.seq
    }

    pub(crate) async fn next(&mut self) -> Result<Option<Received>, Status> {
        let message = tokio::time::timeout(Duration::from_secs(60), self.responses.message());
        Ok(message.await.expect("a response in time")?.and_then(|message| message.kind))
    }

    /// The next answer; acknowledgements on the way are passed over.
    pub(crate) async fn answer(&mut self) -> proto::StreamAnswer {
        loop {
            match self.next().await.expect("no end") {
                Some(Received::Answer(answer)) => return *answer,
                Some(Received::Opened(_) | Received::Acknowledgement(_)) => {}
                other => panic!("no answer but {other:?}"),
            }
        }
    }

    /// Half-closes and reads to the end; the last acknowledged seq, the answers, and how it ended.
    pub(crate) async fn finish(self) -> (Option<u64>, Vec<proto::StreamAnswer>, Option<Status>) {
        let (acknowledgement, answers, ended) = self.finish_with_counts().await;
        (acknowledgement.map(|it| it.seq), answers, ended)
    }

    /// The same with all that the last acknowledgement says.
    pub(crate) async fn finish_with_counts(
        self,
    ) -> (Option<proto::StreamAcknowledgement>, Vec<proto::StreamAnswer>, Option<Status>) {
        let Self { items, mut responses, .. } = self;
        drop(items);
        let (mut acknowledged, mut answers) = (None, Vec::new());
        loop {
            match responses.message().await {
                Ok(Some(message)) => match message.kind.expect("set") {
                    Received::Acknowledgement(acknowledgement) => acknowledged = Some(acknowledgement),
                    Received::Answer(answer) => answers.push(*answer),
                    _ => {}
                },
                Ok(None) => return (acknowledged, answers, None),
                Err(status) => return (acknowledged, answers, Some(status)),
            }
        }
    }
}

pub(crate) async fn channel(server: &TestServer) -> Channel {
    // Small, so that a client that does not read holds the server up soon.
    let endpoint =
        server.endpoint().initial_stream_window_size(65_535).initial_connection_window_size(65_535);
    endpoint.connect().await.expect("a connection")
}

pub(crate) fn opening(client_name: &str, store_samples: bool) -> Sent {
    Sent::Opening(proto::StreamOpening {
        camera_id: "yard".to_owned(),
        client_name: client_name.to_owned(),
        resume_after_seq: 0,
        store_samples,
        ..Default::default()
    })
}

pub(crate) fn messages(
    queue: mpsc::Receiver<proto::StreamRequest>,
) -> impl Stream<Item = proto::StreamRequest> {
    stream::unfold(queue, |mut queue| async move { queue.recv().await.map(|message| (message, queue)) })
}

/// A stream whose first message is this.
pub(crate) async fn begin(channel: &Channel, first: Sent) -> Client {
    let (items, requests) = mpsc::channel(64);
    let first = proto::StreamRequest { kind: Some(first) };
    items.send(first).await.expect("room");
    let mut service = FusionServiceClient::new(channel.clone());
    let responses = service.stream(messages(requests)).await.expect("errors come as the end").into_inner();
    Client { items, responses, seq: 0 }
}

pub(crate) async fn open(channel: &Channel, client_name: &str, store_samples: bool) -> Client {
    let mut client = begin(channel, opening(client_name, store_samples)).await;
    let Ok(Some(Received::Opened(_))) = client.next().await else { panic!("the stream is not opened") };
    client
}

/// A server with the camera `yard`, and the reference model if wanted.
pub(crate) async fn yard(
    folder: &std::path::Path,
    settings: &[(&str, &str)],
    profile: Value,
    model: bool,
) -> TestServer {
    let server = TestServer::start_with(folder, settings);
    let mut camera = json!({
        "id": "yard", "image_size": {"width_px": 1920, "height_px": 1080}, "gnss_error": {"sigma_m": 2.2}
    });
    camera.as_object_mut().expect("an object").extend(profile.as_object().expect("an object").clone());
    server.post("/v1/cameras", &camera).await.expect(201);
    if model {
        add_model(&server).await;
    }
    server
}

/// The reference model as the next version, active.
pub(crate) async fn add_model(server: &TestServer) {
    let file = std::fs::read(MODEL).expect("the reference model");
    let kind = [("content-type", "application/vnd.safetensors")];
    let model = server.send("POST", "/v1/cameras/yard/models", &kind, file).await.expect(201).json();
    let activate = json!({"number": model["number"]}).to_string();
    let kind = [("content-type", "application/json")];
    server.send("PUT", "/v1/cameras/yard/active-model", &kind, activate).await.expect(200);
}

pub(crate) fn rows(options: &Options) -> Vec<SimulatedRow> {
    simulate(options).rows
}

pub(crate) fn time(time: Timestamp) -> Option<prost_types::Timestamp> {
    Some(prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() })
}

/// Both halves of a row.
pub(crate) fn whole(row: &SimulatedRow) -> proto::StreamItem {
    proto::StreamItem {
        time: time(row.time),
        target_id: Some(row.target_id.as_str().to_owned()),
        bounding_box: row.bounding_box.map(Into::into),
        fix: row.fix.map(Into::into),
        ..proto::StreamItem::default()
    }
}

pub(crate) fn boxed(row: &SimulatedRow) -> proto::StreamItem {
    proto::StreamItem { fix: None, ..whole(row) }
}

pub(crate) fn fixed(row: &SimulatedRow) -> proto::StreamItem {
    proto::StreamItem { bounding_box: None, ..whole(row) }
}
