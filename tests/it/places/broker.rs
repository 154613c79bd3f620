//! A crossing reaches a broker at least once, although the broker was away and the server was killed.

use jiff::SignedDuration;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::{create, drive, events_when, line};
use crate::harness::{TestServer, data_folder, now, own_address};
use crate::outside::broker::{Nats, ask_jetstream};
use crate::outside::kafka::Cluster;
use crate::outside::peers::{Broker, connection_when, create_gate};

/// A crossing that waits for its broker, and whose server was killed.
struct WaitingCrossing {
    folder: TempDir,
    id: Value,
}

impl WaitingCrossing {
    async fn of_sink(mut sink: Value) -> Self {
        let folder = data_folder();
        let server = TestServer::start(folder.path());
        create_gate(&server).await;
        sink["content"] = json!("place_events");
        sink["camera_ids"] = json!(["gate"]);
        server.post("/v1/connections", &json!({"id": "events", "sink": sink})).await.expect(201);
        create(&server, &line()).await;
        drive(&server, "van", (-50.0, 50.0), 10.0, now() - SignedDuration::from_secs(60)).await;
        let id = events_when(&server, 1).await[0]["id"].clone();
        connection_when(&server, "events", |status| status["queued"] == 1).await;
        server.kill();
        Self { folder, id }
    }

    fn check(&self, message: &Value) {
        let expected = (&self.id, &json!("cross"), &json!("line"), &json!("van"));
        let received = (&message["id"], &message["kind"], &message["place_id"], &message["track_id"]);
        assert_eq!(received, expected);
    }
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn a_crossing_reaches_a_broker_of_mqtt() {
    let port = own_address().port();
    let crossing = WaitingCrossing::of_sink(json!({"address": format!("mqtt://127.0.0.1:{port}")})).await;
    let broker = Broker::start_at(port);
    broker.subscribe("sightfix/#");
    let server = TestServer::start(crossing.folder.path());
    let output = broker.received("sightfix/#", 1);
    let (topic, message) = output.split_once(' ').expect("topic and payload");
    assert_eq!(topic, "sightfix/events/line");
    crossing.check(&serde_json::from_str(message).expect("JSON"));
    connection_when(&server, "events", |status| status["queued"] == 0).await;
}

#[tokio::test]
#[ignore = "needs nats-server"]
async fn a_crossing_reaches_a_broker_of_nats() {
    let address = own_address();
    let sink = json!({"address": format!("nats://{address}"), "jetstream": true});
    let crossing = WaitingCrossing::of_sink(sink).await;
    let files = data_folder();
    let _broker = Nats::start(files.path(), &format!("listen: \"{address}\""), address.port());
    let stream = json!({"name": "events", "subjects": ["sightfix.events.>"]});
    ask_jetstream(address, "STREAM.CREATE.events", &stream).await;
    let server = TestServer::start(crossing.folder.path());
    connection_when(&server, "events", |status| status["queued"] == 0).await;
    let last = json!({"last_by_subj": "sightfix.events.line"});
    let stored = ask_jetstream(address, "STREAM.MSG.GET.events", &last).await;
    crossing.check(&decoded(&stored["message"]["data"]));
}

/// The JSON that a text has in base 64.
fn decoded(text: &Value) -> Value {
    use base64::Engine as _;
    let bytes = base64::engine::general_purpose::STANDARD.decode(text.as_str().expect("text"));
    serde_json::from_slice(&bytes.expect("base 64")).expect("JSON")
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn a_crossing_reaches_a_broker_of_kafka() {
    let cluster = Cluster::start();
    // It takes connections and does not answer.
    cluster.signal("-STOP");
    let sink = json!({"address": format!("kafka://{}", cluster.address), "topic": "events"});
    let crossing = WaitingCrossing::of_sink(sink).await;
    cluster.signal("-CONT");
    let server = TestServer::start(crossing.folder.path());
    connection_when(&server, "events", |status| status["queued"] == 0).await;
    let (_, headers, message) = cluster.received("events", 1).remove(0);
    crossing.check(&message);
    assert!(headers.contains(&format!("message-id={}", message["id"].as_str().expect("an id"))), "{headers}");
}
