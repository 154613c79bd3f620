//! More is asked of the server than it takes: who is still answered, and what the others are answered.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use futures_util::{StreamExt as _, stream};
use http_body_util::{BodyExt, Full, StreamBody};
use hyper::body::{Bytes, Frame};
use hyper::client::conn::http2;
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioExecutor, TokioIo};
use serde_json::{Value, json};
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::task::JoinSet;
use tonic::Code;

use crate::harness::{TestServer, connect_from, data_folder, import_message};

/// An address of a client that is up to no good.
const GREEDY: [u8; 4] = [127, 0, 0, 2];

async fn with_camera(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    let profile = json!({"id": "c", "image_size": {"width_px": 640, "height_px": 480}});
    server.post("/v1/cameras", &profile).await.expect(201);
    (folder, server)
}

fn fix() -> Value {
    json!({"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": 103.9, "latitude_deg": 30.6}})
}

type SlowBody = http_body_util::combinators::BoxBody<Bytes, Infallible>;

/// An HTTP/2 connection with `uploads` uploads that have sent one byte and send no other. Gives back
/// the task that holds it open.
async fn slow_uploads(server: SocketAddr, uploads: usize) -> JoinSet<()> {
    let stream = TokioIo::new(connect_from(GREEDY, server).await);
    let (mut client, connection) = http2::handshake(TokioExecutor::new(), stream).await.expect("HTTP/2");
    let mut held = JoinSet::new();
    held.spawn(async move { drop(connection.await) });
    for _ in 0..uploads {
        client.ready().await.expect("another stream");
        let first = stream::iter([Ok::<_, Infallible>(Frame::data(Bytes::from_static(b"{")))]);
        let body: SlowBody = BodyExt::boxed(StreamBody::new(first.chain(stream::pending())));
        let request = Request::post(format!("http://{server}/v1/cameras"))
            .header("content-type", "application/json")
            .body(body)
            .expect("a request");
        let response = client.send_request(request);
        held.spawn(async move { drop(response.await) });
    }
    // Frames are read in their order: once this is answered, the uploads have begun.
    let probe = Request::get(format!("http://{server}/livez"));
    let probe = probe.body(BodyExt::boxed(Full::new(Bytes::new()))).expect("a request");
    client.ready().await.expect("another stream");
    client.send_request(probe).await.expect("an answer");
    held.spawn(async move {
        let _client = client;
        std::future::pending().await
    });
    held
}

#[tokio::test]
async fn slow_uploads_keep_no_other_request_from_being_answered() {
    let (_folder, server) = with_camera(&[]).await;
    let mut held = Vec::new();
    for _ in 0..5 {
        held.push(slow_uploads(server.address, 250).await);
    }
    for path in ["/livez", "/readyz", "/metrics", "/v1/cameras", "/v1/cameras/c"] {
        let answer = server.get(path).await;
        assert_eq!(answer.status, StatusCode::OK, "{path}: {}", answer.text());
    }
    let answer = server.post("/v1/cameras/c/fusions", &fix()).await;
    assert_ne!(answer.status, StatusCode::SERVICE_UNAVAILABLE, "{}", answer.text());
}

/// Sends a request in pieces, and gives the first line of the answer.
async fn trickled(server: SocketAddr, head: &str, pieces: usize, piece: &[u8]) -> String {
    let stream = connect_from(GREEDY, server).await;
    let (mut read, mut write) = stream.into_split();
    write.write_all(head.as_bytes()).await.expect("the server reads");
    let piece = piece.to_vec();
    let sending = tokio::spawn(async move {
        for _ in 0..pieces {
            if write.write_all(&piece).await.is_err() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let mut first = [0; 12];
    read.read_exact(&mut first).await.expect("an answer");
    sending.abort();
    String::from_utf8_lossy(&first).into_owned()
}

#[tokio::test]
async fn a_body_that_trickles_is_refused() {
    let settings = [("SIGHTFIX_LIMITS__BODY_GRACE_S", "1"), ("SIGHTFIX_LIMITS__BODY_BYTES_PER_S", "1000")];
    let (_folder, server) = with_camera(&settings).await;
    for path in ["/v1/cameras", "/v1/cameras/c/samples"] {
        let content_type = if path.ends_with("samples") { "text/csv" } else { "application/json" };
        let head = format!(
            "POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\n\
             content-length: 2000\r\n\r\n"
        );
        assert_eq!(trickled(server.address, &head, 200, b"          ").await, "HTTP/1.1 408", "{path}");
    }
}

#[tokio::test]
async fn an_import_stream_that_stalls_reports_what_is_stored() {
    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__BODY_GRACE_S", "1")]).await;
    let channel = server.channel().await;
    let first = import_message();
    let messages = stream::iter([first]).chain(stream::pending());
    let status = SampleServiceClient::new(channel).import_samples(messages).await.expect_err("it stalls");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    assert!(status.message().contains("too slowly"), "{status:?}");
    assert!(status.message().contains("1 rows before it are stored"), "{status:?}");
    let count = server.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 1);
}

/// An import that has sent a mebibyte and sends no more.
async fn stalled_import(server: SocketAddr) -> tokio::net::TcpStream {
    let mut stream = connect_from(GREEDY, server).await;
    let head = "POST /v1/cameras/c/samples HTTP/1.1\r\nhost: localhost\r\ncontent-type: text/csv\r\n\
                content-length: 3000000\r\n\r\n";
    stream.write_all(head.as_bytes()).await.expect("the server reads");
    stream.write_all(&vec![b' '; 1 << 20]).await.expect("the server reads");
    stream
}

#[tokio::test]
async fn stalled_imports_hold_no_more_than_their_share_of_memory_and_disk() {
    let settings = [
        ("SIGHTFIX_LIMITS__IMPORT_MEMORY_BYTES", "65536"),
        ("SIGHTFIX_LIMITS__SPOOL_MEMORY_BYTES", "262144"),
        ("SIGHTFIX_LIMITS__SPOOL_DISK_BYTES", "8388608"),
    ];
    let (_folder, server) = with_camera(&settings).await;
    let mut stalled = Vec::new();
    for _ in 0..3 {
        stalled.push(stalled_import(server.address).await);
    }
    // Half of eight mebibytes is the share of one address, and this makes four and more.
    let mut refused = stalled_import(server.address).await;
    refused.write_all(&vec![b' '; 3_000_000 - (1 << 20)]).await.expect("the server reads");
    let mut first = [0; 12];
    refused.read_exact(&mut first).await.expect("an answer");
    assert_eq!(&first, b"HTTP/1.1 503");

    let csv = "target_id,time,left,top,width,height,longitude,latitude\n\
               a,2026-01-01T00:00:00Z,1,2,3,4,103.9,30.6\n";
    let headers = [("content-type", "text/csv")];
    let csv = format!("{csv}{}", " \n".repeat(1 << 20));
    let report = server.send("POST", "/v1/cameras/c/samples", &headers, csv).await.expect(200).json();
    assert_eq!(report["accepted"], 1, "another address has its own share: {report}");
}

/// Keeps requests waiting for the database's lock, so that they hold every place that is not reserved.
struct Busy {
    _lock: rusqlite::Connection,
    _requests: JoinSet<()>,
}

fn keep_busy(folder: &Path, server: SocketAddr) -> Busy {
    let lock = rusqlite::Connection::open(folder.join("sightfix.db")).expect("the database");
    lock.execute_batch("BEGIN IMMEDIATE").expect("nobody writes");
    let mut requests = JoinSet::new();
    for _ in 0..6 {
        requests.spawn(async move {
            let request = "PATCH /v1/cameras/c HTTP/1.1\r\nhost: localhost\r\ncontent-length: 2\r\n\
                           content-type: application/json\r\nif-match: *\r\nconnection: close\r\n\r\n{}";
            loop {
                let mut stream = connect_from(GREEDY, server).await;
                let mut answer = Vec::new();
                if stream.write_all(request.as_bytes()).await.is_ok() {
                    let _ = stream.read_to_end(&mut answer).await;
                }
            }
        });
    }
    Busy { _lock: lock, _requests: requests }
}

#[tokio::test]
async fn under_overload_probes_and_fusions_are_answered_and_others_read_why_not() {
    let settings = [
        ("SIGHTFIX_LIMITS__REQUESTS", "2"),
        ("SIGHTFIX_LIMITS__RESERVED_REQUESTS", "1"),
        ("SIGHTFIX_LIMITS__CLIENT_SHARE", "1"),
    ];
    let (folder, server) = with_camera(&settings).await;
    let _busy = keep_busy(folder.path(), server.address);
    let refused = loop {
        let answer = server.get("/v1/cameras/c").await;
        if answer.status == StatusCode::SERVICE_UNAVAILABLE {
            break answer;
        }
    };
    assert_eq!(refused.header("retry-after"), "1");
    assert!(refused.json()["type"].as_str().is_some_and(|kind| kind.ends_with("overloaded")));
    for _ in 0..150 {
        for path in ["/livez", "/readyz", "/metrics"] {
            server.get(path).await.expect(200);
        }
        let answer = server.post("/v1/cameras/c/fusions", &fix()).await;
        assert_ne!(answer.status, StatusCode::SERVICE_UNAVAILABLE, "{}", answer.text());
    }
}

#[tokio::test]
async fn a_refused_upload_is_read_so_that_its_client_sees_the_refusal() {
    let (_folder, server) = with_camera(&[
        ("SIGHTFIX_LIMITS__REQUEST_MEMORY_BYTES", "40000"),
        ("SIGHTFIX_LIMITS__CLIENT_SHARE", "1"),
    ])
    .await;
    // Three requests of 16 KiB each are more than 40 kB.
    let held = slow_uploads(server.address, 2).await;
    let mut stream = connect_from([127, 0, 0, 1], server.address).await;
    let head = "POST /v1/cameras/c/samples HTTP/1.1\r\nhost: localhost\r\ncontent-type: text/csv\r\n\
                content-length: 8388608\r\n\r\n";
    stream.write_all(head.as_bytes()).await.expect("the server reads");
    stream.write_all(&vec![b' '; 8 << 20]).await.expect("the server reads all of it");
    let mut first = [0; 12];
    stream.read_exact(&mut first).await.expect("an answer");
    assert_eq!(&first, b"HTTP/1.1 503");
    drop(held);
}
