//! Mutated messages and files, sent to the real binary.

use http_body_util::{BodyExt as _, Full};
use hyper::body::Bytes;
use hyper::client::conn::http2;
use hyper::{Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use super::mutations::{iterations, mutated};
use super::targets::{TARGETS, protobuf_seeds};
use crate::harness::{TestServer, connect_from, data_folder};

/// Codes of a server that failed: UNKNOWN, INTERNAL, DATA_LOSS.
const FAILED: [&str; 3] = ["2", "13", "15"];

/// The status of a whole answer, in its header or its trailers.
async fn grpc_status(response: Response<hyper::body::Incoming>) -> String {
    let text = |value: &hyper::http::HeaderValue| value.to_str().expect("a number").to_owned();
    let header = response.headers().get("grpc-status").map(text);
    let body = response.into_body().collect().await.expect("a whole answer");
    let trailer = body.trailers().and_then(|trailers| trailers.get("grpc-status")).map(text);
    header.or(trailer).expect("every answer has a status")
}

#[tokio::test]
async fn mutated_messages_are_answered_or_refused() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let stream = TokioIo::new(connect_from([127, 0, 0, 1], server.address).await);
    let (mut client, connection) = http2::handshake(TokioExecutor::new(), stream).await.expect("HTTP/2");
    tokio::spawn(connection);
    let (seeds, mut random) = (protobuf_seeds(), ChaCha8Rng::seed_from_u64(2));
    for iteration in 0..iterations() {
        let message = mutated(&seeds, &mut random);
        let length = u32::try_from(message.len()).expect("short").to_be_bytes();
        let frame = [&[0][..], &length, &message].concat();
        let path = ["FusionService/Fuse", "CameraService/CreateCamera", "SampleService/ImportSamples"]
            [iteration as usize % 3];
        let request = Request::post(format!("http://{}/sightfix.v1.{path}", server.address))
            .header("content-type", "application/grpc")
            .header("te", "trailers")
            .body(Full::new(Bytes::from(frame)))
            .expect("a request");
        client.ready().await.expect("the connection stays");
        let status = grpc_status(client.send_request(request).await.expect("an answer")).await;
        assert!(!FAILED.contains(&status.as_str()), "{path}: {status} for {message:?}");
    }
    assert_eq!(server.log_lines("a request failed"), Vec::<String>::new());
}

#[tokio::test]
async fn mutated_files_are_imported_or_refused() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for (target, path, content_type) in [
        ("csv", "/v1/cameras/c/samples", "text/csv"),
        ("ndjson", "/v1/cameras/c/samples", "application/x-ndjson"),
        ("json", "/v1/cameras/c/fusions", "application/json"),
        ("json", "/v1/cameras/c/tracks", "application/json"),
        ("nmea", "/v1/cameras/c/gnss-error", "application/nmea"),
        ("gpx", "/v1/cameras/c/gnss-error", "application/gpx+xml"),
        ("model", "/v1/cameras/c/models", "application/octet-stream"),
    ] {
        let seeds = TARGETS.iter().find(|known| known.name == target).map(|known| (known.seeds)());
        let seeds = seeds.expect("a target");
        for _ in 0..iterations() / 10 {
            let input = mutated(&seeds, &mut random);
            let answer = server.send("POST", path, &[("content-type", content_type)], input.clone()).await;
            let shown = String::from_utf8_lossy(&input);
            assert!(answer.status.as_u16() < 500, "{path}: {} for {shown:.2000}", answer.text());
        }
    }
    assert_eq!(server.log_lines("a request failed"), Vec::<String>::new());
}
