//! Mistakes that people make with the interfaces, and the refusals that they get.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::process::Stdio;

use futures_util::stream;
use serde_json::json;
use tonic_reflection::pb::v1alpha::ServerReflectionRequest;
use tonic_reflection::pb::v1alpha::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1alpha::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1alpha::server_reflection_response::MessageResponse;

use crate::harness::{TestServer, data_folder, own_address, run, sightfix, simulated_csv};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const JSON: [(&str, &str); 1] = [("content-type", "application/json")];

#[tokio::test]
async fn an_array_is_no_object_and_types_are_named_as_in_json() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    for (path, body, field, reported) in [
        (
            "/v1/cameras",
            r#"["arr", "n", null, null, null, [], {}, [], false]"#,
            "body",
            "an object, not an array",
        ),
        ("/v1/cameras", r#"{"id": "d", "image_size": [640, 480]}"#, "image_size", "an object, not an array"),
        ("/v1/cameras", r#"{"id": 5}"#, "id", "text, not a number"),
        ("/v1/cameras", r#"{"id": "d", "labels": []}"#, "labels", "an object, not an array"),
        ("/v1/cameras", r#"{"id": "d", "recipe": "x"}"#, "recipe", "one of paper"),
        ("/v1/cameras", "7", "body", "an object, not a number"),
        ("/v1/cameras/c/training-runs", "[]", "body", "an object, not an array"),
        ("/v1/cameras/c/training-runs", r#"{"epochs": -1}"#, "epochs", "a whole number"),
        ("/v1/cameras/c/fusions", r#"["2026-01-01T00:00:00Z"]"#, "body", "an object, not an array"),
        ("/v1/cameras/c/fusions", r#"{"observations": [[]]}"#, "observations[0]", "an object, not an array"),
    ] {
        let problem = server.send("POST", path, &JSON, body).await.expect(422).json();
        let violation = &problem["violations"][0];
        assert_eq!(violation["field"], field, "{body}: {problem}");
        let message = violation["message"].as_str().expect("text");
        assert!(message.contains(reported), "{body}: {message}");
        for word in ["struct", "sequence", "f64", "u32", "i64", "enum", "expected"] {
            assert!(!message.contains(word), "{body}: {message}");
        }
    }
    assert_eq!(server.get("/v1/cameras").await.expect(200).json()["items"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn all_fields_at_fault_are_named_at_once() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let fields = async |path: &str, body: serde_json::Value| {
        let problem = server.post(path, &body).await.expect(422).json();
        let violations = problem["violations"].as_array().expect("violations").clone();
        let mut fields: Vec<String> =
            violations.iter().map(|at| at["field"].as_str().expect("a field").to_owned()).collect();
        fields.sort_unstable();
        (fields, problem)
    };
    let camera = json!({
        "id": 5, "labels": [], "recipe": "x", "bogus": 1, "target_classes": [true, "person", null],
        "image_size": {"width_px": "wide"},
    });
    let (named, problem) = fields("/v1/cameras", camera).await;
    let expected = [
        "bogus",
        "id",
        "image_size.height_px",
        "image_size.width_px",
        "labels",
        "recipe",
        "target_classes[0]",
        "target_classes[2]",
    ];
    assert_eq!(named, expected, "{problem}");
    assert!(problem["detail"].as_str().is_some_and(|text| text.starts_with("8 fields")), "{problem}");
    let observations = json!({"observations": [
        {"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": "x", "latitude_deg": null}},
        {"target_id": 7, "fix": {"longitude_deg": 1, "latitude_deg": 2}},
    ]});
    let (named, problem) = fields("/v1/cameras/c/fusions", observations).await;
    let expected = [
        "observations[0].fix.latitude_deg",
        "observations[0].fix.longitude_deg",
        "observations[1].target_id",
        "observations[1].time",
    ];
    assert_eq!(named, expected, "{problem}");
    let (named, problem) = fields("/v1/cameras", json!({})).await;
    assert_eq!(named, ["id"], "{problem}");
}

#[tokio::test]
async fn a_method_that_a_path_does_not_have_is_refused_as_such() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    for (method, path) in
        [("PUT", "/v1/cameras?limit=5"), ("PUT", "/v1/audit?camera=c"), ("TRACE", "/v1/keys?x=1")]
    {
        let answer = server.send(method, path, &[], "").await.expect(405);
        assert!(answer.header("allow").contains("GET"), "{method} {path}");
    }
}

#[tokio::test]
async fn a_parameter_that_an_operation_does_not_have_is_refused() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    for (method, path) in [
        ("GET", "/v1/cameras/c?verbose=1"),
        ("GET", "/v1/cameras?limt=5"),
        ("GET", "/v1/cameras/c/active-model?x"),
        ("DELETE", "/v1/cameras/c?force=true"),
        ("POST", "/v1/cameras/c/fusions?method=x"),
        ("GET", "/v1/cameras/c/tracks?since=1"),
    ] {
        let problem = server.send(method, path, &JSON, "{}").await.expect(422).json();
        assert!(problem["detail"].as_str().is_some_and(|text| text.contains("not a parameter")), "{problem}");
    }
    server.get("/v1/cameras/c?").await.expect(200);
    server.get("/v1/cameras/c/samples?limit=5").await.expect(200);
}

#[test]
fn a_closed_or_full_output_is_no_panic() {
    let mut child =
        sightfix().arg("openapi").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("runs");
    drop(child.stdout.take());
    let closed = child.wait_with_output().expect("ends");
    assert!(closed.status.success() && closed.stderr.is_empty(), "{closed:?}");
    for arguments in [&["openapi"][..], &["config"], &["keys", "generate"]] {
        let full = File::options().write(true).open("/dev/full").expect("Linux has it");
        let ended = sightfix().args(arguments).stdout(full).output().expect("runs");
        let reported = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}: {reported}");
        assert!(reported.contains("standard output cannot be written"), "{arguments:?}: {reported}");
    }
}

#[test]
fn a_full_standard_error_is_no_panic() {
    let folder = data_folder();
    let typo = folder.path().join("typo");
    let full = || File::options().write(true).open("/dev/full").expect("Linux has it");
    let train = ["train", "--camera", "c", "--data", typo.to_str().expect("UTF-8")];
    let ended = sightfix().args(train).stderr(full()).output().expect("runs");
    assert_eq!(ended.status.code(), Some(1), "the error itself, not a panic: {ended:?}");
    let keys = [
        "keys",
        "create",
        "--name",
        "n",
        "--role",
        "admin",
        "--data",
        folder.path().to_str().expect("UTF-8"),
    ];
    let ended = sightfix().args(keys).stderr(full()).output().expect("runs");
    assert!(ended.status.success() && ended.stdout.starts_with(b"sf_"), "{ended:?}");
}

/// The device of the log is full, as a disk may be; the log is lost, and nothing else.
#[tokio::test]
async fn a_server_whose_log_cannot_be_written_serves_on() {
    let folder = data_folder();
    let address = own_address();
    let mut command = sightfix();
    command.args(["serve", "--listen", &address.to_string(), "--data"]).arg(folder.path());
    command
        .stdout(Stdio::null())
        .stderr(File::options().write(true).open("/dev/full").expect("Linux has it"));
    let mut server = command.spawn().expect("the binary starts");
    let request = b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    let mut answered = 0;
    // Each SIGHUP is logged.
    while answered < 3 {
        assert_eq!(server.try_wait().expect("it can be asked"), None, "the server has ended");
        if let Ok(mut stream) = std::net::TcpStream::connect(address) {
            let mut answer = String::new();
            stream.write_all(request).and_then(|()| stream.read_to_string(&mut answer)).expect("an answer");
            assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
            let hangup = std::process::Command::new("kill").args(["-HUP", &server.id().to_string()]).status();
            assert!(hangup.expect("kill runs").success());
            answered += 1;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    server.kill().expect("it can be killed");
    server.wait().expect("it has ended");
}

#[test]
fn commands_make_no_folder_of_a_typo_and_compare_the_image_size() {
    let folder = data_folder();
    let typo = folder.path().join("typo");
    let file = folder.path().join("samples.csv");
    std::fs::write(&file, simulated_csv()).expect("a file");
    let (path, data) = (file.to_str().expect("UTF-8"), folder.path().join("data"));
    let data = data.to_str().expect("UTF-8");
    let reported = |arguments: &[&str]| {
        let ended = sightfix().args(arguments).output().expect("runs");
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}");
        String::from_utf8_lossy(&ended.stderr).into_owned()
    };
    let typo_text = typo.to_str().expect("UTF-8");
    for arguments in [
        &["train", "--camera", "c", "--data", typo_text][..],
        &["import", path, "--camera", "c", "--data", typo_text],
        &["keys", "list", "--data", typo_text],
    ] {
        assert!(reported(arguments).contains("there is no data folder"), "{arguments:?}");
        assert!(!typo.exists(), "{arguments:?}");
    }
    let import = ["import", path, "--camera", "c", "--data", data, "--create", "--image-size"];
    run(&[&import[..], &["640x480", "--max-rejected", "1"]].concat());
    run(&[&import[..], &["640x480", "--max-rejected", "1"]].concat());
    let refused = reported(&[&import[..], &["1280x720"]].concat());
    assert!(refused.contains("640x480") && refused.contains("1280x720"), "{refused}");
}

#[tokio::test]
async fn a_roll_back_and_a_model_of_another_image_tell_the_truth() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let profile = json!({"id": "c", "image_size": {"width_px": 640, "height_px": 480}});
    server.post("/v1/cameras", &profile).await.expect(201);
    let roll_back = "/v1/cameras/c/active-model/roll-back";
    let none = server.send("POST", roll_back, &[], "").await.expect(409).json();
    assert_eq!(none["type"], "urn:sightfix:problem:no-model", "{none}");
    let headers = [("content-type", "application/octet-stream")];
    let model = std::fs::read(MODEL).expect("a model");
    server.send("POST", "/v1/cameras/c/models", &headers, model).await.expect(201);
    server.send("PUT", "/v1/cameras/c/active-model", &JSON, r#"{"number": 1}"#).await.expect(200);
    let first = server.send("POST", roll_back, &[], "").await.expect(409).json();
    assert_eq!(first["type"], "urn:sightfix:problem:no-earlier-model", "{first}");
    assert!(first["detail"].as_str().is_some_and(|text| text.contains("version 1")), "{first}");
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    let warns = |camera: &serde_json::Value| {
        let warnings = camera["warnings"].as_array().expect("warnings");
        warnings.iter().any(|text| text.as_str().is_some_and(|text| text.contains("640x480")))
    };
    assert!(warns(&camera), "{camera}");
}

#[tokio::test]
async fn reflection_is_served_to_older_clients_too() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let channel = server.channel().await;
    let request = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut client = ServerReflectionClient::new(channel);
    let mut answers =
        client.server_reflection_info(stream::iter([request])).await.expect("served").into_inner();
    let answer = answers.message().await.expect("an answer").expect("one answer").message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = answer else { panic!("no list") };
    assert!(list.service.iter().any(|service| service.name == "sightfix.v1.FusionService"), "{list:?}");
}
