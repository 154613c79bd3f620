//! Sources and sinks of Kafka against librdkafka's mock cluster, which kcat runs.

use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, Command, Stdio};

use serde_json::{Value, json};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::peers::{connection_when, create_gate, patch, send_fix};
use super::sinks::tls_acceptor;
use crate::harness::{TestServer, data_folder, now};
use crate::tls::Authority;

const TOPIC: &str = "detections";

/// A cluster of one broker, which has four partitions per topic and creates topics when they are asked for; killed when
/// dropped.
pub(crate) struct Cluster {
    process: Child,
    pub(crate) address: String,
}

impl Cluster {
    pub(crate) fn start() -> Self {
        let mut command = Command::new("kcat");
        command.args(["-b", "none", "-X", "test.mock.num.brokers=1", "-d", "mock", "-P", "-t", TOPIC]);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut process = command.spawn().expect("kcat is installed");
        let mut log = BufReader::new(process.stderr.take().expect("piped"));
        let mut line = String::new();
        let address = loop {
            line.clear();
            assert!(log.read_line(&mut line).expect("a line") > 0, "kcat has ended");
            if let Some((_, address)) = line.split_once("bootstrap.servers=") {
                break address.trim().to_owned();
            }
        };
        // A broker whose log nobody reads would wait for it.
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
        Self { process, address }
    }

    pub(crate) fn signal(&self, signal: &str) {
        let status = Command::new("kill").args([signal, &self.process.id().to_string()]).status();
        assert!(status.expect("kill exists").success());
    }

    /// Has kcat write a message to a partition.
    fn publish(&self, partition: u32, message: &str) {
        self.publish_compressed(partition, "none", message.as_bytes());
    }

    /// Has kcat write a message of one line to a partition, compressed by a codec.
    fn publish_compressed(&self, partition: u32, codec: &str, message: &[u8]) {
        let mut command = Command::new("kcat");
        command.args(["-b", &self.address, "-P", "-t", TOPIC, "-p", &partition.to_string(), "-z", codec]);
        command.args(["-X", "message.max.bytes=1000000000"]);
        let mut process = command.stdin(Stdio::piped()).spawn().expect("kcat is installed");
        process.stdin.take().expect("piped").write_all(message).expect("it reads");
        assert!(process.wait().expect("it ends").success());
    }

    /// The first messages of a topic as kcat reads them: key, headers and content.
    pub(crate) fn received(&self, topic: &str, count: usize) -> Vec<(String, String, Value)> {
        let mut command = Command::new("kcat");
        command.args([
            "-b",
            &self.address,
            "-C",
            "-q",
            "-t",
            topic,
            "-o",
            "beginning",
            "-f",
            "%k\\t%h\\t%s\\n",
        ]);
        let output = command.args(["-c", &count.to_string()]).output().expect("kcat is installed");
        let text = String::from_utf8(output.stdout).expect("text");
        let message = |line: &str| {
            let mut fields = line.splitn(3, '\t').map(str::to_owned);
            let mut next = || fields.next().expect("three fields");
            (next(), next(), serde_json::from_str(&next()).expect("JSON"))
        };
        text.lines().map(message).collect()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A payload of DeepStream's minimal schema with one object.
fn detection(time: jiff::Timestamp, target: &str) -> String {
    json!({"version": "4.0", "id": 418, "@timestamp": format!("{time:.3}"), "sensorId": "cam0",
        "objects": [format!("{target}|441.6|510|470.4|562.5|Bicycle")]})
    .to_string()
}

/// Detections of a topic for the camera `gate`, whose detector knows its targets, stored with the fixes of these.
fn source(cluster: &Cluster) -> Value {
    json!({"id": "detector", "source": {
        "address": format!("kafka://{}", cluster.address), "format": "deepstream", "topics": [TOPIC],
        "cameras": {"*": {"camera_id": "gate"}}, "ids_name_targets": true, "store_samples": true,
    }})
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn a_broker_of_kafka_is_read_on_behind_what_is_stored_also_after_a_kill() {
    let cluster = Cluster::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    cluster.publish(0, &detection(now(), "1"));
    server.post("/v1/connections", &source(&cluster)).await.expect(201);
    connection_when(&server, "detector", |status| status["state"] == "running").await;
    let time = now();
    cluster.publish(2, &detection(time, "345"));
    let taken = connection_when(&server, "detector", |status| status["messages"] == 1).await;
    let status = &taken["status"];
    assert_eq!(status["items"], 1, "what was there before the source is not taken: {status}");
    assert_eq!(status["acknowledged"], 0, "the box may still become part of a sample");
    server.kill();

    let server = TestServer::start(folder.path());
    connection_when(&server, "detector", |status| status["items"] == 1).await;
    send_fix(&server, "345", &format!("{time:.3}"), 103.98678, true).await;
    connection_when(&server, "detector", |status| status["acknowledged"] == 1).await;
    let samples = server.get("/v1/cameras/gate/samples").await.expect(200).json();
    let sample = &samples["items"][0];
    assert_eq!((&sample["target_id"], &sample["class"]), (&json!("345"), &json!("Bicycle")));
    server.kill();

    // Acknowledged messages do not come again, and those that came meanwhile do.
    let time = now();
    cluster.publish(0, &detection(time, "7"));
    cluster.publish(2, &detection(time, "8"));
    let server = TestServer::start(folder.path());
    connection_when(&server, "detector", |status| status["items"] == 2).await;
    // Each is answered once its fix is stored or can no longer be; a box does not wait that long for the second.
    let text = format!("{time:.3}");
    let fix = |target| send_fix(&server, target, &text, 103.98678, true);
    tokio::join!(fix("7"), fix("8"));
    let status = connection_when(&server, "detector", |status| status["acknowledged"] == 2).await;
    assert_eq!(status["status"]["messages"], 2, "{status}");
    let camera = server.get("/v1/cameras/gate").await.expect(200).json();
    assert_eq!(camera["samples"], 3, "{camera}");
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn a_broker_of_kafka_may_go_and_a_topic_may_begin_again() {
    let cluster = Cluster::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut draft = source(&cluster);
    draft["source"]["store_samples"] = json!(false);
    server.post("/v1/connections", &draft).await.expect(201);
    connection_when(&server, "detector", |status| status["state"] == "running").await;
    for target in ["1", "2", "3"] {
        cluster.publish(0, &detection(now(), target));
    }
    connection_when(&server, "detector", |status| status["acknowledged"] == 3).await;
    drop(cluster);
    connection_when(&server, "detector", |status| status["state"] == "waiting").await;

    let cluster = Cluster::start();
    cluster.publish(0, &detection(now(), "4"));
    let address = json!({"source": {"address": format!("kafka://{}", cluster.address)}});
    patch(&server, "detector", &address).await.expect(200);
    let status = connection_when(&server, "detector", |status| status["acknowledged"] == 4).await;
    assert_eq!(status["status"]["items"], 4, "{status}");
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn a_batch_that_becomes_too_large_is_rejected_and_what_comes_after_it_is_read() {
    let cluster = Cluster::start();
    let folder = data_folder();
    let server =
        TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CONNECTION_BATCH_BYTES", "3000000")]);
    create_gate(&server).await;
    let mut draft = source(&cluster);
    draft["source"]["store_samples"] = json!(false);
    server.post("/v1/connections", &draft).await.expect(201);
    connection_when(&server, "detector", |status| status["state"] == "running").await;
    let codecs = ["gzip", "snappy", "lz4", "zstd"];
    for (index, codec) in codecs.into_iter().enumerate() {
        cluster.publish_compressed(0, codec, &[b'0'; 4_000_000]);
        cluster.publish_compressed(0, codec, detection(now(), &index.to_string()).as_bytes());
    }
    let status = connection_when(&server, "detector", |status| status["acknowledged"] == 8).await;
    let status = &status["status"];
    assert_eq!((&status["items"], &status["rejected"]), (&json!(4), &json!(4)), "{status}");
    assert_eq!(status["connects"], 1, "{status}");
    let reason = &status["reasons"][0];
    let expected = "rejected: the batch becomes more than 3000000 bytes when decompressed";
    assert_eq!((&reason["reason"], &reason["count"]), (&json!(expected), &json!(4)), "{status}");
    let example = reason["example"].as_str().expect("a text");
    assert!(example.contains("of partition 0 of detections"), "{example}");

    // One message that is too large for a message, in a batch that is not too large.
    cluster.publish_compressed(0, "zstd", &[b'0'; 2_000_000]);
    let status = connection_when(&server, "detector", |status| status["acknowledged"] == 9).await;
    let reasons = status["status"]["reasons"].to_string();
    assert!(reasons.contains("is larger than 1048576 bytes"), "{reasons}");
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn a_paused_source_of_a_kafka_broker_can_be_tried() {
    let cluster = Cluster::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut draft = source(&cluster);
    draft["paused"] = json!(true);
    server.post("/v1/connections", &draft).await.expect(201);
    let empty = json!({});
    let trial = server.post("/v1/connections/detector/test?wait_s=30", &empty);
    let publishing = async {
        // Until the trial reads nobody gets it.
        loop {
            cluster.publish(1, &detection(now(), "9"));
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
    };
    let tried = tokio::select! {
        tried = trial => tried.expect(200).json(),
        _ = publishing => panic!("it never ends"),
    };
    assert_eq!(tried["message"]["subject"], TOPIC);
    let reading = tried["message"]["reading"][0].as_str().expect("text");
    assert!(reading.contains("object 9"), "{reading}");
}

#[tokio::test]
#[ignore = "needs kcat"]
async fn positions_reach_a_topic_of_a_kafka_broker_also_those_of_its_absence() {
    let cluster = Cluster::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"address": format!("kafka://{}", cluster.address), "topic": "positions", "camera_ids": ["gate"],
        "min_interval_s": 0});
    server.post("/v1/connections", &json!({"id": "positions", "sink": sink})).await.expect(201);
    connection_when(&server, "positions", |status| status["state"] == "running").await;
    let start = now() - jiff::SignedDuration::from_secs(10);
    let send = async |second: i64| {
        let time = start + jiff::SignedDuration::from_secs(second);
        send_fix(&server, "van/1", &time.to_string(), 103.98678, false).await;
    };
    send(0).await;
    let (key, headers, message) = cluster.received("positions", 1).remove(0);
    assert_eq!(key, "gate/van/1");
    let id = message["id"].as_str().expect("an id").to_owned();
    assert_eq!(headers, format!("content-type=application/json,message-id={id}"));
    assert_eq!((&message["camera_id"], &message["target_id"]), (&json!("gate"), &json!("van/1")));

    // A broker that does not answer: what was under way may come twice, under one id.
    cluster.signal("-STOP");
    send(1).await;
    connection_when(&server, "positions", |status| status["state"] == "waiting").await;
    send(2).await;
    connection_when(&server, "positions", |status| status["queued"] == 2).await;
    cluster.signal("-CONT");
    let status =
        connection_when(&server, "positions", |status| status["queued"] == 0).await["status"].clone();
    assert_eq!((&status["dropped"], &status["dead_letters"]), (&json!(0), &json!(0)), "{status}");
    let messages = cluster.received("positions", 3);
    let ids: BTreeSet<&str> =
        messages.iter().map(|(_, _, message)| message["id"].as_str().expect("an id")).collect();
    assert!(ids.len() >= 2 && ids.contains(id.as_str()), "{messages:?}");

    // One that ends, and another in its place.
    drop(cluster);
    connection_when(&server, "positions", |status| status["state"] == "waiting").await;
    for second in 3..6 {
        send(second).await;
    }
    connection_when(&server, "positions", |status| status["queued"] == 3).await;
    let cluster = Cluster::start();
    let address = json!({"sink": {"address": format!("kafka://{}", cluster.address)}});
    patch(&server, "positions", &address).await.expect(200);
    connection_when(&server, "positions", |status| status["queued"] == 0).await;
    let messages = cluster.received("positions", 3);
    let times: Vec<&str> =
        messages.iter().map(|(_, _, message)| message["time"].as_str().expect("a time")).collect();
    assert!(times.is_sorted() && times.len() == 3, "in their order: {times:?}");
}

/// Reads a request and answers it: its API key and its bytes.
async fn answered(
    stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
    answer: impl Fn(u16) -> Vec<u8>,
) -> (u16, Vec<u8>) {
    let bytes = stream.read_u32().await.expect("a request");
    let mut request = vec![0; bytes as usize];
    stream.read_exact(&mut request).await.expect("a whole request");
    let api_key = u16::from_be_bytes([request[0], request[1]]);
    let answer = [&request[4..8], &answer(api_key)].concat();
    stream.write_u32(u32::try_from(answer.len()).expect("short")).await.expect("written");
    stream.write_all(&answer).await.expect("written");
    stream.flush().await.expect("written");
    (api_key, request)
}

const API_VERSIONS: u16 = 18;
const SASL_HANDSHAKE: u16 = 17;
const SASL_AUTHENTICATE: u16 = 36;

/// The mock cluster has no users and no TLS: this is the beginning of a broker's protocol, by Kafka's protocol guide.
#[tokio::test]
async fn a_user_signs_in_to_kafka_over_tls() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let port = listener.local_addr().expect("an address").port();
    let authority = Authority::new();
    let acceptor = tls_acceptor(&authority);
    let (certificate, key) = authority.issue();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut draft = json!({
        "id": "detector",
        "secrets": {"password": "word", "client_certificate": certificate.pem(), "client_key": key.serialize_pem()},
        "source": {"address": format!("kafkas://localhost:{port}"), "format": "deepstream", "topics": [TOPIC],
            "username": "user", "sasl_mechanism": "plain", "ca_certificate": authority.certificate.pem()},
    });
    server.post("/v1/connections", &draft).await.expect(201);
    let (stream, _) = listener.accept().await.expect("the server connects");
    let mut stream = acceptor.accept(stream).await.expect("both trust the authority");
    let answer = |api_key| match api_key {
        // No error, and three ranges of versions.
        API_VERSIONS => {
            let fields = [0, 0, 3, API_VERSIONS, 0, 0, SASL_HANDSHAKE, 1, 1, SASL_AUTHENTICATE, 0, 0];
            fields.map(u16::to_be_bytes).concat()
        }
        SASL_HANDSHAKE => [&[0, 0, 0, 0, 0, 1, 0, 5], &b"PLAIN"[..]].concat(),
        // No error, no message, no bytes.
        _ => vec![0, 0, 0xff, 0xff, 0, 0, 0, 0],
    };
    let authenticated = loop {
        let (api_key, request) = answered(&mut stream, answer).await;
        assert!(api_key != SASL_HANDSHAKE || request.ends_with(b"PLAIN"));
        if api_key == SASL_AUTHENTICATE {
            break request;
        }
    };
    assert!(authenticated.ends_with(b"\0user\0word"), "RFC 4616: {authenticated:?}");

    for (field, value) in
        [("sasl_mechanism", json!("gssapi")), ("topics", json!(["a/b"])), ("topics", json!([]))]
    {
        draft["source"][field] = value;
        let refused = server.post("/v1/connections", &draft).await;
        assert!(matches!(refused.status.as_u16(), 400 | 422), "{field}");
        draft["source"]["sasl_mechanism"] = json!("plain");
    }
    draft["source"]["topics"] = json!([TOPIC]);
    draft["source"]["username"] = Value::Null;
    let refused = server.post("/v1/connections", &draft).await.expect(422);
    assert!(refused.text().contains("sasl_mechanism"), "{}", refused.text());
}
