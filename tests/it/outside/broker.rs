//! Sources and sinks of MQTT against a real mosquitto.

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;

use super::peers::{Broker, connection_when, create_gate, patch, send_fix, send_fix_of};
use crate::harness::{TestServer, data_folder, now, own_address};
use crate::tls::Authority;

const TARGET: &str = "1607123955.475377-mxklsc";

/// An update of Frigate's documentation with the time of now, or earlier, and 100 px higher: within a stream of 360 rows.
fn frigate_update(time: jiff::Timestamp) -> String {
    json!({"type": "update", "before": {}, "after": {
        "id": TARGET, "camera": "front_door", "frame_time": time.as_microsecond() as f64 * 1e-6, "label": "person",
        "false_positive": false, "score": 0.87890625, "box": [216, 148, 272, 327], "area": 40096,
    }})
    .to_string()
}

/// Frigate's events for the camera `gate`, detected on a stream of half its size.
fn frigate(broker: &Broker) -> Value {
    json!({"id": "frigate", "source": {
        "address": format!("mqtt://127.0.0.1:{}", broker.port), "format": "frigate", "topics": ["frigate/events"],
        "cameras": {"front_door": {"camera_id": "gate", "image_size": {"width_px": 640, "height_px": 360}}},
        "store_samples": true,
    }})
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn a_broker_sends_again_what_was_not_stored_before_a_kill() {
    let broker = Broker::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let receivers = json!({"receivers": [{"receiver_id": "anna's phone", "target_id": TARGET}]});
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/gate", &headers, receivers.to_string()).await.expect(200);
    let mut source = frigate(&broker);
    source["source"]["ids_name_targets"] = json!(true);
    server.post("/v1/connections", &source).await.expect(201);
    connection_when(&server, "frigate", |status| status["state"] == "running").await;
    let time = now();
    broker.publish("frigate/events", &frigate_update(time));
    let taken = connection_when(&server, "frigate", |status| status["items"] == 1).await;
    assert_eq!(taken["status"]["acknowledged"], 0, "the box may still become part of a sample");
    server.kill();

    let server = TestServer::start(folder.path());
    connection_when(&server, "frigate", |status| status["items"] == 1).await;
    send_fix_of(&server, json!({"receiver_id": "anna's phone"}), &time.to_string(), 103.98678, true).await;
    connection_when(&server, "frigate", |status| status["acknowledged"] == 1).await;
    let samples = server.get("/v1/cameras/gate/samples").await.expect(200).json();
    let sample = &samples["items"][0];
    assert_eq!(sample["target_id"], TARGET);
    let expected = json!({"left_px": 432.0, "top_px": 296.0, "width_px": 112.0, "height_px": 358.0});
    assert_eq!(sample["bounding_box"], expected, "in pixels of the camera, not of the detect stream");
    assert_eq!((&sample["class"], &sample["score"]), (&json!("person"), &json!(0.87890625)));
    server.kill();

    // Acknowledged messages do not come again.
    let server = TestServer::start(folder.path());
    connection_when(&server, "frigate", |status| status["state"] == "running").await;
    broker.publish("frigate/events", "not JSON");
    let status =
        connection_when(&server, "frigate", |status| status["messages"] == 1).await["status"].clone();
    assert_eq!((&status["items"], &status["rejected"]), (&json!(0), &json!(1)), "{status}");
    assert_eq!(
        (&status["reasons"][0]["count"], &status["reasons"][0]["example"]),
        (&json!(1), &json!("not JSON"))
    );
    connection_when(&server, "frigate", |status| status["acknowledged"] == 1).await;
    assert_eq!(server.get("/v1/cameras/gate/samples/count").await.expect(200).json()["count"], 1);
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn a_broker_may_go_and_come_back() {
    let broker = Broker::start();
    let port = broker.port;
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    server.post("/v1/connections", &frigate(&broker)).await.expect(201);
    connection_when(&server, "frigate", |status| status["state"] == "running").await;
    drop(broker);
    connection_when(&server, "frigate", |status| status["state"] == "waiting").await;
    let broker = Broker::start_at(port);
    connection_when(&server, "frigate", |status| status["connects"] == 2).await;
    broker.publish("frigate/events", &frigate_update(now()));
    connection_when(&server, "frigate", |status| status["acknowledged"] == 1).await;
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn a_paused_source_of_a_broker_can_be_tried() {
    let broker = Broker::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut draft = frigate(&broker);
    draft["paused"] = json!(true);
    server.post("/v1/connections", &draft).await.expect(201);
    let silent = server.post("/v1/connections/frigate/test?wait_s=1", &json!({})).await.expect(200).json();
    assert_eq!(silent["error"], "nothing came within 1 s");
    let empty = json!({});
    let trial = server.post("/v1/connections/frigate/test?wait_s=30", &empty);
    let publishing = async {
        // Until the trial has subscribed nobody gets it.
        loop {
            broker.publish("frigate/events", &frigate_update(now()));
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
    };
    let tried = tokio::select! {
        tried = trial => tried.expect(200).json(),
        _ = publishing => panic!("it never ends"),
    };
    assert_eq!(tried["message"]["subject"], "frigate/events");
    let reading = tried["message"]["reading"][0].as_str().expect("text");
    assert!(reading.contains(TARGET) && reading.contains("216, 148 to 272, 327 px"), "{reading}");
    assert_eq!(server.get("/v1/cameras/gate/tracks").await.expect(200).json()["features"], json!([]));
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn positions_are_published_to_a_broker_also_those_of_its_absence() {
    let broker = Broker::start();
    let port = broker.port;
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"id": "positions", "sink": {
        "address": format!("mqtt://127.0.0.1:{port}"), "camera_ids": ["gate"], "min_interval_s": 0,
    }});
    server.post("/v1/connections", &sink).await.expect(201);
    connection_when(&server, "positions", |status| status["state"] == "running").await;
    drop(broker);
    connection_when(&server, "positions", |status| status["state"] == "waiting").await;
    let now = now();
    for second in 0..3 {
        let time = now - jiff::SignedDuration::from_secs(3 - second);
        send_fix(&server, "van/1", &time.to_string(), 103.98678, false).await;
    }
    connection_when(&server, "positions", |status| status["queued"] == 3).await;
    server.kill();

    let broker = Broker::start_at(port);
    broker.subscribe("sightfix/#");
    let server = TestServer::start(folder.path());
    let output = broker.received("sightfix/#", 3);
    let messages: Vec<(&str, Value)> = output
        .lines()
        .map(|line| line.split_once(' ').expect("topic and payload"))
        .map(|(topic, payload)| (topic, serde_json::from_str(payload).expect("JSON")))
        .collect();
    for (topic, message) in &messages {
        assert_eq!(*topic, "sightfix/gate/van_1");
        assert_eq!((&message["camera_id"], &message["target_id"]), (&json!("gate"), &json!("van/1")));
        assert!((message["position"]["longitude_deg"].as_f64().expect("degrees") - 103.98678).abs() < 1e-4);
        assert!(message["r95_m"].as_f64().expect("m") > 0.0);
    }
    let times: Vec<&str> =
        messages.iter().map(|(_, message)| message["time"].as_str().expect("a time")).collect();
    assert!(times.is_sorted() && times.len() == 3, "{times:?}");
    connection_when(&server, "positions", |status| status["queued"] == 0).await;
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn an_encrypted_broker_is_used_only_if_its_certificate_is_trusted() {
    let (authority, other) = (Authority::new(), Authority::new());
    let broker = Broker::start_encrypted(&authority);
    broker.subscribe("sightfix/gate/van");
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut source = frigate(&broker);
    source["source"]["store_samples"] = json!(false);
    source["source"]["address"] = json!(format!("mqtts://localhost:{}", broker.port));
    source["source"]["ca_certificate"] = json!(other.certificate.pem());
    server.post("/v1/connections", &source).await.expect(201);
    let sink = json!({"id": "positions", "sink": {
        "address": format!("mqtts://127.0.0.1:{}", broker.port), "camera_ids": ["gate"], "min_interval_s": 0,
        "ca_certificate": authority.certificate.pem(),
    }});
    server.post("/v1/connections", &sink).await.expect(201);
    for (id, cause) in [("frigate", "an authority that did not sign"), ("positions", "another name")] {
        let waiting = connection_when(&server, id, |status| status["state"] == "waiting").await;
        let error = waiting["status"]["last_error"]["message"].as_str().expect("an error");
        assert!(error.contains("certificate"), "{cause}: {error}");
        assert_eq!(waiting["status"]["connects"], 0, "{cause}");
    }

    let trust = json!({"source": {"ca_certificate": authority.certificate.pem()}});
    patch(&server, "frigate", &trust).await.expect(200);
    let name = json!({"sink": {"address": format!("mqtts://localhost:{}", broker.port)}});
    patch(&server, "positions", &name).await.expect(200);
    connection_when(&server, "frigate", |status| status["state"] == "running").await;
    broker.publish("frigate/events", &frigate_update(now()));
    connection_when(&server, "frigate", |status| status["acknowledged"] == 1).await;
    connection_when(&server, "positions", |status| status["state"] == "running").await;
    send_fix(&server, "van", &now().to_string(), 103.98678, false).await;
    let output = broker.received("sightfix/gate/van", 1);
    assert!(output.starts_with("sightfix/gate/van {"), "{output}");
}

/// The text that the broker keeps under a topic, once it is another one than before.
fn retained(broker: &Broker, topic: &str, before: &str) -> String {
    for _ in 0..300 {
        let text = broker.retained(topic);
        if text != before {
            return text;
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    panic!("{topic} still has `{before}`")
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn home_assistant_is_told_of_targets_and_whether_the_server_is_there() {
    const AVAILABILITY: &str = "sightfix-availability/home";
    let broker = Broker::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"id": "home", "sink": {
        "address": format!("mqtt://127.0.0.1:{}", broker.port), "camera_ids": ["gate"], "min_interval_s": 0,
        "format": "home_assistant",
    }});
    broker.subscribe("sightfix/#");
    server.post("/v1/connections", &sink).await.expect(201);
    connection_when(&server, "home", |status| status["state"] == "running").await;
    assert_eq!(broker.retained(AVAILABILITY), "online");
    send_fix(&server, "jane/phone", &now().to_string(), 103.98678, false).await;
    let output = broker.received("sightfix/#", 1);
    let (topic, payload) = output.trim_end().split_once(' ').expect("topic and payload");
    let position: Value = serde_json::from_str(payload).expect("JSON");
    assert_eq!(topic, "sightfix/gate/jane_phone");
    assert!((position["longitude"].as_f64().expect("degrees") - 103.98678).abs() < 1e-6, "{position}");
    assert!((position["latitude"].as_f64().expect("degrees") - 30.628).abs() < 1e-6, "{position}");
    let accuracy_m = position["gps_accuracy"].as_f64().expect("m");
    assert!(accuracy_m > 0.0 && accuracy_m < position["r95_m"].as_f64().expect("m"), "{position}");

    // Home Assistant reads the configuration whenever it starts.
    let configuration = broker.retained("homeassistant/device_tracker/sightfix_gate_jane_phone/config");
    let configuration: Value = serde_json::from_str(&configuration).expect("JSON");
    assert_eq!(configuration["json_attributes_topic"], topic);
    assert_eq!(configuration["availability_topic"], AVAILABILITY);
    assert_eq!(
        (&configuration["name"], &configuration["source_type"]),
        (&json!("jane/phone"), &json!("gps"))
    );
    assert!(configuration["unique_id"].is_string(), "{configuration}");

    // Trying it neither announces the target of the trial nor ends the sink.
    let tried = server.post("/v1/connections/home/test", &json!({})).await.expect(200).json();
    assert_eq!(tried["message"]["reading"], json!(["delivered"]), "{tried}");
    assert_eq!(broker.retained("homeassistant/device_tracker/sightfix_gate_sightfix-test/config"), "");
    assert_eq!(broker.retained(AVAILABILITY), "online");
    server.kill();
    assert_eq!(retained(&broker, AVAILABILITY, "online"), "offline", "by the last will");
    let server = TestServer::start(folder.path());
    connection_when(&server, "home", |status| status["state"] == "running").await;
    assert_eq!(retained(&broker, AVAILABILITY, "offline"), "online");
}

/// Reads a message of a subscription: its subject, headers and payload.
async fn next_message(stream: &mut BufReader<TcpStream>) -> (String, String, Value) {
    loop {
        let mut line = String::new();
        assert!(stream.read_line(&mut line).await.expect("a line") > 0, "the connection is closed");
        let fields: Vec<&str> = line.split_whitespace().collect();
        let ["HMSG", subject, _, header, total] = fields[..] else { continue };
        let (header, total): (usize, usize) = (header.parse().expect("bytes"), total.parse().expect("bytes"));
        let mut content = vec![0; total + 2];
        stream.read_exact(&mut content).await.expect("a message");
        let headers = String::from_utf8(content[..header].to_vec()).expect("text");
        return (subject.to_owned(), headers, serde_json::from_slice(&content[header..total]).expect("JSON"));
    }
}

#[tokio::test]
#[ignore = "needs nats-server"]
async fn positions_are_published_to_a_nats_broker_also_those_of_its_absence() {
    let address = own_address();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"address": format!("nats://{address}"), "camera_ids": ["gate"], "min_interval_s": 0});
    server.post("/v1/connections", &json!({"id": "nats", "paused": true, "sink": sink})).await.expect(201);
    patch(&server, "nats", &json!({"paused": false})).await.expect(200);
    connection_when(&server, "nats", |status| status["state"] == "waiting").await;
    send_fix(&server, "van.1", &now().to_string(), 103.98678, false).await;
    connection_when(&server, "nats", |status| status["queued"] == 1).await;
    patch(&server, "nats", &json!({"paused": true})).await.expect(200);

    let port = address.port().to_string();
    let mut command = std::process::Command::new("nats-server");
    command.args(["-a", "127.0.0.1", "-p", &port]).stderr(std::process::Stdio::null());
    let mut broker = command.spawn().expect("nats-server is installed");
    let stream = loop {
        match TcpStream::connect(address).await {
            Ok(stream) => break stream,
            Err(_) => tokio::time::sleep(std::time::Duration::from_millis(20)).await,
        }
    };
    let mut stream = BufReader::new(stream);
    let subscribe = b"CONNECT {\"verbose\":false,\"headers\":true}\r\nSUB sightfix.> 1\r\nPING\r\n";
    stream.get_mut().write_all(subscribe).await.expect("written");
    let mut line = String::new();
    while line.trim_end() != "PONG" {
        line.clear();
        stream.read_line(&mut line).await.expect("an answer");
    }
    patch(&server, "nats", &json!({"paused": false})).await.expect(200);
    let (subject, headers, message) = next_message(&mut stream).await;
    assert_eq!(subject, "sightfix.gate.van_1");
    assert!(
        headers.contains(&format!("Nats-Msg-Id: {}", message["id"].as_str().expect("an id"))),
        "{headers}"
    );
    assert_eq!(message["target_id"], "van.1");
    connection_when(&server, "nats", |status| status["queued"] == 0).await;
    broker.kill().expect("it can be killed");
    broker.wait().expect("it is gone");
}

/// A nats-server; killed when dropped.
pub(crate) struct Nats(std::process::Child);

impl Nats {
    /// Starts with settings of which one names the port, and with JetStream.
    pub(crate) fn start(folder: &std::path::Path, settings: &str, port: u16) -> Self {
        let settings = format!("jetstream {{ store_dir: \"{}\" }}\n{settings}\n", folder.display());
        let path = folder.join("nats.conf");
        std::fs::write(&path, settings).expect("a file can be written");
        let mut command = std::process::Command::new("nats-server");
        command.arg("-c").arg(&path).stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null());
        let process = command.spawn().expect("nats-server is installed");
        while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        Self(process)
    }
}

/// Has JetStream answer a request.
pub(crate) async fn ask_jetstream(address: std::net::SocketAddr, request: &str, body: &Value) -> Value {
    let mut stream = BufReader::new(TcpStream::connect(address).await.expect("a connection"));
    let body = body.to_string();
    let sent = format!(
        "CONNECT {{\"verbose\":false}}\r\nSUB answers 1\r\nPUB $JS.API.{request} answers {}\r\n{body}\r\n",
        body.len()
    );
    stream.get_mut().write_all(sent.as_bytes()).await.expect("written");
    loop {
        let mut line = String::new();
        assert!(stream.read_line(&mut line).await.expect("a line") > 0, "the connection is closed");
        if line.starts_with("MSG answers") {
            line.clear();
            stream.read_line(&mut line).await.expect("an answer");
            return serde_json::from_str(&line).expect("JSON");
        }
    }
}

#[tokio::test]
#[ignore = "needs nats-server"]
async fn a_position_is_delivered_to_nats_when_a_stream_has_stored_it_and_tls_trusts_the_server() {
    let (authority, other) = (Authority::new(), Authority::new());
    let (folder, files, address) = (data_folder(), data_folder(), own_address());
    let (certificate, key) = authority.issue();
    let [certificate_file, key_file] = ["cert.pem", "key.pem"].map(|name| files.path().join(name));
    std::fs::write(&certificate_file, certificate.pem()).expect("a file can be written");
    std::fs::write(&key_file, key.serialize_pem()).expect("a file can be written");
    // The test's own requests are not encrypted.
    let settings = format!(
        "listen: \"{address}\"\nallow_non_tls: true\ntls {{ cert_file: {certificate_file:?}, key_file: {key_file:?} }}"
    );
    let _broker = Nats::start(files.path(), &settings, address.port());
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"id": "nats", "sink": {
        "address": format!("natss://localhost:{}", address.port()), "camera_ids": ["gate"], "min_interval_s": 0,
        "jetstream": true, "ca_certificate": other.certificate.pem(),
    }});
    server.post("/v1/connections", &sink).await.expect(201);
    let waiting = connection_when(&server, "nats", |status| status["state"] == "waiting").await;
    assert!(waiting["status"]["last_error"].to_string().contains("certificate"), "{waiting}");

    let trust = json!({"sink": {"ca_certificate": authority.certificate.pem()}});
    patch(&server, "nats", &trust).await.expect(200);
    connection_when(&server, "nats", |status| status["state"] == "running").await;
    send_fix(&server, "van", &now().to_string(), 103.98678, false).await;
    let is_named =
        |status: &Value| status["last_error"]["message"].to_string().contains("no JetStream stream");
    let waiting = connection_when(&server, "nats", is_named).await;
    assert_eq!(waiting["status"]["queued"], 1, "nobody has stored it");

    let stream = json!({"name": "positions", "subjects": ["sightfix.>"]});
    ask_jetstream(address, "STREAM.CREATE.positions", &stream).await;
    connection_when(&server, "nats", |status| status["queued"] == 0).await;
    let shown = ask_jetstream(address, "STREAM.INFO.positions", &json!({})).await;
    assert_eq!(shown["state"]["messages"], 1, "{shown}");
}

impl Drop for Nats {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test]
#[ignore = "needs nats-server and mosquitto-clients"]
async fn a_broker_of_mqtt_3_1_1_brings_phones_and_takes_positions() {
    let (folder, port) = (data_folder(), own_address().port());
    // It speaks MQTT 3.1.1 alone.
    let settings = format!("server_name: mqtt\nport: -1\nmqtt {{ host: 127.0.0.1, port: {port} }}");
    let _broker = Nats::start(folder.path(), &settings, port);
    let data = data_folder();
    let server = TestServer::start(data.path());
    create_gate(&server).await;
    let address = format!("mqtt://127.0.0.1:{port}");
    let source = json!({"id": "phones", "source": {
        "address": address, "format": "phone", "topics": ["owntracks/+/+"], "camera_ids": ["gate"],
    }});
    let sink = json!({"id": "positions", "sink": {"address": address, "camera_ids": ["gate"], "topic": "positions"}});
    server.post("/v1/connections", &source).await.expect(201);
    server.post("/v1/connections", &sink).await.expect(201);
    for id in ["phones", "positions"] {
        connection_when(&server, id, |status| status["state"] == "running").await;
    }
    let client = |program: &str| {
        let mut command = std::process::Command::new(program);
        command.args(["-V", "mqttv311", "-h", "127.0.0.1", "-q", "1", "-p", &port.to_string()]);
        command
    };
    let mut subscriber = client("mosquitto_sub");
    subscriber.args(["-t", "positions", "-C", "1", "-W", "60"]).stdout(std::process::Stdio::piped());
    let subscriber = subscriber.spawn().expect("mosquitto-clients is installed");
    tokio::time::sleep(std::time::Duration::from_secs(1)).await;
    for _ in 0..2 {
        let location = json!({"_type": "location", "lat": 30.628, "lon": 103.98678, "acc": 5, "tst": now().as_second(), "tid": "ja"});
        let mut publisher = client("mosquitto_pub");
        publisher.args(["-t", "owntracks/jane/phone", "-m", &location.to_string()]);
        assert!(publisher.status().expect("mosquitto-clients is installed").success());
        tokio::time::sleep(std::time::Duration::from_millis(1_100)).await;
    }
    let position = subscriber.wait_with_output().expect("it ends").stdout;
    let position: Value = serde_json::from_slice(&position).expect("a position");
    assert_eq!(position["target_id"], "jane/phone", "{position}");
    connection_when(&server, "phones", |status| status["acknowledged"] == 2).await;
}
