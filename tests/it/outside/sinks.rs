//! Sinks: webhooks, and Cursor on Target.

use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use rustls::pki_types::PrivateKeyDer;
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use serde_json::{Value, json};
use sha2::Sha256;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio_rustls::TlsAcceptor;

use super::peers::{connection_when, create_gate, patch, send_fix};
use crate::harness::{TestServer, data_folder, now, own_address};
use crate::tls::Authority;

/// A request as a receiver of webhooks sees it.
struct Hook {
    headers: Vec<(String, String)>,
    body: Vec<u8>,
}

impl Hook {
    /// Reads a request and answers with a status.
    async fn answered(stream: &mut BufReader<TcpStream>, status: u16) -> Self {
        Self::answered_with(stream, status, "").await
    }

    /// The same with further headers, each with the end of its line.
    async fn answered_with(stream: &mut BufReader<TcpStream>, status: u16, headers_out: &str) -> Self {
        let mut headers = Vec::new();
        loop {
            let mut line = String::new();
            assert!(stream.read_line(&mut line).await.expect("a line") > 0, "the connection is closed");
            match line.trim_end().split_once(": ") {
                Some((name, value)) => headers.push((name.to_lowercase(), value.to_owned())),
                None if line.trim_end().is_empty() => break,
                None => assert!(line.starts_with("POST /hook?site=1 HTTP/1.1"), "{line}"),
            }
        }
        let mut hook = Self { headers, body: Vec::new() };
        hook.body = vec![0; hook.header("content-length").parse().expect("a number")];
        stream.read_exact(&mut hook.body).await.expect("a body");
        let answer = format!("HTTP/1.1 {status} Status\r\n{headers_out}content-length: 0\r\n\r\n");
        stream.get_mut().write_all(answer.as_bytes()).await.expect("an answer");
        hook
    }

    fn header(&self, name: &str) -> &str {
        let found = self.headers.iter().find(|(given, _)| given == name);
        &found.unwrap_or_else(|| panic!("no header {name}")).1
    }

    /// The message, whose signature and id are checked.
    fn verified(&self, key: &[u8]) -> Value {
        let (id, timestamp) = (self.header("webhook-id"), self.header("webhook-timestamp"));
        let mut mac = Hmac::<Sha256>::new_from_slice(key).expect("a key");
        mac.update(format!("{id}.{timestamp}.").as_bytes());
        mac.update(&self.body);
        let expected = format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()));
        assert_eq!(self.header("webhook-signature"), expected);
        let message: Value = serde_json::from_slice(&self.body).expect("JSON");
        assert_eq!(message["id"], id);
        message
    }
}

async fn accept(listener: &TcpListener) -> BufReader<TcpStream> {
    BufReader::new(listener.accept().await.expect("the server connects").0)
}

/// Sends fixes of a target, a second apart, the last of now.
async fn send_fixes(server: &TestServer, target: &str, count: i64) {
    let now = now();
    for index in 1..=count {
        let time = now - jiff::SignedDuration::from_secs(count - index);
        send_fix(server, target, &time.to_string(), 103.98678, false).await;
    }
}

/// The first request that a webhook sends when it is tried.
async fn tried_request(server: &TestServer, listener: &TcpListener) -> Hook {
    let empty = json!({});
    let request = async { Hook::answered(&mut accept(listener).await, 200).await };
    let (answer, hook) = tokio::join!(server.post("/v1/connections/hook/test", &empty), request);
    answer.expect(200);
    hook
}

#[tokio::test]
async fn a_webhook_that_is_moved_to_another_peer_takes_no_secrets_with_it() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let listen = || async { TcpListener::bind("127.0.0.1:0").await.expect("a port") };
    let url =
        |listener: &TcpListener| format!("http://{}/hook?site=1", listener.local_addr().expect("an address"));
    let (first, second) = (listen().await, listen().await);
    let draft = json!({
        // Paused: else the sink itself connects to the listener as well.
        "id": "hook", "paused": true, "secrets": {"signing_key": "a key", "authorization": "Bearer abc"},
        "sink": {"address": url(&first), "camera_ids": ["gate"]},
    });
    server.post("/v1/connections", &draft).await.expect(201);
    assert_eq!(tried_request(&server, &first).await.header("authorization"), "Bearer abc");

    let moved = patch(&server, "hook", &json!({"sink": {"address": url(&second)}})).await.expect(200);
    assert_eq!(moved.json()["secret_names"], json!([]));
    let hook = tried_request(&server, &second).await;
    let is_secret =
        |(name, _): &&(String, String)| matches!(&name[..], "authorization" | "webhook-signature");
    assert_eq!(hook.headers.iter().find(is_secret), None);

    // Who moves it back does not get them back, and who knows them sets them in the same change.
    let change = json!({"sink": {"address": url(&first)}, "secrets": {"authorization": "Bearer new"}});
    let back = patch(&server, "hook", &change).await.expect(200);
    assert_eq!(back.json()["secret_names"], json!(["authorization"]));
    assert_eq!(tried_request(&server, &first).await.header("authorization"), "Bearer new");
}

#[tokio::test]
async fn a_webhook_is_signed_and_comes_again_until_it_is_taken_also_after_a_kill() {
    let address = own_address();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let key = STANDARD.encode(b"a key of the test");
    let draft = json!({
        "id": "hook", "secrets": {"signing_key": format!("whsec_{key}"), "authorization": "Bearer abc"},
        "sink": {"address": format!("http://{address}/hook?site=1"), "camera_ids": ["gate"], "min_interval_s": 0},
    });
    server.post("/v1/connections", &draft).await.expect(201);
    connection_when(&server, "hook", |status| status["state"] == "waiting").await;
    send_fixes(&server, "van", 2).await;
    connection_when(&server, "hook", |status| status["queued"] == 2).await;
    server.kill();

    let listener = TcpListener::bind(address).await.expect("the address is free");
    let server = TestServer::start(folder.path());
    let mut stream = accept(&listener).await;
    let refused = Hook::answered(&mut stream, 503).await;
    let first = refused.verified(b"a key of the test");
    assert_eq!(refused.header("authorization"), "Bearer abc");
    assert_eq!(refused.header("content-type"), "application/json");
    let mut stream = accept(&listener).await;
    let again = Hook::answered(&mut stream, 200).await.verified(b"a key of the test");
    assert_eq!(again, first, "the same id and content");
    let second = Hook::answered(&mut stream, 200).await.verified(b"a key of the test");
    assert!(second["time"].as_str() > first["time"].as_str() && second["id"] != first["id"]);
    connection_when(&server, "hook", |status| status["queued"] == 0).await;
    assert!(server.log_lines(&key).is_empty());
}

#[tokio::test]
async fn a_receiver_that_names_a_pause_is_left_alone_until_it_ends() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let draft = json!({"id": "hook", "sink": {
        "address": format!("http://{address}/hook?site=1"), "camera_ids": ["gate"], "min_interval_s": 0,
    }});
    server.post("/v1/connections", &draft).await.expect(201);
    let mut stream = accept(&listener).await;
    send_fixes(&server, "van", 1).await;
    Hook::answered_with(&mut stream, 429, "retry-after: 300\r\n").await;
    connection_when(&server, "hook", |status| status["state"] == "waiting").await;
    // Without a pause the next attempt comes after a tenth of a second.
    let early = tokio::time::timeout(std::time::Duration::from_secs(2), listener.accept()).await;
    assert!(early.is_err(), "the receiver asked for five minutes");
    // An operator need not wait.
    patch(&server, "hook", &json!({"paused": true})).await.expect(200);
    patch(&server, "hook", &json!({"paused": false})).await.expect(200);
    Hook::answered(&mut accept(&listener).await, 200).await;
    connection_when(&server, "hook", |status| status["queued"] == 0).await;
}

#[tokio::test]
async fn what_a_receiver_refuses_for_good_is_a_dead_letter() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__OUTBOX_MESSAGES", "3")]);
    create_gate(&server).await;
    let draft = json!({"id": "hook", "sink": {
        "address": format!("http://{address}/hook?site=1"), "camera_ids": ["gate"], "min_interval_s": 0,
    }});
    server.post("/v1/connections", &draft).await.expect(201);
    let mut stream = accept(&listener).await;
    connection_when(&server, "hook", |status| status["state"] == "running").await;
    send_fixes(&server, "van", 1).await;
    Hook::answered(&mut stream, 422).await;
    // A delivery is counted after its outcome is stored.
    connection_when(&server, "hook", |status| status["dead_letters"] == 1 && status["rejected"] == 1).await;
    assert_eq!(server.get("/v1/connections/hook").await.expect(200).json()["status"]["queued"], 0);
    let letters = server.get("/v1/connections/hook/dead-letters").await.expect(200).json();
    let letter = &letters["items"][0];
    assert_eq!(letter["reason"], "the receiver answered 422 Unprocessable Entity");
    assert!(letter["text"].as_str().expect("text").contains("\"target_id\":\"van\""), "{letter}");

    let retried = server.post("/v1/connections/hook/dead-letters/retry", &json!({})).await.expect(200).json();
    assert_eq!(retried["dead_letters"], 1);
    let audit = server.get("/v1/audit?limit=1").await.expect(200).json();
    assert_eq!(audit["items"][0]["action"], "dead-letters-retried", "{audit}");
    assert_eq!(audit["items"][0]["subject"], "1 dead letters of connection hook", "{audit}");
    assert_eq!(
        Hook::answered(&mut stream, 200).await.header("webhook-id"),
        letter["id"].as_str().expect("an id")
    );
    connection_when(&server, "hook", |status| status["dead_letters"] == 0 && status["queued"] == 0).await;

    // A receiver that takes nothing fills the outbox up to its limit; the oldest messages give way.
    send_fixes(&server, "bus", 1).await;
    Hook::answered(&mut stream, 422).await;
    connection_when(&server, "hook", |status| status["dead_letters"] == 1).await;
    server.send("DELETE", "/v1/connections/hook/dead-letters", &[], "").await.expect(200);
    let audit = server.get("/v1/audit?limit=1").await.expect(200).json();
    assert_eq!(audit["items"][0]["action"], "dead-letters-deleted", "{audit}");
    drop((stream, listener));
    send_fixes(&server, "car", 8).await;
    let status = connection_when(&server, "hook", |status| status["dropped"].as_u64() >= Some(4)).await;
    assert_eq!(status["status"]["queued"], 3, "{status}");
    let deleted =
        server.send("DELETE", "/v1/connections/hook/dead-letters", &[], "").await.expect(200).json();
    assert_eq!(deleted["dead_letters"], 0);
    let unchanged = server.get("/v1/audit?limit=1").await.expect(200).json();
    assert_eq!(unchanged, audit, "what changes nothing is not recorded");
}

#[tokio::test]
async fn an_authorization_that_is_no_header_is_refused_when_it_is_set() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let draft = |authorization: &str| {
        let sink = json!({"address": "http://127.0.0.1:9/hook", "camera_ids": ["gate"]});
        json!({"id": "hook", "paused": true, "sink": sink, "secrets": {"authorization": authorization}})
    };
    for broken in
        ["Bearer s3\ncret", "Bearer s3cret\n", " Bearer s3cret", "Bearer s3cr\u{e9}t", "Bearer s3\u{0}cret"]
    {
        let refused = server.post("/v1/connections", &draft(broken)).await.expect(422).json();
        assert_eq!(refused["violations"][0]["field"], "secrets.authorization", "{broken:?}: {refused}");
        assert!(!refused.to_string().contains("s3"), "a secret is not repeated: {refused}");
    }
    server.post("/v1/connections", &draft("Bearer s3cret")).await.expect(201);
    let change = json!({"secrets": {"authorization": "Bearer\r\nx: y"}});
    patch(&server, "hook", &change).await.expect(422);
}

/// Answers CONNECT as a broker does that knows neither version: return code 1, then the end.
async fn answer_as_mqtt_3_1(listener: TcpListener) {
    while let Ok((mut stream, _)) = listener.accept().await {
        let mut begin = [0; 64];
        let _ = stream.read(&mut begin).await;
        let _ = stream.write_all(&[0x20, 2, 0, 1]).await;
    }
}

#[tokio::test]
async fn a_broker_of_no_known_version_is_named_as_the_reason() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(answer_as_mqtt_3_1(listener));
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink = json!({"address": format!("mqtt://{address}"), "camera_ids": ["gate"]});
    server.post("/v1/connections", &json!({"id": "old", "sink": sink})).await.expect(201);
    let status = connection_when(&server, "old", |status| !status["last_error"].is_null()).await;
    let error = status["status"]["last_error"]["message"].as_str().expect("an error");
    assert!(error.contains("need MQTT 5") && error.contains("3.1.1"), "{error}");
}

/// The value of an attribute of an event.
fn attribute<'a>(event: &'a str, name: &str) -> &'a str {
    let rest = event.split_once(&format!(" {name}=\"")).unwrap_or_else(|| panic!("no {name}: {event}")).1;
    rest.split_once('"').expect("a value").0
}

#[tokio::test]
async fn cursor_on_target_events_go_over_tcp_and_over_udp() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let socket = UdpSocket::bind("127.0.0.1:0").await.expect("a port");
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let stream_address = listener.local_addr().expect("an address");
    let datagram_address = socket.local_addr().expect("an address");
    for (id, address) in
        [("tak", format!("tcp://{stream_address}")), ("group", format!("udp://{datagram_address}"))]
    {
        let sink = json!({"address": address, "format": "cot", "camera_ids": ["gate"], "min_interval_s": 0, "stale_s": 20});
        server.post("/v1/connections", &json!({"id": id, "sink": sink})).await.expect(201);
        connection_when(&server, id, |status| status["state"] == "running").await;
    }
    let mut stream = accept(&listener).await;
    send_fixes(&server, "van", 1).await;
    let mut event = String::new();
    stream.read_line(&mut event).await.expect("an event");
    let mut datagram = vec![0; 4_096];
    let bytes = socket.recv(&mut datagram).await.expect("a datagram");
    assert_eq!(event.as_bytes(), &datagram[..bytes], "the same event of the same target");

    let track =
        server.get("/v1/cameras/gate/tracks").await.expect(200).json()["features"][0]["properties"].clone();
    let variance = |axis: &str| track["covariance"][axis].as_f64().expect("m2");
    let sigma_m = ((variance("east_m2") + variance("north_m2")) / 2.0).sqrt();
    assert_eq!(attribute(&event, "ce"), format!("{sigma_m:.2}"), "one sigma, not the 95 % radius");
    assert_eq!((attribute(&event, "hae"), attribute(&event, "le")), ("9999999.0", "9999999.0"));
    assert_eq!(attribute(&event, "uid"), "sightfix.gate.van");
    assert_eq!(
        (attribute(&event, "version"), attribute(&event, "type"), attribute(&event, "how")),
        ("2.0", "a-u-G", "m-f")
    );
    let time = |name| attribute(&event, name).parse::<jiff::Timestamp>().expect("a time");
    assert_eq!(time("stale").duration_since(time("start")).as_secs(), 20);
    assert!((attribute(&event, "lon").parse::<f64>().expect("degrees") - 103.98678).abs() < 1e-6);
    let mut reader = quick_xml::Reader::from_str(&event);
    while !matches!(reader.read_event().expect("XML"), quick_xml::events::Event::Eof) {}

    // A server that restarts is connected to again, and the uid stays.
    drop(stream);
    send_fixes(&server, "van", 1).await;
    let mut stream = accept(&listener).await;
    let mut event = String::new();
    stream.read_line(&mut event).await.expect("an event");
    assert_eq!(attribute(&event, "uid"), "sightfix.gate.van");
    let tried = server.post("/v1/connections/group/test", &json!({})).await.expect(200).json();
    assert!(
        tried["message"]["text"].as_str().expect("text").contains("sightfix.gate.sightfix-test"),
        "{tried}"
    );
    patch(&server, "tak", &json!({"paused": true})).await.expect(200);
}

#[tokio::test]
async fn onvif_frames_have_the_geolocation_of_objects() {
    let socket = UdpSocket::bind("127.0.0.1:0").await.expect("a port");
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let address = format!("udp://{}", socket.local_addr().expect("an address"));
    let sink = json!({"address": address, "format": "onvif", "camera_ids": ["gate"], "min_interval_s": 0});
    server.post("/v1/connections", &json!({"id": "vms", "sink": sink})).await.expect(201);
    connection_when(&server, "vms", |status| status["state"] == "running").await;
    send_fixes(&server, "van <1>", 1).await;
    let mut datagram = vec![0; 4_096];
    let bytes = socket.recv(&mut datagram).await.expect("a datagram");
    let frame = std::str::from_utf8(&datagram[..bytes]).expect("UTF-8");
    assert_eq!(attribute(frame, "xmlns:tt"), "http://www.onvif.org/ver10/schema");
    assert_eq!(attribute(frame, "Source"), "gate");
    assert_eq!(attribute(frame, "sf:target_id"), "van &lt;1&gt;");
    assert!(attribute(frame, "ObjectId").parse::<u32>().is_ok(), "{frame}");
    assert!(attribute(frame, "UtcTime").parse::<jiff::Timestamp>().is_ok(), "{frame}");
    assert!(attribute(frame, "sf:r95_m").parse::<f64>().expect("m") > 0.0, "{frame}");
    let degrees = |name| attribute(frame, name).parse::<f64>().expect("degrees");
    assert!((degrees("lon") - 103.98678).abs() < 1e-6 && (degrees("lat") - 30.628).abs() < 1e-2, "{frame}");
    let mut open = Vec::new();
    let mut reader = quick_xml::Reader::from_str(frame);
    loop {
        match reader.read_event().expect("XML") {
            quick_xml::events::Event::Start(element) => open.push(element.local_name().as_ref().to_owned()),
            quick_xml::events::Event::Empty(element) if element.local_name().as_ref() == "GeoLocation" => {
                break;
            }
            event => assert!(!matches!(event, quick_xml::events::Event::Eof), "{frame}"),
        }
    }
    assert_eq!(open, ["MetadataStream", "VideoAnalytics", "Frame", "Object", "Appearance"]);
}

/// A server that wants a client certificate of the authority.
pub(super) fn tls_acceptor(authority: &Authority) -> TlsAcceptor {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut roots = RootCertStore::empty();
    roots.add(authority.certificate.der().clone()).expect("an authority");
    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider.clone()).build();
    let (certificate, key) = authority.issue();
    let key = PrivateKeyDer::try_from(key.serialize_der()).expect("a key");
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_client_cert_verifier(verifier.expect("a verifier"))
        .with_single_cert(vec![certificate.der().clone()], key);
    TlsAcceptor::from(Arc::new(config.expect("a configuration")))
}

#[tokio::test]
async fn a_tak_server_is_reached_over_tls_with_a_client_certificate_and_only_if_it_is_trusted() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let port = listener.local_addr().expect("an address").port();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let (authority, other) = (Authority::new(), Authority::new());
    let acceptor = tls_acceptor(&authority);
    let (certificate, key) = authority.issue();
    let draft = json!({
        "id": "tak", "secrets": {"client_certificate": certificate.pem(), "client_key": key.serialize_pem()},
        "sink": {"address": format!("tls://localhost:{port}"), "format": "cot", "camera_ids": ["gate"],
            "min_interval_s": 0, "ca_certificate": other.certificate.pem()},
    });
    server.post("/v1/connections", &draft).await.expect(201);
    let (stream, _) = listener.accept().await.expect("the server connects");
    acceptor.accept(stream).await.expect_err("the server does not trust this certificate");
    let waiting = connection_when(&server, "tak", |status| status["state"] == "waiting").await;
    let error = waiting["status"]["last_error"]["message"].as_str().expect("an error");
    assert!(error.contains("certificate"), "{error}");

    let trust = json!({"sink": {"ca_certificate": authority.certificate.pem()}});
    patch(&server, "tak", &trust).await.expect(200);
    // Attempts of before the change may wait in the queue of the listener.
    let stream = loop {
        let (stream, _) = listener.accept().await.expect("the server connects");
        if let Ok(stream) = acceptor.accept(stream).await {
            break stream;
        }
    };
    let mut stream = BufReader::new(stream);
    send_fixes(&server, "van", 1).await;
    let mut event = String::new();
    stream.read_line(&mut event).await.expect("an event");
    assert_eq!(attribute(&event, "uid"), "sightfix.gate.van");
    let shown = server.get("/v1/connections/tak").await.expect(200).text();
    assert!(!shown.contains("PRIVATE KEY") && shown.contains("client_key"), "{shown}");
}

/// Accepts a sink's connection; a NATS server also answers its greeting.
async fn accept_sink(listener: &TcpListener, is_nats: bool) -> BufReader<TcpStream> {
    let mut stream = accept(listener).await;
    if is_nats {
        let mut line = String::new();
        while line.trim_end() != "PING" {
            line.clear();
            assert!(stream.read_line(&mut line).await.expect("a line") > 0, "the connection is closed");
        }
        stream.get_mut().write_all(b"PONG\r\n").await.expect("an answer");
    }
    stream
}

#[tokio::test]
async fn a_sink_with_nothing_to_deliver_notices_that_its_peer_has_gone() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    for scheme in ["tcp", "nats"] {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = format!("{scheme}://{}", listener.local_addr().expect("an address"));
        let sink = json!({"address": address, "camera_ids": ["gate"]});
        server.post("/v1/connections", &json!({"id": scheme, "sink": sink})).await.expect(201);
        let stream = accept_sink(&listener, scheme == "nats").await;
        connection_when(&server, scheme, |status| status["state"] == "running").await;
        drop((stream, listener));
        let status = connection_when(&server, scheme, |status| status["state"] == "waiting").await;
        assert_eq!(status["status"]["connects"], 1, "{status}");
    }
}

/// Ids of the messages that come to a webhook until the outbox is empty, each answered with 200.
async fn delivered(listener: &TcpListener, count: usize) -> Vec<String> {
    let mut ids = Vec::new();
    let mut stream = accept(listener).await;
    while ids.len() < count {
        ids.push(Hook::answered(&mut stream, 200).await.header("webhook-id").to_owned());
    }
    ids
}

/// A sink of all positions at an address where nobody listens.
async fn idle_sink(server: &TestServer, address: std::net::SocketAddr) {
    create_gate(server).await;
    let sink = json!({"address": format!("http://{address}/hook?site=1"), "camera_ids": ["gate"], "min_interval_s": 0});
    server.post("/v1/connections", &json!({"id": "hook", "sink": sink})).await.expect(201);
    connection_when(server, "hook", |status| status["state"] == "waiting").await;
}

/// While the outbox cannot be written, positions wait, and each comes once when it can be.
#[tokio::test]
async fn outages_of_the_outbox_lose_no_position() {
    let address = own_address();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    idle_sink(&server, address).await;
    let database = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    for outage in 0..3 {
        database.execute_batch("ALTER TABLE outbox RENAME TO away").expect("renamed");
        for item in 0..10 {
            send_fix(&server, &format!("van-{outage}-{item}"), &now().to_string(), 103.98678, false).await;
        }
        server.logged(|line| line.to_string().contains("positions wait for the outbox")).await;
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
        database.execute_batch("ALTER TABLE away RENAME TO outbox").expect("renamed");
        let shown = connection_when(&server, "hook", |status| status["items"] == 10 * (outage + 1)).await;
        assert_eq!(shown["status"]["dropped"], 0, "{shown}");
    }
    let listener = TcpListener::bind(address).await.expect("the address is free");
    let mut ids = delivered(&listener, 30).await;
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), 30, "each once");
    connection_when(&server, "hook", |status| status["queued"] == 0 && status["dropped"] == 0).await;
}

/// A server that starts while the database takes no changes keeps what it measures meanwhile.
#[tokio::test]
async fn a_start_while_nothing_can_be_written_loses_no_position() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    idle_sink(&server, own_address()).await;
    let database = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    let logs = || database.query_row("SELECT count(*) FROM outbox_logs", [], |row| row.get::<_, u32>(0));
    // The next server has to end the log of this one.
    while logs().expect("a number") == 0 {
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    server.kill();
    let refuse = "CREATE TRIGGER full BEFORE DELETE ON outbox_logs BEGIN SELECT RAISE(ABORT, 'full'); END";
    database.execute_batch(refuse).expect("a trigger");
    let server = TestServer::start(folder.path());
    send_fixes(&server, "van", 20).await;
    server.logged(|line| line.to_string().contains("cannot look for changed connections")).await;
    database.execute_batch("DROP TRIGGER full").expect("dropped");
    connection_when(&server, "hook", |status| status["items"] == 20).await;
}

/// A server that ends in order leaves every position in the outbox. One that is killed may lose the latest, which the next
/// one counts.
#[tokio::test]
async fn no_position_is_lost_silently_at_the_end_of_a_server() {
    let address = own_address();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    idle_sink(&server, address).await;
    send_fixes(&server, "van", 20).await;
    assert!(server.terminate(), "ends well");
    let server = TestServer::start(folder.path());
    let shown = connection_when(&server, "hook", |status| status["state"] == "waiting").await;
    assert_eq!((&shown["status"]["queued"], &shown["status"]["dropped"]), (&json!(20), &json!(0)), "{shown}");
    send_fixes(&server, "car", 20).await;
    server.kill();
    let server = TestServer::start(folder.path());
    let shown = connection_when(&server, "hook", |status| status["dropped"] == 1).await;
    println!("killed: {} of 20 were queued", shown["status"]["queued"].as_u64().expect("a number") - 20);
    server.logged(|line| line.to_string().contains("before its last positions were queued")).await;
}
