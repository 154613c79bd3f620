//! Compressed bodies, both ways, and what a body that decodes to too much costs.

use std::io::Cursor;

use async_compression::tokio::bufread::{GzipDecoder, GzipEncoder, ZstdDecoder, ZstdEncoder};
use serde_json::json;
use tokio::io::{AsyncRead, AsyncReadExt as _};

use crate::harness::{TestServer, data_folder, simulated_csv};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const SAMPLES: &str = "/v1/cameras/c/samples";

async fn all(mut reader: impl AsyncRead + Unpin) -> Vec<u8> {
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes).await.expect("memory can be read");
    bytes
}

async fn encoded(coding: &str, bytes: &[u8]) -> Vec<u8> {
    match coding {
        "gzip" => all(GzipEncoder::new(Cursor::new(bytes))).await,
        _ => all(ZstdEncoder::new(Cursor::new(bytes))).await,
    }
}

async fn decoded(coding: &str, bytes: &[u8]) -> Vec<u8> {
    match coding {
        "gzip" => all(GzipDecoder::new(Cursor::new(bytes))).await,
        _ => all(ZstdDecoder::new(Cursor::new(bytes))).await,
    }
}

async fn with_camera(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    (folder, server)
}

#[tokio::test]
async fn an_import_and_an_export_are_compressed_on_their_way() {
    let csv = simulated_csv();
    for coding in ["gzip", "zstd"] {
        let (_folder, server) = with_camera(&[]).await;
        let body = encoded(coding, csv.as_bytes()).await;
        assert!(body.len() < csv.len() / 2, "{coding}: {} of {}", body.len(), csv.len());
        let headers = [("content-type", "text/csv"), ("content-encoding", coding)];
        let report = server.send("POST", SAMPLES, &headers, body).await.expect(200).json();
        assert_eq!(report["accepted"], csv.lines().count() as u64 - 1, "{coding}");
        let plain = server.send("GET", SAMPLES, &[("accept", "text/csv")], "").await.expect(200);
        assert!(plain.headers.get("content-encoding").is_none());
        let headers = [("accept", "text/csv"), ("accept-encoding", coding)];
        let compressed = server.send("GET", SAMPLES, &headers, "").await.expect(200);
        assert_eq!(compressed.header("content-encoding"), coding);
        assert!(compressed.headers.get_all("vary").iter().any(|name| name == "accept-encoding"));
        assert!(compressed.body.len() < plain.body.len() / 2, "{coding}");
        assert_eq!(decoded(coding, &compressed.body).await, plain.body, "{coding}");
    }
}

#[tokio::test]
async fn a_body_of_json_is_decoded_too() {
    let (_folder, server) = with_camera(&[]).await;
    for (id, coding) in [("g", "gzip"), ("z", "zstd"), ("x", "GZip")] {
        let body = encoded(&coding.to_lowercase(), json!({ "id": id }).to_string().as_bytes()).await;
        let headers = [("content-type", "application/json"), ("content-encoding", coding)];
        server.send("POST", "/v1/cameras", &headers, body).await.expect(201);
    }
    let headers = [("content-type", "application/json"), ("content-encoding", "identity")];
    server.send("POST", "/v1/cameras", &headers, r#"{"id":"i"}"#).await.expect(201);
}

#[tokio::test]
async fn what_is_compressed_or_tagged_or_short_or_an_event_stream_is_left_alone() {
    let (_folder, server) = with_camera(&[]).await;
    let accepts = [("accept-encoding", "gzip, zstd")];
    let coding = async |path: &str| {
        let response = server.open("GET", path, &accepts, "").await;
        response.headers().get("content-encoding").map(|coding| coding.to_str().expect("ASCII").to_owned())
    };
    assert_eq!(coding("/openapi.json").await.as_deref(), Some("zstd"));
    assert_eq!(coding("/").await.as_deref(), Some("gzip"), "compressed when it was built");
    assert_eq!(coding("/v1/cameras/c").await, None, "its tag is that of these bytes");
    assert_eq!(coding("/livez").await, None, "short");
    assert_eq!(coding("/v1/cameras/c/events").await, None, "an event is not held back for more");
}

#[tokio::test]
async fn a_body_that_decodes_to_too_much_is_refused() {
    let limits = [("SIGHTFIX_LIMITS__IMPORT_BYTES", "1000000"), ("SIGHTFIX_LIMITS__BODY_BYTES", "100000")];
    let (_folder, server) = with_camera(&limits).await;
    for coding in ["gzip", "zstd"] {
        let bomb = encoded(coding, &vec![b' '; 100_000_000]).await;
        assert!(bomb.len() < 100_000, "{coding}: its coded length is within the limits: {}", bomb.len());
        for (path, content_type) in [(SAMPLES, "text/csv"), ("/v1/cameras", "application/json")] {
            let headers = [("content-type", content_type), ("content-encoding", coding)];
            let problem = server.send("POST", path, &headers, bomb.clone()).await.expect(413).json();
            assert_eq!(problem["type"], "urn:sightfix:problem:too-large", "{coding} {path}");
        }
    }
    server.get("/readyz").await.expect(200);
}

#[tokio::test]
async fn a_body_decodes_to_no_more_than_its_length_allows() {
    let (_folder, server) = with_camera(&[]).await;
    let refused = async |coding: &str, body: Vec<u8>| {
        let headers = [("content-type", "text/csv"), ("content-encoding", coding)];
        let problem = server.send("POST", SAMPLES, &headers, body).await.expect(413).json();
        let detail = problem["detail"].as_str().unwrap_or_default();
        assert!(detail.contains("without a content-encoding"), "{coding}: {problem}");
    };
    for coding in ["gzip", "zstd"] {
        // Well within the limit of an import.
        refused(coding, encoded(coding, &vec![b' '; 4_000_000]).await).await;
        // Each needs a decoder of its own, and gives nothing.
        refused(coding, encoded(coding, b"").await.repeat(1_000)).await;
    }
}

#[tokio::test]
async fn a_body_of_several_members_is_one() {
    let csv = simulated_csv();
    let lines: Vec<&str> = csv.split_inclusive('\n').collect();
    for coding in ["gzip", "zstd"] {
        let (_folder, server) = with_camera(&[]).await;
        let mut body = Vec::new();
        for part in lines.chunks(lines.len() / 3) {
            body.extend(encoded(coding, part.concat().as_bytes()).await);
        }
        let headers = [("content-type", "text/csv"), ("content-encoding", coding)];
        let report = server.send("POST", SAMPLES, &headers, body).await.expect(200).json();
        assert_eq!(report["accepted"], lines.len() as u64 - 1, "{coding}");
    }
}

#[tokio::test]
async fn a_body_that_is_not_of_its_coding_is_refused_and_says_so() {
    let (_folder, server) = with_camera(&[]).await;
    let whole = encoded("gzip", simulated_csv().as_bytes()).await;
    // A window of 128 MiB, which a decoder would have to hold.
    let wide = [0x28, 0xb5, 0x2f, 0xfd, 0x00, 0x88, 0x01, 0x00, 0x00];
    for (name, coding, body) in [
        ("no gzip", "gzip", b"time,target_id\n".to_vec()),
        ("cut off", "gzip", whole[..whole.len() / 2].to_vec()),
        ("no zstd", "zstd", b"time,target_id\n".to_vec()),
        ("a wide window", "zstd", wide.to_vec()),
    ] {
        let headers = [("content-type", "text/csv"), ("content-encoding", coding)];
        let problem = server.send("POST", SAMPLES, &headers, body).await.expect(400).json();
        assert!(
            problem["detail"].as_str().is_some_and(|it| it.contains("content-encoding")),
            "{name}: {problem}"
        );
    }
    for coding in ["br", "gzip, gzip", "compress"] {
        let headers = [("content-type", "text/csv"), ("content-encoding", coding)];
        let refused = server.send("POST", SAMPLES, &headers, "x").await.expect(415);
        assert_eq!(refused.header("accept-encoding"), "gzip, zstd");
        assert_eq!(refused.json()["violations"][0]["field"], "content-encoding");
    }
    assert_eq!(server.get(&format!("{SAMPLES}/count")).await.json()["count"], 0);
}

#[tokio::test]
async fn a_model_comes_back_as_it_was() {
    let (_folder, server) = with_camera(&[]).await;
    let model = std::fs::read(MODEL).expect("the model");
    let body = encoded("gzip", &model).await;
    let headers = [("content-type", "application/vnd.safetensors"), ("content-encoding", "gzip")];
    server.send("POST", "/v1/cameras/c/models", &headers, body).await.expect(201);
    let path = "/v1/cameras/c/models/1/file";
    let plain = server.get(path).await.expect(200);
    let packed = server.send("GET", path, &[("accept-encoding", "zstd")], "").await.expect(200);
    let unpacked = match packed.headers.get("content-encoding") {
        Some(_) => decoded("zstd", &packed.body).await,
        None => packed.body.to_vec(),
    };
    assert_eq!(unpacked, plain.body);
}
