//! Metrics by route and RPC, figures of the process, the log line of a request, the port for monitoring alone,
//! and the log filter that SIGHUP loads again.

use std::net::SocketAddr;
use std::process::Stdio;

use http_body_util::{BodyExt as _, Empty};
use hyper::body::Bytes;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;

use crate::harness::{TestServer, data_folder, run, sightfix};

/// The value of the series that has all of these parts in its name and labels.
fn value(metrics: &str, parts: &[&str]) -> Option<f64> {
    let is_it = |line: &&str| !line.starts_with('#') && parts.iter().all(|part| line.contains(part));
    metrics.lines().find(is_it)?.rsplit(' ').next()?.parse().ok()
}

async fn metrics(server: &TestServer) -> String {
    server.get("/metrics").await.expect(200).text()
}

#[tokio::test]
async fn requests_are_counted_by_route_and_rpc_and_never_by_path() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "north-gate"})).await.expect(201);
    for _ in 0..3 {
        server.get("/v1/cameras/north-gate").await.expect(200);
    }
    server.get("/v1/cameras/nobody").await.expect(404);
    server.get("/v1/secret-path").await.expect(404);
    server.send("BREW", "/v1/cameras", &[], "").await.expect(405);
    let mut cameras = CameraServiceClient::connect(format!("http://{}", server.address)).await.expect("gRPC");
    let get = |camera: &str| proto::GetCameraRequest { camera_id: camera.to_owned() };
    cameras.get_camera(get("north-gate")).await.expect("known");
    cameras.get_camera(get("nobody")).await.expect_err("unknown");

    let text = metrics(&server).await;
    let total = "sightfix_http_requests_total{";
    let camera = r#"route="/v1/cameras/{camera}""#;
    assert_eq!(value(&text, &[total, camera, r#"method="GET""#, r#"status="2xx""#]), Some(3.0), "{text}");
    assert_eq!(value(&text, &[total, camera, r#"status="4xx""#]), Some(1.0), "{text}");
    assert_eq!(value(&text, &[total, r#"route="other""#, r#"status="4xx""#]), Some(2.0), "{text}");
    let count = ["sightfix_http_request_duration_seconds_count", camera];
    assert_eq!(value(&text, &count), Some(4.0), "{text}");
    let rpc = r#"rpc="sightfix.v1.CameraService/GetCamera""#;
    let total = "sightfix_grpc_requests_total{";
    assert_eq!(value(&text, &[total, rpc, r#"code="OK""#]), Some(1.0), "{text}");
    assert_eq!(value(&text, &[total, rpc, r#"code="NOT_FOUND""#]), Some(1.0), "{text}");
    for secret in ["north-gate", "nobody", "secret-path", "BREW"] {
        assert!(!text.contains(secret), "{secret} is no label: {text}");
    }
}

#[tokio::test]
async fn build_process_queues_and_quotas_have_their_figures() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    // The first round of gathering has been.
    let text = loop {
        let text = metrics(&server).await;
        if value(&text, &["sightfix_database_bytes "]).is_some_and(|bytes| bytes > 0.0) {
            break text;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    };
    let version = concat!("version=\"", env!("CARGO_PKG_VERSION"), "\"");
    assert_eq!(value(&text, &["sightfix_build_info{", version]), Some(1.0), "{text}");
    for (name, least) in [
        ("process_cpu_seconds_total ", 0.001),
        ("process_resident_memory_bytes ", 1e6),
        ("process_open_fds ", 5.0),
        ("process_max_fds ", 100.0),
        ("process_start_time_seconds ", 1.7e9),
    ] {
        let found = value(&text, &[name]);
        println!("{name}{found:?}");
        assert!(found.is_some_and(|found| found >= least), "{name}: {found:?}");
    }
    for kind in ["training", "evaluation"] {
        for state in ["queued", "running"] {
            let labels = [format!("kind=\"{kind}\""), format!("state=\"{state}\"")];
            assert_eq!(value(&text, &["sightfix_jobs{", &labels[0], &labels[1]]), Some(0.0), "{text}");
        }
    }
    let requests = value(&text, &["sightfix_quota_limit", r#"resource="requests""#]);
    assert_eq!(requests, Some(768.0), "limits.requests without the reserved ones");
    assert_eq!(value(&text, &["sightfix_sample_rows_queued "]), Some(0.0), "{text}");
    assert_eq!(value(&text, &["sightfix_models_unusable "]), Some(0.0), "{text}");
}

#[tokio::test]
async fn each_request_has_a_log_line_with_method_route_and_key() {
    let folder = data_folder();
    let path = folder.path().to_str().expect("UTF-8");
    let key = run(&["keys", "create", "--role", "admin", "--name", "Ada", "--data", path]);
    let settings = [("SIGHTFIX_LOG_FILTER", "info,sightfix::requests=debug")];
    let server = TestServer::start_with(folder.path(), &settings);
    let bearer = format!("Bearer {}", key.trim());
    let headers = [("authorization", bearer.as_str()), ("x-request-id", "mine")];
    server.send("GET", "/v1/cameras/c", &headers, "").await.expect(404);
    let entry = server.logged(|entry| entry["message"] == "answered").await;
    println!("{entry}");
    let span = &entry["span"];
    assert_eq!((&span["method"], &span["id"]), (&json!("GET"), &json!("mine")), "{entry}");
    assert_eq!((&entry["route"], &entry["status"]), (&json!("/v1/cameras/{camera}"), &json!(404)), "{entry}");
    assert!(span["key"].as_str().is_some_and(|id| id.len() == 36), "{entry}");
    assert!(server.log_lines(key.trim()).is_empty(), "a secret is never logged");
}

async fn get(address: SocketAddr, path: &str) -> (u16, String) {
    use hyper_util::client::legacy::Client;
    use hyper_util::rt::TokioExecutor;
    let client = Client::builder(TokioExecutor::new()).build_http::<Empty<Bytes>>();
    let uri = format!("http://{address}{path}").parse().expect("a URI");
    let (head, body) = client.get(uri).await.expect("an answer").into_parts();
    let body = body.collect().await.expect("a body").to_bytes();
    (head.status.as_u16(), String::from_utf8_lossy(&body).into_owned())
}

#[tokio::test]
async fn monitoring_may_have_a_port_of_its_own_that_serves_nothing_else() {
    let folder = data_folder();
    let path = folder.path().to_str().expect("UTF-8");
    run(&["keys", "create", "--role", "admin", "--name", "Ada", "--data", path]);
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_METRICS_LISTEN", "127.0.0.1:0")]);
    let entry = server.logged(|entry| entry["monitoring"].is_string()).await;
    let monitoring: SocketAddr = entry["monitoring"].as_str().expect("text").parse().expect("an address");
    assert_eq!(server.get("/metrics").await.status.as_u16(), 401, "the other port asks for a key");
    for path in ["/livez", "/readyz", "/metrics"] {
        let (status, text) = get(monitoring, path).await;
        assert_eq!(status, 200, "{path}: {text}");
    }
    let (_, text) = get(monitoring, "/metrics").await;
    let ready = ["sightfix_http_requests_total", r#"route="/readyz""#, r#"status="2xx""#];
    assert_eq!(value(&text, &ready), Some(1.0), "{text}");
    for path in ["/v1/cameras", "/v1/keys", "/", "/docs", "/openapi.json"] {
        assert_eq!(get(monitoring, path).await.0, 404, "{path}");
    }
    assert!(server.terminate());
}

#[cfg(unix)]
#[tokio::test]
async fn a_hangup_loads_the_log_filter_of_the_settings_again() {
    let folder = data_folder();
    let file = folder.path().join("sightfix.toml");
    std::fs::write(&file, "log_filter = \"info\"\n").expect("written");
    let mut command = sightfix();
    command.arg("--config").arg(&file).args(["serve", "--listen", "127.0.0.1:0", "--data"]);
    command.arg(folder.path().join("data")).stdout(Stdio::null());
    let server = TestServer::run(command);
    server.get("/v1/cameras?limit=7").await.expect(200);
    std::fs::write(&file, "log_filter = \"info,sightfix::requests=debug\"\n").expect("written");
    server.signal("-HUP");
    let is_answer = |entry: &Value| entry["message"] == "answered";
    loop {
        server.get("/v1/cameras").await.expect(200);
        if !server.log_lines("\"answered\"").is_empty() {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let entry = server.logged(is_answer).await;
    assert_eq!(entry["route"], "/v1/cameras", "{entry}");
    std::fs::write(&file, "log_filter = \"no such filter ===\"\n").expect("written");
    server.signal("-HUP");
    let refused = server.logged(|entry| entry["message"] == "the log filter is unchanged").await;
    assert!(refused["error"].is_string(), "{refused}");
    assert!(server.terminate());
}
