//! Limits of the settings at their edges: what is just allowed, and what is one too many.

use std::path::Path;

use futures_util::{StreamExt as _, stream};
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use tempfile::TempDir;
use tonic::metadata::AsciiMetadataValue;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::harness::{Answer, TestServer, data_folder, import_message, run, simulated_csv};

const JSON: (&str, &str) = ("content-type", "application/json");
const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";

async fn with_camera(settings: &[(&str, &str)]) -> (TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    (folder, server)
}

#[track_caller]
fn kind(answer: Answer, status: u16) -> String {
    let problem = answer.expect(status).json();
    problem["type"].as_str().expect("a type").trim_start_matches("urn:sightfix:problem:").to_owned()
}

/// Keys of two operators, made by the command line.
fn two_keys(folder: &Path) -> [String; 2] {
    ["one", "other"].map(|name| {
        let data = folder.to_str().expect("UTF-8");
        let key = run(&["keys", "create", "--name", name, "--role", "operator", "--data", data]);
        format!("Bearer {}", key.trim())
    })
}

async fn get(server: &TestServer, path: &str, key: &str) -> Answer {
    server.send("GET", path, &[("authorization", key)], "").await
}

#[tokio::test]
async fn each_key_and_each_address_has_its_own_rate_of_requests() {
    let folder = data_folder();
    let [one, other] = two_keys(folder.path());
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__REQUESTS_PER_S", "2")]);
    let refused = loop {
        let answer = get(&server, "/v1/cameras", &one).await;
        if answer.status != 200 {
            break answer;
        }
    };
    assert_eq!(refused.header("retry-after"), "1");
    assert_eq!(kind(refused, 429), "rate-limited");
    get(&server, "/v1/cameras", &other).await.expect(200);
    for _ in 0..20 {
        get(&server, "/livez", &one).await.expect(200);
        get(&server, "/metrics", &one).await.expect(200);
    }
    // Guesses of keys count for the address.
    let guess = "Bearer sf_0000000000000000000000000000000000000";
    let refused = loop {
        let answer = get(&server, "/v1/cameras", guess).await;
        if answer.status != 401 {
            break answer;
        }
    };
    assert_eq!(kind(refused, 429), "rate-limited");
    get(&server, "/v1/cameras", &other).await.expect(200);

    let status = loop {
        if let Err(status) = list_cameras(&server, &one).await {
            break status;
        }
    };
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    let details = status.get_error_details();
    assert_eq!(details.error_info().expect("ErrorInfo").reason, "rate-limited");
    let delay = details.retry_info().and_then(|retry| retry.retry_delay).expect("RetryInfo");
    assert_eq!(delay, std::time::Duration::from_secs(1));
}

fn with_key<T>(message: T, key: &str) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    request.metadata_mut().insert("authorization", AsciiMetadataValue::try_from(key).expect("ASCII"));
    request
}

async fn list_cameras(server: &TestServer, key: &str) -> Result<(), Status> {
    let mut cameras = CameraServiceClient::new(server.channel().await);
    cameras.list_cameras(with_key(proto::ListCamerasRequest::default(), key)).await.map(drop)
}

#[tokio::test]
async fn clients_behind_a_trusted_proxy_are_told_apart() {
    let rate = ("SIGHTFIX_LIMITS__REQUESTS_PER_S", "2");
    // True if one of many requests is refused, each with its own value of the header.
    let is_limited = async |server: &TestServer, forwarded: fn(u8) -> String| {
        for number in 0..50 {
            let headers = [("x-forwarded-for", &*forwarded(number))];
            match server.send("GET", "/v1/cameras", &headers, "").await.status.as_u16() {
                429 => return true,
                status => assert_eq!(status, 200),
            }
        }
        false
    };
    let folder = data_folder();
    let server =
        TestServer::start_with(folder.path(), &[rate, ("SIGHTFIX_TRUSTED_PROXIES", "10.0.0.0/8,127.0.0.1")]);
    assert!(is_limited(&server, |_| "198.51.100.1".to_owned()).await, "one client");
    assert!(!is_limited(&server, |number| format!("203.0.113.{number}")).await, "many clients");
    let made_up = |number| format!("203.0.113.{number}, 198.51.100.2, 10.1.2.3");
    assert!(is_limited(&server, made_up).await, "one client that makes up the first entry");

    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[rate]);
    assert!(is_limited(&server, |number| format!("203.0.113.{number}")).await, "no proxy is trusted");
}

#[tokio::test]
async fn each_key_has_its_share_of_streams_and_event_readers() {
    let folder = data_folder();
    let [one, other] = two_keys(folder.path());
    let settings = [
        ("SIGHTFIX_LIMITS__LIVE_STREAMS", "4"),
        ("SIGHTFIX_LIMITS__EVENT_STREAMS", "4"),
        ("SIGHTFIX_LIMITS__CLIENT_SHARE", "0.25"),
    ];
    let server = TestServer::start_with(folder.path(), &settings);
    let headers = [JSON, ("authorization", &*one)];
    server.send("POST", "/v1/cameras", &headers, json!({"id": "c"}).to_string()).await.expect(201);

    let events =
        async |key: &str| server.open("GET", "/v1/cameras/c/events", &[("authorization", key)], "").await;
    let held = [events(&one).await, events(&other).await];
    assert!(held.iter().all(|response| response.status() == 200), "each its first");
    assert_eq!(events(&one).await.status(), 503);

    let open = async |key: &str, address: [u8; 4]| {
        let channel =
            server.endpoint().local_address(Some(address.into())).connect().await.expect("a connection");
        let opening = proto::StreamOpening {
            camera_id: "c".to_owned(),
            client_name: "name".to_owned(),
            ..proto::StreamOpening::default()
        };
        let kind = Some(proto::stream_request::Kind::Opening(opening));
        let messages = stream::iter([proto::StreamRequest { kind }]).chain(stream::pending());
        let opened = FusionServiceClient::new(channel).stream(with_key(messages, key)).await;
        let mut responses = opened.expect("errors come as the end").into_inner();
        responses.message().await.map(|_| responses).map_err(|status| status.code())
    };
    let opened = [open(&one, [127, 0, 0, 1]).await, open(&other, [127, 0, 0, 1]).await];
    assert!(opened.iter().all(Result::is_ok), "one address, two keys");
    let refused = open(&one, [127, 0, 0, 2]).await.err();
    assert_eq!(refused, Some(Code::Unavailable), "another address, the same key");
}

#[tokio::test]
async fn bodies_headers_and_pages_have_their_exact_limits() {
    let settings = [
        ("SIGHTFIX_LIMITS__BODY_BYTES", "1000"),
        ("SIGHTFIX_LIMITS__HEADER_BYTES", "16384"),
        ("SIGHTFIX_LIMITS__PAGE_ITEMS", "3"),
        ("SIGHTFIX_LIMITS__REJECTED_ROWS", "2"),
    ];
    let (_folder, server) = with_camera(&settings).await;
    let padded = |id: &str, length: usize| format!("{:<length$}", json!({"id": id}).to_string());
    server.send("POST", "/v1/cameras", &[JSON], padded("full", 1_000)).await.expect(201);
    assert_eq!(
        kind(server.send("POST", "/v1/cameras", &[JSON], padded("more", 1_001)).await, 413),
        "too-large"
    );

    let with_header = async |bytes: usize| {
        server.send("GET", "/v1/cameras", &[("x-padding", &"y".repeat(bytes))], "").await.status.as_u16()
    };
    assert_eq!((with_header(15_500).await, with_header(16_384).await), (200, 431));

    server.get("/v1/cameras?limit=3").await.expect(200);
    assert_eq!(kind(server.get("/v1/cameras?limit=4").await, 422), "invalid-argument");

    for (bad_rows, reported) in [(2, 2), (3, 2)] {
        let csv = format!("{HEADER}{}", "now,a,1,2,3,4,103.9,30.6\n".repeat(bad_rows));
        let answer = server.send("POST", "/v1/cameras/c/samples", &[("content-type", "text/csv")], csv).await;
        let report = answer.expect(200).json();
        let listed = report["rejected_rows"].as_array().expect("a list").len();
        assert_eq!((&report["rejected"], listed), (&json!(bad_rows), reported), "{report}");
    }
}

#[tokio::test]
async fn a_request_that_takes_too_long_is_answered_in_time() {
    let (folder, server) = with_camera(&[("SIGHTFIX_LIMITS__REQUEST_S", "1")]).await;
    let lock = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    lock.execute_batch("BEGIN IMMEDIATE").expect("nobody writes");
    let slow = server.post("/v1/cameras", &json!({"id": "d"})).await;
    assert_eq!(kind(slow, 408), "timeout");
    lock.execute_batch("ROLLBACK").expect("the lock is given back");
    server.get("/v1/cameras/c").await.expect(200);
}

#[tokio::test]
async fn compressed_messages_of_grpc_are_not_read() {
    let (_folder, server) = with_camera(&[]).await;
    let channel = server.channel().await;
    let mut request = tonic::Request::new(proto::ListCamerasRequest::default());
    request.metadata_mut().insert("grpc-encoding", AsciiMetadataValue::from_static("gzip"));
    let status = CameraServiceClient::new(channel).list_cameras(request).await;
    assert_eq!(status.map(drop).map_err(|status| status.code()), Err(Code::Unimplemented));
}

#[tokio::test]
async fn import_streams_have_their_limit() {
    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__IMPORT_STREAMS", "1")]).await;
    let channel = server.channel().await;
    let message = import_message();
    let (sender, receiver) = tokio::sync::oneshot::channel::<()>();
    // One message, and an end that waits.
    let held = stream::iter([message.clone()]).chain(stream::once(receiver).filter_map(async |_| None));
    let held = Box::pin(held);
    let mut first = SampleServiceClient::new(channel.clone());
    let first = tokio::spawn(async move { first.import_samples(held).await });
    while server.get("/v1/cameras/c/samples/count").await.expect(200).json()["count"] != 1 {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let mut other = SampleServiceClient::new(channel);
    let refused =
        other.import_samples(stream::iter([message.clone()])).await.expect_err("there is one place");
    assert_eq!(refused.code(), Code::Unavailable, "{refused:?}");
    let details = refused.get_error_details();
    assert!(details.retry_info().is_some(), "{refused:?}");
    drop(sender);
    first.await.expect("no panic").expect("the first goes on to its end");
    other.import_samples(stream::iter([message])).await.expect("the place is free again");
}

async fn import_simulated(server: &TestServer, camera: &str) {
    let path = format!("/v1/cameras/{camera}/samples");
    server.send("POST", &path, &[("content-type", "text/csv")], simulated_csv()).await.expect(200);
}

#[tokio::test]
async fn runs_and_evaluations_have_their_limits() {
    let settings = [
        ("SIGHTFIX_LIMITS__LIVE_RUNS", "1"),
        ("SIGHTFIX_LIMITS__EPOCHS", "10000"),
        ("SIGHTFIX_LIMITS__ENDED_RUNS_PER_CAMERA", "1"),
        ("SIGHTFIX_LIMITS__ENDED_EVALUATIONS", "1"),
        ("SIGHTFIX_LIMITS__EVALUATION_SEEDS", "2"),
        ("SIGHTFIX_LIMITS__TRUTH_LINE_POSITIONS", "3"),
    ];
    let (_folder, server) = with_camera(&settings).await;
    server.post("/v1/cameras", &json!({"id": "d"})).await.expect(201);
    import_simulated(&server, "c").await;
    import_simulated(&server, "d").await;
    let runs = "/v1/cameras/c/training-runs";
    assert_eq!(kind(server.post(runs, &json!({"epochs": 10_001})).await, 422), "invalid-argument");
    let long = server.post(runs, &json!({"recipe": "paper", "epochs": 10_000})).await.expect(202);
    let other = server.post("/v1/cameras/d/training-runs", &json!({"recipe": "projective"})).await;
    assert_eq!(kind(other, 503), "overloaded");
    server.post(&format!("{}/cancel", long.header("location")), &json!({})).await.expect(200);
    while server.get(long.header("location")).await.expect(200).json()["state"] != "cancelled" {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    let second = server.train("c", &json!({"recipe": "projective", "epochs": 2})).await;
    let third = server.train("c", &json!({"recipe": "projective", "epochs": 2})).await;
    let kept: Value = server.get(runs).await.expect(200).json();
    let ids: Vec<&Value> = kept["items"].as_array().expect("a list").iter().map(|run| &run["id"]).collect();
    assert_eq!(ids, [&third["id"], &second["id"]], "the start of the third has deleted the first");

    let line = |positions: usize| {
        vec![[24.7, 59.4]; positions]
            .iter()
            .enumerate()
            .map(|(index, [longitude, latitude])| json!([longitude + 1e-4 * index as f64, latitude]))
            .collect::<Vec<_>>()
    };
    let evaluate = async |extra: Value| {
        let mut body = json!({"camera_id": "c", "methods": ["gnss"]});
        body.as_object_mut().expect("an object").extend(extra.as_object().expect("an object").clone());
        server.post("/v1/evaluations", &body).await
    };
    assert_eq!(kind(evaluate(json!({"seeds": 3})).await, 422), "invalid-argument");
    let too_long = evaluate(json!({"truth_line": line(4)})).await;
    assert!([413, 422].contains(&too_long.status.as_u16()), "{}", too_long.text());
    let mut last = String::new();
    for allowed in [json!({}), json!({"seeds": 2}), json!({"truth_line": line(3)})] {
        last = evaluate(allowed).await.expect(202).header("location").to_owned();
        while matches!(
            server.get(&last).await.expect(200).json()["state"].as_str(),
            Some("queued" | "running")
        ) {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }
    let kept = server.get("/v1/evaluations").await.expect(200).json();
    let kept = kept["items"].as_array().expect("a list");
    assert_eq!(kept.len(), 2, "the start of the third has deleted the first");
    assert!(last.ends_with(kept[0]["id"].as_str().expect("an id")));
}

#[tokio::test]
async fn a_track_keeps_its_latest_points() {
    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__TRACK_POINTS", "3")]).await;
    let observations: Vec<Value> = (0..10)
        .map(|second| {
            let fix = json!({"longitude_deg": 24.7453, "latitude_deg": 59.4371 + 1e-5 * f64::from(second)});
            json!({"time": format!("2026-01-01T00:00:{second:02}Z"), "target_id": "walker", "fix": fix})
        })
        .collect();
    server.post("/v1/cameras/c/tracks", &json!({"observations": observations})).await.expect(200);
    let track = server.get("/v1/cameras/c/tracks/walker").await.expect(200).json();
    let times: Vec<&str> = track["features"]
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(|point| point["properties"]["time"].as_str())
        .collect();
    assert_eq!(times.len(), 3, "{track}");
    assert!(times[2].starts_with("2026-01-01T00:00:09"), "{times:?}");
}
