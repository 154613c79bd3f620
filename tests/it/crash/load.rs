//! The mixed load: writers that each know what was acknowledged to them.
//!
//! A writer does one thing after the other to a camera or key of its own, so after a kill its state must be
//! that of its last acknowledged step, or of the one step that was under way.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Duration;

use futures_util::future::{join, join_all, join3};
use jiff::Timestamp;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::stream_request::Kind as Sent;
use sightfix::grpc::proto::stream_response::Kind as Received;
use tokio::sync::mpsc;
use tonic::metadata::AsciiMetadataValue;
use tonic::transport::Endpoint;

use super::client::{Client, Reply};
use crate::harness::simulated_csv;
use crate::live_client::messages;

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
/// Samples of one import.
pub(super) const ROWS: i64 = 3;
/// Pause after a refusal, and between items of a stream.
const PAUSE: Duration = Duration::from_millis(5);

/// The steps of a writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Work {
    /// Imports batches; when there is no space left, it deletes them and goes on.
    Import,
    /// Imports a batch and deletes all samples, in turn.
    Erase,
    /// Creates and deletes a camera, in turn.
    Recreate,
    /// Activates one of two model versions, in turn.
    Activate,
    /// Creates and revokes a key, in turn.
    Key,
}

/// One writer and how far it has come.
pub(super) struct Writer {
    pub(super) work: Work,
    /// Id of its camera, or name of its key.
    pub(super) name: String,
    /// The last step that was acknowledged.
    pub(super) acknowledged: u64,
    /// The step under way; the acknowledged one if there is none.
    pub(super) attempted: u64,
    /// The first batch of an importer that was not deleted.
    pub(super) first_batch: u64,
    /// An importer's deletion is under way.
    pub(super) is_deleting: bool,
    /// Id and secret of the key.
    pub(super) key: Option<(String, String)>,
    /// Secrets whose revocation was acknowledged.
    pub(super) revoked: Vec<String>,
}

impl Writer {
    fn new(work: Work, name: &str) -> Self {
        Self {
            work,
            name: name.to_owned(),
            acknowledged: 0,
            attempted: 0,
            first_batch: 1,
            is_deleting: false,
            key: None,
            revoked: Vec::new(),
        }
    }

    /// Works until the outcome of a step is unknown, mostly because the server was killed.
    async fn run(&mut self, client: &Client) {
        loop {
            self.attempted = self.acknowledged + 1;
            match self.step(self.attempted, client).await {
                Reply::Done(body) => self.done(&body),
                Reply::Refused(507, _) if self.work == Work::Import => {
                    self.attempted = self.acknowledged;
                    if !self.delete_batches(client).await {
                        return;
                    }
                }
                Reply::Refused(408 | 429 | 503 | 507, _) => {
                    self.attempted = self.acknowledged;
                    tokio::time::sleep(PAUSE).await;
                }
                Reply::Refused(status, body) => panic!("{:?} {}: {status} {body}", self.work, self.name),
                Reply::Unknown => return,
            }
        }
    }

    fn done(&mut self, body: &Value) {
        self.acknowledged = self.attempted;
        if self.work != Work::Key {
            return;
        }
        let text = |field: &str| body[field].as_str().map(str::to_owned);
        match self.key.take() {
            None => self.key = text("id").zip(text("secret")),
            Some((_, secret)) => self.revoked.push(secret),
        }
    }

    async fn step(&self, step: u64, client: &Client) -> Reply {
        let Self { work, name, .. } = self;
        let is_odd = step % 2 == 1;
        match work {
            Work::Import => import(client, name, step).await,
            Work::Erase if is_odd => import(client, name, step).await,
            Work::Erase => delete_samples(client, name).await,
            Work::Recreate if is_odd => client.json("POST", "/v1/cameras", &json!({"id": name})).await,
            Work::Recreate => client.send("DELETE", &format!("/v1/cameras/{name}"), "", "").await,
            Work::Activate => activate(client, name, active_model(step)).await,
            Work::Key => match &self.key {
                None => client.json("POST", "/v1/keys", &json!({"name": name, "role": "viewer"})).await,
                Some((id, _)) => client.send("DELETE", &format!("/v1/keys/{id}"), "", "").await,
            },
        }
    }

    /// Returns true if the deletion was acknowledged or refused.
    async fn delete_batches(&mut self, client: &Client) -> bool {
        self.is_deleting = true;
        match delete_samples(client, &self.name).await {
            Reply::Done(_) => self.first_batch = self.acknowledged + 1,
            Reply::Refused(..) => tokio::time::sleep(PAUSE).await,
            Reply::Unknown => return false,
        }
        self.is_deleting = false;
        true
    }
}

/// The model version that is active after a step.
pub(super) fn active_model(step: u64) -> u64 {
    1 + step % 2
}

async fn activate(client: &Client, camera: &str, number: u64) -> Reply {
    client.json("PUT", &format!("/v1/cameras/{camera}/active-model"), &json!({ "number": number })).await
}

async fn import(client: &Client, camera: &str, batch: u64) -> Reply {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for row in 0..ROWS {
        let second = 1_600_000_000 + (batch % 100_000) as i64 * ROWS + row;
        let time = Timestamp::from_second(second).expect("in range");
        writeln!(csv, "{time},batch-{batch},10,20,30,60,103.9,30.6").expect("memory");
    }
    client.send("POST", &format!("/v1/cameras/{camera}/samples"), "text/csv", csv).await
}

async fn delete_samples(client: &Client, camera: &str) -> Reply {
    let path = format!("/v1/cameras/{camera}/samples?from=2000-01-01T00:00:00Z");
    client.send("DELETE", &path, "", "").await
}

/// Starts training runs one after the other.
#[derive(Default)]
pub(super) struct Trainer {
    /// Runs whose start was acknowledged, with the state in which they were seen to end.
    pub(super) runs: BTreeMap<String, Option<String>>,
}

const RUNS: &str = "/v1/cameras/trained/training-runs";

impl Trainer {
    async fn run(&mut self, client: &Client) {
        loop {
            match client.json("POST", RUNS, &json!({"recipe": "projective", "epochs": 2})).await {
                Reply::Done(run) => {
                    self.runs.insert(run["id"].as_str().expect("an id").to_owned(), None);
                }
                Reply::Refused(..) => {}
                Reply::Unknown => return,
            }
            tokio::time::sleep(10 * PAUSE).await;
            match client.send("GET", &format!("{RUNS}?limit=10"), "", "").await {
                Reply::Done(page) => self.see(&page),
                Reply::Refused(..) => {}
                Reply::Unknown => return,
            }
        }
    }

    fn see(&mut self, page: &Value) {
        for run in page["items"].as_array().expect("a list") {
            let (id, state) = (run["id"].as_str().expect("an id"), run["state"].as_str().expect("a state"));
            let is_live = matches!(state, "queued" | "running");
            if let Some(ended) = self.runs.get_mut(id).filter(|_| !is_live) {
                *ended = Some(state.to_owned());
            }
        }
    }
}

/// Streams boxes with fixes that are stored as samples.
#[derive(Default)]
pub(super) struct Streamer {
    /// Streams so far; each names its target by its number.
    streams: u64,
    /// The target of the last stream, and how many of its samples were acknowledged as stored.
    pub(super) acknowledged: (String, u64),
}

impl Streamer {
    async fn run(&mut self, client: &Client) {
        self.streams += 1;
        self.acknowledged = (format!("stream-{}", self.streams), 0);
        // Samples stored before have been looked for; they would fill the database in the end.
        while matches!(delete_samples(client, "streamed").await, Reply::Refused(..)) {
            tokio::time::sleep(PAUSE).await;
        }
        let (items, requests) = mpsc::channel(64);
        let sending =
            send_items(items, self.acknowledged.0.clone(), 1_600_000_000 + self.streams as i64 * 10_000);
        let reading = async {
            // A refusal under load, and the end of a killed server, alike: the next stream goes on.
            let Some(mut responses) = open_stream(client, requests).await else { return };
            while let Ok(Some(response)) = responses.message().await {
                if let Some(Received::Acknowledgement(acknowledgement)) = response.kind {
                    self.acknowledged.1 = acknowledgement.stored;
                }
            }
        };
        join(sending, reading).await;
    }
}

async fn open_stream(
    client: &Client,
    requests: mpsc::Receiver<proto::StreamRequest>,
) -> Option<tonic::Streaming<proto::StreamResponse>> {
    let endpoint = Endpoint::from_shared(format!("http://{}", client.address)).expect("an address");
    let mut service = FusionServiceClient::new(endpoint.connect().await.ok()?);
    let mut request = tonic::Request::new(messages(requests));
    let bearer = AsciiMetadataValue::try_from(format!("Bearer {}", client.key)).expect("ASCII");
    request.metadata_mut().insert("authorization", bearer);
    Some(service.stream(request).await.ok()?.into_inner())
}

/// Sends an item every few milliseconds until nobody takes them.
async fn send_items(items: mpsc::Sender<proto::StreamRequest>, target: String, first_second: i64) {
    let opening = proto::StreamOpening {
        camera_id: "streamed".to_owned(),
        client_name: "load".to_owned(),
        store_samples: true,
        ..proto::StreamOpening::default()
    };
    let mut message = Sent::Opening(opening);
    let mut seq = 0;
    while items.send(proto::StreamRequest { kind: Some(message) }).await.is_ok() {
        seq += 1;
        let side = |side: f64| Some(side);
        let item = proto::StreamItem {
            seq,
            time: Some(prost_types::Timestamp { seconds: first_second + seq as i64, nanos: 0 }),
            target_id: Some(target.clone()),
            bounding_box: Some(proto::BoundingBox {
                left_px: side(100.0),
                top_px: side(200.0),
                width_px: side(30.0),
                height_px: side(60.0),
            }),
            fix: Some(proto::Fix { longitude_deg: Some(103.9), latitude_deg: Some(30.6), sigma_m: None }),
            ..proto::StreamItem::default()
        };
        message = Sent::Item(item);
        tokio::time::sleep(PAUSE).await;
    }
}

/// All writers.
pub(super) struct Load {
    pub(super) writers: Vec<Writer>,
    pub(super) trainer: Trainer,
    pub(super) streamer: Streamer,
}

impl Load {
    /// Creates what the writers need on a new server.
    pub(super) async fn set_up(client: &Client) -> Self {
        let writers = [
            (Work::Import, "imported-1"),
            (Work::Import, "imported-2"),
            (Work::Import, "imported-3"),
            (Work::Erase, "erased"),
            (Work::Recreate, "recreated"),
            (Work::Activate, "activated"),
            (Work::Key, "key-of-the-load"),
        ];
        for camera in ["imported-1", "imported-2", "imported-3", "erased", "activated", "trained", "streamed"]
        {
            done(client.json("POST", "/v1/cameras", &json!({"id": camera})).await);
        }
        done(client.send("POST", "/v1/cameras/trained/samples", "text/csv", simulated_csv()).await);
        let file = std::fs::read(MODEL).expect("the reference model");
        for _ in 0..2 {
            let kind = "application/vnd.safetensors";
            done(client.send("POST", "/v1/cameras/activated/models", kind, file.clone()).await);
        }
        done(activate(client, "activated", active_model(0)).await);
        Self {
            writers: writers.map(|(work, name)| Writer::new(work, name)).into(),
            trainer: Trainer::default(),
            streamer: Streamer::default(),
        }
    }

    /// Works until the server is gone.
    pub(super) async fn run(&mut self, client: &Client) {
        let writers = join_all(self.writers.iter_mut().map(|writer| writer.run(client)));
        join3(writers, self.trainer.run(client), self.streamer.run(client)).await;
    }

    /// Steps that were acknowledged, samples of streams and training runs among them.
    pub(super) fn acknowledged(&self) -> u64 {
        let steps: u64 = self.writers.iter().map(|writer| writer.acknowledged).sum();
        steps + self.streamer.acknowledged.1 + self.trainer.runs.len() as u64
    }
}

fn done(reply: Reply) {
    match reply {
        Reply::Done(_) => {}
        Reply::Refused(status, body) => panic!("{status} {body}"),
        Reply::Unknown => panic!("the server is gone"),
    }
}
