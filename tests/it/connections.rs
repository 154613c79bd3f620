//! Requests and connections that a client leaves half done, holds open or floods. The server ends all the same.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use futures_util::{StreamExt as _, stream};
use http_body_util::Full;
use hyper::Request;
use hyper::body::Bytes;
use hyper::client::conn::http2;
use hyper_util::rt::{TokioExecutor, TokioIo};
use serde_json::json;
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tonic::Code;

use crate::harness::{TestServer, connect_from, data_folder};

/// Far beyond the server's own limit: a read that takes as long was never answered.
const PATIENCE: Duration = Duration::from_secs(30);

fn left_half_done(sent: &[u8]) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__HEADER_S", "1")]);
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    stream.write_all(sent).expect("the server reads");
    let mut answer = Vec::new();
    // The server closes, with or without a word; a read that times out is an error.
    match stream.read_to_end(&mut answer) {
        Ok(_) => {}
        Err(error) => assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "{error}"),
    }
    assert!(!answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
}

#[test]
fn a_silent_connection_is_closed() {
    left_half_done(b"");
}

#[test]
fn half_a_header_is_closed() {
    left_half_done(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nx-more: ");
}

#[test]
fn half_a_preface_is_closed() {
    left_half_done(b"PRI * HTTP");
}

#[test]
fn half_a_body_is_answered_or_closed() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__BODY_GRACE_S", "1")]);
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    stream
        .write_all(
            b"POST /v1/cameras HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n\
              content-length: 100\r\n\r\n{\"id\":",
        )
        .expect("the server reads");
    let mut first = [0; 12];
    stream.read_exact(&mut first).expect("an answer");
    assert!(first.starts_with(b"HTTP/1.1 4"), "{}", String::from_utf8_lossy(&first));
}

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

fn frame(kind: u8, payload: &[u8]) -> Vec<u8> {
    let length = u8::try_from(payload.len()).expect("short");
    let stream = u8::from(kind == 2); // PRIORITY belongs to a stream
    [&[0, 0, length, kind, 0, 0, 0, 0, stream], payload].concat()
}

#[test]
fn floods_of_control_frames_end_the_connection() {
    let folder = data_folder();
    let settings =
        [("SIGHTFIX_LIMITS__CONTROL_FRAMES_PER_S", "100"), ("SIGHTFIX_LIMITS__FLOOD_PENALTY_S", "0")];
    let server = TestServer::start_with(folder.path(), &settings);
    for flood in [
        frame(2, &[0, 0, 0, 3, 1]), // PRIORITY
        frame(4, &[]),              // SETTINGS
        frame(6, &[7; 8]),          // PING
        frame(8, &[0, 0, 0, 1]),    // WINDOW_UPDATE
        frame(20, &[]),             // unknown
    ] {
        let mut stream = TcpStream::connect(server.address).expect("the server listens");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        stream.write_all(PREFACE).expect("the server reads");
        let mut reader = stream.try_clone().expect("a second handle");
        // The server's bytes must be read, or it ends the connection for that.
        let reading = std::thread::spawn(move || {
            let mut read = [0; 4_096];
            loop {
                match reader.read(&mut read) {
                    Ok(0) => return true,
                    Ok(_) => {}
                    Err(error) => return error.kind() == std::io::ErrorKind::ConnectionReset,
                }
            }
        });
        let many = flood.repeat(1_000);
        let mut written = 0;
        while written < 100 && stream.write_all(&many).is_ok() {
            written += 1;
        }
        assert!(reading.join().expect("no panic"), "frames of type {} never end", flood[3]);
    }
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.write_all(b"GET /metrics HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").expect("read");
    let mut metrics = String::new();
    stream.read_to_string(&mut metrics).expect("an answer");
    assert!(metrics.contains("sightfix_connections_closed_total{reason=\"flooded\"} 5"), "{metrics}");
}

#[tokio::test]
async fn a_connection_that_only_answers_pings_is_closed() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__IDLE_S", "1")]);
    let stream = connect_from([127, 0, 0, 1], server.address).await;
    let (_client, connection) =
        http2::handshake::<_, _, Full<Bytes>>(TokioExecutor::new(), TokioIo::new(stream))
            .await
            .expect("HTTP/2");
    let closed = tokio::time::timeout(PATIENCE, connection).await;
    closed.expect("it is closed").expect("in order");
}

/// A server with a camera and more samples than a socket buffers of their export.
async fn with_samples(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let mut csv = "target_id,time,left,top,width,height,longitude,latitude\n".to_owned();
    for row in 0..60_000 {
        let (minute, second) = (row / 60 % 60, row % 60);
        let (day, hour) = (1 + row / 86_400, row / 3_600 % 24);
        csv.push_str(&format!(
            "{},2026-01-{day:02}T{hour:02}:{minute:02}:{second:02}Z,1,2,3,4,103.9,30.6\n",
            "a".repeat(100)
        ));
    }
    let headers = [("content-type", "text/csv")];
    let report = server.send("POST", "/v1/cameras/c/samples", &headers, csv).await.expect(200).json();
    assert_eq!(report["accepted"], 60_000, "{report}");
    (folder, server)
}

const EXPORT: &str =
    "GET /v1/cameras/c/samples HTTP/1.1\r\nhost: localhost\r\naccept: application/x-ndjson\r\n\r\n";

/// Waits until the server has closed that many connections because their clients did not read.
async fn until_stalled(server: &TestServer, count: u32) {
    let wanted = format!("sightfix_connections_closed_total{{reason=\"stalled\"}} {count}");
    let looking = async {
        while !server.get("/metrics").await.expect(200).text().lines().any(|line| line == wanted) {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    tokio::time::timeout(PATIENCE, looking).await.expect("the connection is closed");
}

#[tokio::test]
async fn readers_that_never_read_are_closed() {
    let (_folder, server) = with_samples(&[("SIGHTFIX_LIMITS__IDLE_S", "1")]).await;
    let mut http_1 = connect_from([127, 0, 0, 1], server.address).await;
    http_1.write_all(EXPORT.as_bytes()).await.expect("the server reads");
    until_stalled(&server, 1).await;

    let stream = TokioIo::new(connect_from([127, 0, 0, 1], server.address).await);
    let (mut client, connection) = http2::Builder::new(TokioExecutor::new())
        .initial_stream_window_size(1_024)
        .handshake::<_, Full<Bytes>>(stream)
        .await
        .expect("HTTP/2");
    let connection = tokio::spawn(connection);
    let request = Request::get(format!("http://{}/v1/cameras/c/samples", server.address))
        .header("accept", "application/x-ndjson");
    let unread =
        client.send_request(request.body(Full::default()).expect("a request")).await.expect("a head");
    let closed = tokio::time::timeout(PATIENCE, connection).await;
    let _ = closed.expect("the connection is closed, though pings are answered");
    until_stalled(&server, 2).await;
    drop(unread);
}

async fn first_line(mut stream: tokio::net::TcpStream, path: &str) -> String {
    let request = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n");
    stream.write_all(request.as_bytes()).await.expect("the server reads");
    let mut first = [0; 12];
    stream.read_exact(&mut first).await.expect("an answer");
    String::from_utf8_lossy(&first).into_owned()
}

#[tokio::test]
async fn one_address_gets_no_more_than_its_share_of_connections() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CONNECTIONS", "6")]);
    let greedy = [127, 0, 0, 2];
    let mut held = Vec::new();
    for _ in 0..3 {
        held.push(connect_from(greedy, server.address).await);
    }
    let refused = connect_from(greedy, server.address).await;
    assert_eq!(first_line(refused, "/v1/cameras").await, "HTTP/1.1 503");
    let probe = connect_from(greedy, server.address).await;
    assert_eq!(first_line(probe, "/livez").await, "HTTP/1.1 200");
    let other = connect_from([127, 0, 0, 1], server.address).await;
    assert_eq!(first_line(other, "/v1/cameras").await, "HTTP/1.1 200");
}

#[tokio::test]
async fn one_address_gets_no_more_than_its_share_of_live_streams() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__LIVE_STREAMS", "4")]);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let mut held = Vec::new();
    let mut open = async |address: [u8; 4], name: &str| {
        let endpoint = server.endpoint();
        let endpoint = endpoint.local_address(Some(address.into()));
        let opening = proto::StreamOpening {
            camera_id: "c".to_owned(),
            client_name: name.to_owned(),
            ..proto::StreamOpening::default()
        };
        let kind = Some(proto::stream_request::Kind::Opening(opening));
        let first = stream::iter([proto::StreamRequest { kind }]).chain(stream::pending());
        let mut client = FusionServiceClient::new(endpoint.connect().await.expect("a connection"));
        let mut reported = client.stream(first).await.expect("errors come as the end").into_inner();
        let opened = reported.message().await.map(drop).map_err(|status| status.code());
        held.push(reported);
        opened
    };
    assert_eq!(open([127, 0, 0, 2], "first").await, Ok(()));
    assert_eq!(open([127, 0, 0, 2], "second").await, Ok(()));
    assert_eq!(open([127, 0, 0, 2], "third").await, Err(Code::Unavailable), "names are free to invent");
    assert_eq!(open([127, 0, 0, 1], "fourth").await, Ok(()));
}

#[cfg(target_os = "linux")]
#[test]
fn clients_that_come_at_once_need_not_wait_for_the_server() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    // A server that is stopped accepts nothing: what connects now, the system has queued.
    server.signal("-STOP");
    let connected = (0..500)
        .map_while(|_| TcpStream::connect_timeout(&server.address, Duration::from_secs(5)).ok())
        .collect::<Vec<_>>()
        .len();
    server.signal("-CONT");
    assert_eq!(connected, 500);
}

#[tokio::test]
async fn stalled_clients_do_not_keep_the_server_from_shutting_down_in_order() {
    let (_folder, server) = with_samples(&[("SIGHTFIX_LIMITS__DRAIN_S", "2")]).await;
    let mut reader = connect_from([127, 0, 0, 1], server.address).await;
    reader.write_all(EXPORT.as_bytes()).await.expect("the server reads");
    let mut sender = connect_from([127, 0, 0, 1], server.address).await;
    let half = b"POST /v1/cameras HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n\
                 content-length: 100\r\n\r\n{\"id\":";
    sender.write_all(half).await.expect("the server reads");
    let mut some = [0; 1];
    reader.read_exact(&mut some).await.expect("the export begins");
    server.get("/livez").await.expect(200);
    let ended = tokio::task::spawn_blocking(|| server.terminate()).await.expect("no panic");
    assert!(ended, "the exit code is 0");
    let mut answer = [0; 12];
    sender.read_exact(&mut answer).await.expect("an answer");
    assert_eq!(&answer, b"HTTP/1.1 503");
}

#[test]
fn the_server_shuts_down_before_a_container_is_killed() {
    let settings: toml::Value = toml::from_str(&crate::harness::run(&["config"])).expect("TOML");
    let drain_s = settings["limits"]["drain_s"].as_integer().expect("seconds");
    assert!(drain_s <= 8, "Docker kills after 10 s, and the database takes its time to close: {drain_s}");
}

#[cfg(unix)]
#[tokio::test]
async fn a_hangup_does_not_end_the_server() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.signal("-HUP");
    server.get("/livez").await.expect(200);
    assert!(server.terminate(), "it still ends in order");
}
