//! Requests that a client sends again: `Idempotency-Key`, `on_conflict`, and what stands in their way.

use futures_util::stream;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;
use tonic::{Code, Request};
use tonic_types::StatusExt as _;

use crate::harness::{Answer, TestServer, data_folder, run, simulated_csv};

const SAMPLES: &str = "/v1/cameras/c/samples";
const RUNS: &str = "/v1/cameras/c/training-runs";
const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";

async fn with_camera(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    (folder, server)
}

async fn import(server: &TestServer, query: &str, key: &str, csv: impl Into<String>) -> Answer {
    let headers = [("content-type", "text/csv"), ("idempotency-key", key)];
    server.send("POST", &format!("{SAMPLES}{query}"), &headers, csv.into()).await
}

async fn start(server: &TestServer, key: &str, body: &Value) -> Answer {
    let headers = [("content-type", "application/json"), ("idempotency-key", key)];
    server.send("POST", RUNS, &headers, body.to_string()).await
}

fn row(second: u32, left_px: u32) -> String {
    format!("2020-12-14T06:41:{second:02}Z,a,{left_px},11,28,77,103.98678,30.6280135\n")
}

fn with_key<T>(message: T, key: &'static str) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert("idempotency-key", key.parse().expect("ASCII"));
    request
}

#[tokio::test]
async fn an_import_under_the_same_key_gets_the_answer_of_the_first() {
    let (folder, server) = with_camera(&[]).await;
    let csv = format!("{HEADER}{}{}2020-12-14T06:41:59Z,a,x,1,2,3,4,5\n", row(1, 10), row(2, 20));
    let first = import(&server, "", "k-1", &csv).await.expect(200).json();
    assert_eq!((&first["accepted"], &first["rejected"]), (&json!(2), &json!(1)), "{first}");
    assert_eq!(import(&server, "", "k-1", &csv).await.expect(200).json(), first);
    // Without the key, or under another, it is made again.
    let again = import(&server, "", "k-2", &csv).await.expect(200).json();
    assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(2)), "{again}");
    // Another body, other parameters and another operation are other requests.
    let other = format!("{HEADER}{}", row(3, 30));
    for refused in [
        import(&server, "", "k-1", other).await,
        import(&server, "?durability=relaxed", "k-1", &csv).await,
        start(&server, "k-1", &json!({})).await,
    ] {
        let problem = refused.expect(422).json();
        assert_eq!(problem["type"], "urn:sightfix:problem:idempotency-key-reused", "{problem}");
        assert_eq!(problem["violations"][0]["field"], "idempotency-key");
    }
    assert_eq!(server.get(&format!("{SAMPLES}/count")).await.json()["count"], 2);
    for key in ["", "with space", "é"] {
        import(&server, "", key, &csv).await.expect(422);
    }
    // The answer survives the server.
    server.kill();
    let server = TestServer::start(folder.path());
    assert_eq!(import(&server, "", "k-1", &csv).await.expect(200).json(), first);
}

#[tokio::test]
async fn what_failed_is_made_when_it_is_sent_again_and_imports_at_once_get_one_answer() {
    let (_folder, server) = with_camera(&[]).await;
    let broken = "time,target_id\n".to_owned();
    import(&server, "", "k", broken).await.expect(400);
    // Two batches and more, so that several transactions are made.
    let rows: String = (0..2_500)
        .map(|n| {
            format!("2020-12-14T06:{:02}:{:02}.{:03}Z,a,1,1,2,2,103,30\n", n / 60 % 60, n % 60, n / 3_600)
        })
        .collect();
    let csv = format!("{HEADER}{rows}");
    let (first, second) = tokio::join!(import(&server, "", "k", &csv), import(&server, "", "k", &csv));
    let (first, second) = (first.expect(200).json(), second.expect(200).json());
    assert_eq!(first, second);
    assert_eq!(server.get(&format!("{SAMPLES}/count")).await.json()["count"], 2_500);
}

#[tokio::test]
async fn keys_expire_and_their_number_is_limited() {
    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__IDEMPOTENCY_KEYS", "2")]).await;
    let csv = |second| format!("{HEADER}{}", row(second, 10));
    for (key, second) in [("k-1", 1), ("k-2", 2), ("k-3", 3)] {
        import(&server, "", key, csv(second)).await.expect(200);
    }
    let accepted = async |key, second| {
        import(&server, "", key, csv(second)).await.expect(200).json()["accepted"].clone()
    };
    assert_eq!(accepted("k-3", 3).await, 1);
    assert_eq!(accepted("k-2", 2).await, 1);
    assert_eq!(accepted("k-1", 1).await, 0, "the oldest made room, so the import was made again");

    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__IDEMPOTENCY_KEY_S", "0")]).await;
    assert_eq!(import(&server, "", "k", csv(1)).await.expect(200).json()["accepted"], 1);
    assert_eq!(import(&server, "", "k", csv(1)).await.expect(200).json()["accepted"], 0, "expired at once");
}

#[tokio::test]
async fn a_pairing_is_repeated_whatever_its_boundary() {
    let (_folder, server) = with_camera(&[]).await;
    let send = async |boundary: &str, left_px: u32| {
        let part = |name: &str, content: &str| {
            format!(
                "--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"{name}.csv\"\r\n\
                 content-type: text/csv\r\n\r\n{content}\r\n"
            )
        };
        let boxes = format!("time,target_id,left,top,width,height\n2020-12-14T06:41:48Z,a,{left_px},2,3,4\n");
        let fixes = "time,receiver_id,longitude,latitude\n2020-12-14T06:41:48Z,a,103,30\n";
        let body = format!("{}{}--{boundary}--\r\n", part("detections", &boxes), part("fixes", fixes));
        let content_type = format!("multipart/form-data; boundary={boundary}");
        let headers = [("content-type", &*content_type), ("idempotency-key", "k")];
        server.send("POST", &format!("{SAMPLES}/pairings"), &headers, body).await
    };
    let first = send("one", 10).await.expect(200).json();
    assert_eq!(first["accepted"], 1, "{first}");
    assert_eq!(send("two", 10).await.expect(200).json(), first);
    send("three", 11).await.expect(422);
}

#[tokio::test]
async fn one_run_is_started_and_a_second_is_told_which() {
    let (_folder, server) = with_camera(&[]).await;
    import(&server, "", "samples", simulated_csv()).await.expect(200);
    let wish = json!({"recipe": "hybrid", "epochs": 10_000, "seed": 3});
    let first = start(&server, "k", &wish).await.expect(202);
    let id = first.json()["id"].as_str().expect("an id").to_owned();
    let again = start(&server, "k", &wish).await.expect(202);
    assert_eq!(
        (again.json()["id"].as_str(), again.header("location")),
        (Some(&*id), first.header("location"))
    );
    start(&server, "k", &json!({"seed": 4})).await.expect(422);
    let refused = start(&server, "other", &wish).await.expect(409).json();
    assert_eq!(refused["conflicting_id"], *id, "{refused}");

    let mut client = TrainingServiceClient::new(server.channel().await);
    let request = proto::StartTrainingRunRequest { camera_id: "c".to_owned(), ..Default::default() };
    let status = client.start_training_run(request.clone()).await.expect_err("a live run");
    assert_eq!(status.code(), Code::FailedPrecondition);
    let info = status.get_details_error_info().expect("details");
    assert_eq!(info.metadata.get("conflicting_id"), Some(&id));

    // Its cancellation is requested: it says so until its worker ends it.
    loop {
        let state = server.get(first.header("location")).await.expect(200).json()["state"].clone();
        if state == "running" {
            break;
        }
        assert_eq!(state, "queued");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let cancel = format!("{}/cancel", first.header("location"));
    let cancelled = server.post(&cancel, &json!({})).await.expect(200).json();
    assert_eq!(cancelled["state"], "cancelling", "{cancelled}");
    loop {
        let state = server.get(first.header("location")).await.expect(200).json()["state"].clone();
        if state == "cancelled" {
            break;
        }
        assert_eq!(state, "cancelling");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    // The key stands for the run, ended as it is.
    assert_eq!(start(&server, "k", &wish).await.expect(202).json()["state"], "cancelled");

    let run =
        client.start_training_run(with_key(request.clone(), "by-grpc")).await.expect("queued").into_inner();
    let same = client.start_training_run(with_key(request.clone(), "by-grpc")).await.expect("repeated");
    assert_eq!(run.run.as_ref().map(|run| &run.id), same.into_inner().run.as_ref().map(|run| &run.id));
    let other = proto::StartTrainingRunRequest { seed: Some(9), ..request };
    let status = client.start_training_run(with_key(other, "by-grpc")).await.expect_err("another request");
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    let info = status.get_details_error_info().expect("details");
    assert_eq!(info.reason, "idempotency-key-reused");
}

fn message(second: i64, left_px: f64, on_conflict: proto::OnConflict) -> proto::ImportSamplesRequest {
    proto::ImportSamplesRequest {
        camera_id: "c".to_owned(),
        samples: vec![proto::Sample {
            time: Some(prost_types::Timestamp { seconds: 1_607_928_100 + second, nanos: 0 }),
            target_id: "a".to_owned(),
            bounding_box: Some(proto::BoundingBox {
                left_px: Some(left_px),
                top_px: Some(20.0),
                width_px: Some(30.0),
                height_px: Some(60.0),
            }),
            fix: Some(Box::new(proto::Fix {
                longitude_deg: Some(103.9),
                latitude_deg: Some(30.6),
                sigma_m: None,
            })),
            ..Default::default()
        }],
        on_conflict: on_conflict.into(),
        ..Default::default()
    }
}

#[tokio::test]
async fn a_stream_of_samples_is_repeated_and_replaces_alike() {
    let (_folder, server) = with_camera(&[]).await;
    let mut client = SampleServiceClient::new(server.channel().await);
    let mut send = async |messages: Vec<proto::ImportSamplesRequest>, key: Option<&'static str>| {
        let messages = stream::iter(messages);
        let request = match key {
            Some(key) => with_key(messages, key),
            None => Request::new(messages),
        };
        client.import_samples(request).await.map(tonic::Response::into_inner)
    };
    let keep = proto::OnConflict::Keep;
    let two = || vec![message(1, 10.0, keep), message(2, 10.0, keep)];
    let first = send(two(), Some("k")).await.expect("stored");
    assert_eq!((first.accepted, first.duplicate), (2, 0));
    assert_eq!(send(two(), Some("k")).await.expect("repeated"), first);
    // The same samples in one message are the same request.
    let mut one = message(1, 10.0, keep);
    one.samples.extend(message(2, 10.0, keep).samples);
    assert_eq!(send(vec![one], Some("k")).await.expect("repeated"), first);
    let status = send(vec![message(1, 10.0, keep)], Some("k")).await.expect_err("another request");
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    assert_eq!(send(two(), None).await.expect("stored before").duplicate, 2);
    let replaced = send(vec![message(1, 99.0, proto::OnConflict::Replace)], None).await.expect("replaced");
    assert_eq!((replaced.accepted, replaced.replaced, replaced.duplicate), (1, 1, 0));
    let stored = server.get(SAMPLES).await.expect(200).json();
    assert_eq!(stored["items"][0]["bounding_box"]["left_px"], 99.0);
}

#[tokio::test]
async fn samples_are_replaced_on_request() {
    let (_folder, server) = with_camera(&[]).await;
    let without_fix = "2020-12-14T06:41:03Z,a,30,11,28,77,,\n";
    let csv = format!("{HEADER}{}{}{without_fix}", row(1, 10), row(2, 20));
    import(&server, "", "k-1", csv).await.expect(200);
    // One with a fix by another, one with a fix by one without, one without by one with, a new one, and one twice.
    let csv = format!(
        "{HEADER}{}2020-12-14T06:41:02Z,a,21,11,28,77,,\n{}{}{}",
        row(1, 11),
        row(3, 31),
        row(4, 40),
        row(4, 41)
    );
    let report = import(&server, "?on_conflict=replace", "k-2", csv).await.expect(200).json();
    let count = |name: &str| report[name].as_u64().expect("a number");
    assert_eq!(
        [count("accepted"), count("replaced"), count("duplicate"), count("accepted_without_fix")],
        [4, 3, 1, 1],
        "{report}"
    );
    let stored = server.get(SAMPLES).await.expect(200).json();
    let shown: Vec<(f64, bool)> = stored["items"]
        .as_array()
        .into_iter()
        .flatten()
        .map(|item| (item["bounding_box"]["left_px"].as_f64().unwrap_or_default(), item["fix"].is_object()))
        .collect();
    assert_eq!(shown, [(11.0, true), (21.0, false), (31.0, true), (41.0, true)], "the last of two stays");
    let counted = server.get(&format!("{SAMPLES}/count")).await.expect(200).json();
    assert_eq!(counted, json!({"count": 4, "without_fix": 1}));
    let audit = server.get("/v1/audit").await.expect(200).json();
    assert_eq!(
        (&audit["items"][0]["action"], &audit["items"][0]["subject"]),
        (&json!("samples-replaced"), &json!("3 samples"))
    );
    let refused = import(&server, "?on_conflict=merge", "k-3", HEADER).await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "on_conflict");
}

#[tokio::test]
async fn a_limit_refuses_what_would_grow_and_loses_nothing_of_what_was_to_be_replaced() {
    let (_folder, server) = with_camera(&[("SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA", "2")]).await;
    import(&server, "", "k-1", format!("{HEADER}{}{}", row(1, 10), row(2, 20))).await.expect(200);
    let grown = format!("{HEADER}{}{}{}", row(1, 11), row(2, 21), row(3, 31));
    import(&server, "?on_conflict=replace", "k-2", grown).await.expect(507);
    let left = async || {
        let stored = server.get(SAMPLES).await.expect(200).json();
        let items = stored["items"].as_array().cloned().unwrap_or_default();
        items.iter().map(|item| item["bounding_box"]["left_px"].as_f64()).collect::<Vec<_>>()
    };
    assert_eq!(left().await, [Some(10.0), Some(20.0)]);
    let same = format!("{HEADER}{}{}", row(1, 11), row(2, 21));
    import(&server, "?on_conflict=replace", "k-3", same).await.expect(200);
    assert_eq!(left().await, [Some(11.0), Some(21.0)]);
}

#[tokio::test]
async fn a_device_may_add_samples_and_not_replace_them() {
    let folder = data_folder();
    let data = folder.path().to_str().expect("UTF-8");
    let key = |role: &str| {
        let mut arguments = vec!["keys", "create", "--name", role, "--role", role, "--data", data];
        if role == "edge" {
            arguments.extend(["--camera", "c"]);
        }
        format!("Bearer {}", run(&arguments).trim())
    };
    let (operator, edge) = (key("operator"), key("edge"));
    let server = TestServer::start(folder.path());
    let json = [("authorization", &*operator), ("content-type", "application/json")];
    server.send("POST", "/v1/cameras", &json, json!({"id": "c"}).to_string()).await.expect(201);
    let csv = format!("{HEADER}{}", row(1, 10));
    let send = async |key: &str, query: &str, idempotency_key: &str| {
        let headers =
            [("authorization", key), ("content-type", "text/csv"), ("idempotency-key", idempotency_key)];
        server.send("POST", &format!("{SAMPLES}{query}"), &headers, csv.clone()).await
    };
    let first = send(&edge, "", "k").await.expect(200).json();
    assert_eq!(first["accepted"], 1);
    send(&edge, "?on_conflict=replace", "k-2").await.expect(403);
    // Keys of different callers are different keys.
    let of_another = send(&operator, "", "k").await.expect(200).json();
    assert_eq!(of_another["duplicate"], 1, "{of_another}");
    send(&operator, "?on_conflict=replace", "k-3").await.expect(200);
}
