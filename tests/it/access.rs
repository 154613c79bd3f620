//! Who may do what: keys, roles, sessions, and what happens to what is open when a key is revoked.

use std::collections::BTreeSet;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use http_body_util::{BodyExt as _, Full};
use hyper::body::Bytes;
use hyper::{Request, StatusCode};
use hyper_util::client::legacy::Client as HttpClient;
use hyper_util::rt::TokioExecutor;
use prost::Message as _;
use serde_json::{Value, json};
use sightfix::app::access::Permission;
use sightfix::clock::{Clock, Randomness};
use sightfix::config::Config;
use sightfix::domain::{NewKey, Role, Scope};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::key_service_client::KeyServiceClient;
use sightfix::operations::{OPERATIONS, Operation};
use sightfix::server::Server;
use tempfile::TempDir;
use tokio::sync::mpsc;
use tonic::metadata::AsciiMetadataValue;
use tonic::transport::Channel;
use tonic::{Code, Status};

use crate::harness::{Answer, TestServer, data_folder, run, sightfix, store_arguments};

const ROLES: [Role; 4] = [Role::Viewer, Role::Edge, Role::Operator, Role::Admin];
const UNAUTHENTICATED: &str = "16";
const PERMISSION_DENIED: &str = "7";

/// Creates a key by the command line; the device role is for camera `c`.
fn create_key(folder: &TempDir, role: Role) -> String {
    let folder = folder.path().to_str().expect("UTF-8");
    let mut arguments = vec!["keys", "create", "--name", role.as_str(), "--role", role.as_str()];
    if role == Role::Edge {
        arguments.extend(["--camera", "c"]);
    }
    arguments.extend(["--data", folder]);
    run(&arguments).trim().to_owned()
}

fn bearer(key: &str) -> String {
    format!("Bearer {key}")
}

async fn send(server: &TestServer, method: &str, path: &str, key: &str, body: &str) -> Answer {
    let headers = [("authorization", &*bearer(key)), ("content-type", "application/json")];
    server.send(method, path, &headers, body.to_owned()).await
}

/// A server with the cameras `c` and `other`, and an administrator's key.
async fn with_admin() -> (TempDir, TestServer, String) {
    let folder = data_folder();
    let admin = create_key(&folder, Role::Admin);
    let server = TestServer::start(folder.path());
    for id in ["c", "other"] {
        let body = json!({ "id": id }).to_string();
        send(&server, "POST", "/v1/cameras", &admin, &body).await.expect(201);
    }
    (folder, server, admin)
}

async fn create_remotely(server: &TestServer, admin: &str, draft: &Value) -> (String, String) {
    let created = send(server, "POST", "/v1/keys", admin, &draft.to_string()).await.expect(201).json();
    let text = |field: &str| created[field].as_str().expect("text").to_owned();
    (text("id"), text("secret"))
}

fn with_key<T>(message: T, key: &str) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    let value = AsciiMetadataValue::try_from(bearer(key)).expect("ASCII");
    request.metadata_mut().insert("authorization", value);
    request
}

#[test]
fn every_route_and_rpc_has_its_permission() {
    let described: Value = serde_json::from_str(&run(&["openapi"])).expect("JSON");
    let mut routes = BTreeSet::new();
    for (template, methods) in described["paths"].as_object().expect("paths") {
        let methods = methods.as_object().expect("methods").keys();
        routes.extend(
            methods
                .filter(|name| ["get", "post", "put", "patch", "delete"].contains(&name.as_str()))
                .map(|method| format!("{} {template}", method.to_uppercase())),
        );
    }
    let of_table = |name: fn(&Operation) -> &'static str| -> BTreeSet<String> {
        OPERATIONS.iter().map(name).filter(|name| !name.is_empty()).map(str::to_owned).collect()
    };
    assert_eq!(routes, of_table(|operation| operation.route));

    let mut rpcs = BTreeSet::new();
    for set in [
        proto::FILE_DESCRIPTOR_SET,
        tonic_health::pb::FILE_DESCRIPTOR_SET,
        tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
        tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
    ] {
        for file in prost_types::FileDescriptorSet::decode(set).expect("descriptors").file {
            for service in &file.service {
                let name = |method: &prost_types::MethodDescriptorProto| {
                    format!("{}.{}/{}", file.package(), service.name(), method.name())
                };
                rpcs.extend(service.method.iter().map(name));
            }
        }
    }
    assert_eq!(rpcs, of_table(|operation| operation.rpc));
}

/// The path of a route with names that exist for cameras, and with none for all else, so that nothing is
/// changed where the request is let through.
fn path_of(route: &str) -> (&str, String) {
    let (method, template) = route.split_once(' ').expect("a method");
    let id = "019a0000-0000-7000-8000-000000000000";
    let path = template
        .replace("{camera}", "c")
        .replace("{site}", "s")
        .replace("{connection}", "n")
        .replace("{track}", "00000000-1")
        .replace("{model}", "99")
        .replace("{target}", "nobody")
        .replace("{run}", id)
        .replace("{key}", id)
        .replace("{evaluation}", id);
    (method, path)
}

#[tokio::test]
async fn every_route_obeys_the_roles() {
    let (folder, server, admin) = with_admin().await;
    let mut keys: Vec<(Role, String)> =
        ROLES[..3].iter().map(|&role| (role, create_key(&folder, role))).collect();
    keys.push((Role::Admin, admin));
    // Keys of another process are known within two seconds.
    for (_, key) in &keys {
        while send(&server, "GET", "/v1/session", key, "").await.status != StatusCode::OK {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
    let ends_cameras = "DELETE /v1/cameras/{camera}";
    let mut compared = 0;
    for operation in OPERATIONS.iter().filter(|it| !it.route.is_empty() && it.route != ends_cameras) {
        let (method, path) = path_of(operation.route);
        let anonymous = server.open(method, &path, &[("content-type", "application/json")], "[]").await;
        let is_refused = anonymous.status() == StatusCode::UNAUTHORIZED;
        let is_sign_in = operation.route == "POST /v1/session";
        assert!(
            is_sign_in || is_refused == (operation.permission != Permission::Public),
            "{} without a key: {}",
            operation.route,
            anonymous.status()
        );
        if is_refused {
            assert_eq!(anonymous.headers()["www-authenticate"], "Bearer realm=\"sightfix\"");
        }
        for (role, key) in &keys {
            let headers = [("authorization", &*bearer(key)), ("content-type", "application/json")];
            let status = server.open(method, &path, &headers, "[]").await.status();
            let granted = operation.permission.is_granted_to(*role);
            assert_ne!(status, StatusCode::UNAUTHORIZED, "{} as {role}", operation.route);
            assert_eq!(status != StatusCode::FORBIDDEN, granted, "{} as {role}: {status}", operation.route);
            compared += 1;
        }
    }
    assert!(compared > 150, "{compared}");
    for (role, key) in &keys[..2] {
        let headers = [("authorization", &*bearer(key))];
        let status = server.open("DELETE", "/v1/cameras/c", &headers, "").await.status();
        assert_eq!(status, StatusCode::FORBIDDEN, "{role}");
    }
}

/// Calls a method with an empty message; the status code as the server sends it.
async fn call(
    client: &HttpClient<hyper_util::client::legacy::connect::HttpConnector, Full<Bytes>>,
    server: &TestServer,
    rpc: &str,
    key: Option<&str>,
) -> String {
    let mut request = Request::post(format!("http://{}/{rpc}", server.address))
        .header("content-type", "application/grpc")
        .header("te", "trailers");
    if let Some(key) = key {
        request = request.header("authorization", bearer(key));
    }
    let request = request.body(Full::new(Bytes::from_static(&[0; 5]))).expect("a request");
    let (head, body) = client.request(request).await.expect("an answer").into_parts();
    let status = |headers: &hyper::HeaderMap| Some(headers.get("grpc-status")?.to_str().ok()?.to_owned());
    if let Some(status) = status(&head.headers) {
        return status;
    }
    let body = tokio::time::timeout(Duration::from_secs(1), body.collect()).await;
    // A health watch has no end.
    let Ok(body) = body else { return "0".to_owned() };
    body.expect("a whole body").trailers().and_then(status).expect("a status")
}

#[tokio::test]
async fn every_rpc_obeys_the_roles() {
    let (_folder, server, admin) = with_admin().await;
    let mut keys = Vec::new();
    for role in ROLES {
        let camera_ids: &[&str] = if role == Role::Edge { &["c"] } else { &[] };
        let draft = json!({"name": "n", "role": role.as_str(), "camera_ids": camera_ids});
        keys.push((role, create_remotely(&server, &admin, &draft).await.1));
    }
    let client = HttpClient::builder(TokioExecutor::new()).http2_only(true).build_http();
    for operation in OPERATIONS.iter().filter(|it| !it.rpc.is_empty()) {
        let status = call(&client, &server, operation.rpc, None).await;
        let is_public = operation.permission == Permission::Public;
        assert_eq!(status != UNAUTHENTICATED, is_public, "{} without a key: {status}", operation.rpc);
        for (role, key) in &keys {
            let status = call(&client, &server, operation.rpc, Some(key)).await;
            let granted = operation.permission.is_granted_to(*role);
            assert_ne!(status, UNAUTHENTICATED, "{} as {role}", operation.rpc);
            assert_eq!(status != PERMISSION_DENIED, granted, "{} as {role}: {status}", operation.rpc);
        }
    }
}

#[tokio::test]
async fn a_device_reaches_its_cameras_only() {
    let (_folder, server, admin) = with_admin().await;
    let draft = json!({"name": "box", "role": "edge", "camera_ids": ["c"]});
    let (_, key) = create_remotely(&server, &admin, &draft).await;
    let fix = json!({"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": 103.9, "latitude_deg": 30.6}});
    for (path, body) in [
        ("fusions", fix.to_string()),
        ("tracks", fix.to_string()),
        ("samples", json!({"samples": []}).to_string()),
        ("samples/pairings", String::new()),
    ] {
        let own = send(&server, "POST", &format!("/v1/cameras/c/{path}"), &key, &body).await;
        assert!(!matches!(own.status.as_u16(), 401 | 403), "{path}: {}", own.text());
        for foreign in ["other", "none"] {
            let refused = send(&server, "POST", &format!("/v1/cameras/{foreign}/{path}"), &key, &body).await;
            assert_eq!(refused.status, StatusCode::FORBIDDEN, "{foreign}/{path}: {}", refused.text());
            assert_eq!(refused.json()["type"], "urn:sightfix:problem:permission-denied");
        }
    }
    let mut fusion = FusionServiceClient::new(server.channel().await);
    for (camera, denied) in [("c", false), ("other", true)] {
        let request =
            proto::FuseRequest { camera_id: camera.to_owned(), observations: vec![Default::default()] };
        let refused = fusion.fuse(with_key(request, &key)).await.expect_err("no observation");
        assert_eq!(refused.code() == Code::PermissionDenied, denied, "{camera}: {refused:?}");
        let ended = opened_stream(&mut fusion, camera, &key).await.1.message().await;
        let is_denied = matches!(&ended, Err(status) if status.code() == Code::PermissionDenied);
        assert_eq!(is_denied, denied, "{camera}: {ended:?}");
        let batch = proto::ImportSamplesRequest { camera_id: camera.to_owned(), ..Default::default() };
        let mut samples = proto::sample_service_client::SampleServiceClient::new(server.channel().await);
        let stored = samples.import_samples(with_key(futures_util::stream::iter([batch]), &key)).await;
        let is_denied = matches!(&stored, Err(status) if status.code() == Code::PermissionDenied);
        assert_eq!(is_denied, denied, "{camera}: {stored:?}");
    }
}

type Responses = tonic::Streaming<proto::StreamResponse>;

async fn opened_stream(
    fusion: &mut FusionServiceClient<Channel>,
    camera: &str,
    key: &str,
) -> (mpsc::Sender<proto::StreamRequest>, Responses) {
    let (sender, mut queue) = mpsc::channel(4);
    let opening = proto::StreamOpening {
        camera_id: camera.to_owned(),
        client_name: "test".to_owned(),
        ..proto::StreamOpening::default()
    };
    let kind = Some(proto::stream_request::Kind::Opening(opening));
    sender.send(proto::StreamRequest { kind }).await.expect("room");
    let requests = futures_util::stream::poll_fn(move |context| queue.poll_recv(context));
    let responses = fusion.stream(with_key(requests, key)).await.expect("errors come as the end");
    (sender, responses.into_inner())
}

#[tokio::test]
async fn revoking_a_key_ends_what_is_open_at_once() {
    let (_folder, server, admin) = with_admin().await;
    let draft = json!({"name": "operator", "role": "operator"});
    let (id, key) = create_remotely(&server, &admin, &draft).await;
    let mut fusion = FusionServiceClient::new(server.channel().await);
    let (_sender, mut responses) = opened_stream(&mut fusion, "c", &key).await;
    responses.message().await.expect("opened").expect("opened");
    let headers = [("authorization", &*bearer(&key))];
    let events = server.open("GET", "/v1/cameras/c/events", &headers, "").await;
    assert_eq!(events.status(), StatusCode::OK);
    // A session that stands for the key.
    let signed_in = json!({ "key": key }).to_string();
    let session = server
        .send("POST", "/v1/session", &[("content-type", "application/json")], signed_in)
        .await
        .expect(200);
    let cookie = session.header("set-cookie").split(';').next().expect("a cookie").to_owned();
    server.send("GET", "/v1/cameras", &[("cookie", &cookie)], "").await.expect(200);

    send(&server, "DELETE", &format!("/v1/keys/{id}"), &admin, "").await.expect(204);

    let status = responses.message().await.expect_err("the stream ends");
    assert_eq!(status.code(), Code::Unauthenticated, "{status:?}");
    let broken = events.into_body().collect().await;
    assert!(broken.is_err(), "an event reader sees that its events are not complete");
    send(&server, "GET", "/v1/cameras", &key, "").await.expect(401);
    server.send("GET", "/v1/cameras", &[("cookie", &cookie)], "").await.expect(401);
    let mut cameras = CameraServiceClient::new(server.channel().await);
    let refused = cameras.list_cameras(with_key(proto::ListCamerasRequest::default(), &key)).await;
    assert_eq!(refused.expect_err("revoked").code(), Code::Unauthenticated);

    let shown = send(&server, "GET", &format!("/v1/keys/{id}"), &admin, "").await.expect(200).json();
    assert!(shown["revoked_at"].is_string() && shown["last_used_at"].is_string(), "{shown}");
    assert!(shown["secret"].is_null(), "{shown}");
}

/// The command line creates a key in the folder of a running server; its first request is answered.
#[tokio::test]
async fn a_key_of_another_process_works_at_once() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let admin = server.post("/v1/keys", &json!({"name": "first", "role": "admin"})).await.expect(201);
    let admin = admin.json()["secret"].as_str().expect("a secret").to_owned();
    for name in ["a", "b"] {
        let data = folder.path().to_str().expect("UTF-8");
        let secret = run(&["keys", "create", "--name", name, "--role", "viewer", "--data", data]);
        send(&server, "GET", "/v1/cameras", secret.trim(), "").await.expect(200);
        // The store is asked ten times a second at most.
        tokio::time::sleep(std::time::Duration::from_millis(150)).await;
    }
    send(&server, "GET", "/v1/keys", &admin, "").await.expect(200);
}

#[tokio::test]
async fn a_server_without_keys_is_open_until_there_is_one() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    assert_eq!(server.log_lines("no key exists").len(), 1, "the log says so");
    let caller = server.get("/v1/session").await.expect(200).json();
    assert_eq!((&caller["open_access"], &caller["role"]), (&json!(true), &json!("admin")), "{caller}");
    // Headers that a proxy or a client with a key adds do no harm.
    server.send("GET", "/v1/cameras", &[("authorization", "Basic eDp5")], "").await.expect(200);
    let created = server.post("/v1/keys", &json!({"name": "first", "role": "viewer"})).await.expect(201);
    let viewer = created.json()["secret"].as_str().expect("a secret").to_owned();

    server.get("/v1/cameras").await.expect(401);
    server.get("/metrics").await.expect(401);
    server.get("/livez").await.expect(200);
    assert_eq!(server.get("/readyz").await.expect(200).text(), "ready\n");
    send(&server, "GET", "/v1/cameras", &viewer, "").await.expect(200);
    let other_end = if viewer.ends_with('x') { 'y' } else { 'x' };
    let other = format!("{}{other_end}", &viewer[..viewer.len() - 1]);
    for wrong in ["sf_", "x", &viewer[1..], &other, "sf_000000000000000000000000000000000000"] {
        let refused = send(&server, "GET", "/v1/cameras", wrong, "").await.expect(401);
        assert_eq!(refused.json()["type"], "urn:sightfix:problem:unauthenticated");
        assert!(!refused.text().contains(&viewer[3..30]), "{}", refused.text());
    }
    // The secret is nowhere on the disk.
    for entry in std::fs::read_dir(folder.path()).expect("a folder") {
        let content = std::fs::read(entry.expect("an entry").path()).unwrap_or_default();
        let found = content.windows(viewer.len()).any(|bytes| bytes == viewer.as_bytes());
        assert!(!found, "secrets are not stored");
    }
    // Revoking the last key does not open the server again.
    let admin = create_key(&folder, Role::Admin);
    let id = created.json()["id"].as_str().expect("an id").to_owned();
    run(&["keys", "revoke", &id, "--data", folder.path().to_str().expect("UTF-8")]);
    while send(&server, "GET", "/v1/cameras", &viewer, "").await.status == StatusCode::OK {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    server.get("/v1/cameras").await.expect(401);
    let listed = run(&["keys", "list", "--data", folder.path().to_str().expect("UTF-8")]);
    assert!(listed.contains(&id) && listed.contains("revoked") && !listed.contains("sf_"), "{listed}");
    send(&server, "GET", "/v1/keys", &admin, "").await.expect(200);
}

#[tokio::test]
async fn a_browser_signs_in_with_a_cookie_that_pages_of_others_cannot_use() {
    let (_folder, server, admin) = with_admin().await;
    let own = format!("http://{}", server.address);
    let json_headers = [("content-type", "application/json"), ("origin", own.as_str())];
    let wrong = json!({"key": "sf_000000000000000000000000000000000000"}).to_string();
    server.send("POST", "/v1/session", &json_headers, wrong).await.expect(401);
    let right = json!({ "key": admin }).to_string();
    let session = server.send("POST", "/v1/session", &json_headers, right).await.expect(200);
    let cookie = session.header("set-cookie").to_owned();
    assert!(cookie.contains("; HttpOnly; SameSite=Strict") && !cookie.contains(&admin), "{cookie}");
    assert!(!cookie.contains("Secure"), "a browser on plain HTTP would drop it: {cookie}");
    let token = cookie.split(';').next().expect("a cookie");
    let caller = server.send("GET", "/v1/session", &[("cookie", token)], "").await.expect(200).json();
    assert_eq!((&caller["role"], &caller["name"]), (&json!("admin"), &json!("admin")), "{caller}");

    let create = |origin: Option<String>, id: &'static str| {
        let server = &server;
        async move {
            let mut headers = vec![("cookie", token), ("content-type", "application/json")];
            headers.extend(origin.as_deref().map(|origin| ("origin", origin)));
            server.send("POST", "/v1/cameras", &headers, json!({ "id": id }).to_string()).await
        }
    };
    for origin in [None, Some("http://evil.example".to_owned()), Some("null".to_owned())] {
        create(origin, "stolen").await.expect(403);
    }
    create(Some(own.clone()), "mine").await.expect(201);
    // Over gRPC a cookie is nothing.
    let client = HttpClient::builder(TokioExecutor::new()).http2_only(true).build_http();
    let request = Request::post(format!("{own}/sightfix.v1.CameraService/ListCameras"))
        .header("content-type", "application/grpc")
        .header("cookie", token)
        .body(Full::new(Bytes::from_static(&[0; 5])))
        .expect("a request");
    assert_eq!(client.request(request).await.expect("an answer").headers()["grpc-status"], UNAUTHENTICATED);

    let ended = server.send("DELETE", "/v1/session", &[("cookie", token), ("origin", &own)], "").await;
    assert!(ended.expect(204).header("set-cookie").contains("Max-Age=0"));
    server.send("GET", "/v1/session", &[("cookie", token)], "").await.expect(401);
    // A page whose session has ended can sign in again.
    let again = json!({ "key": admin }).to_string();
    let headers = [("content-type", "application/json"), ("origin", own.as_str()), ("cookie", token)];
    server.send("POST", "/v1/session", &headers, again).await.expect(200);
}

/// Signs in with a key; the cookie.
async fn signed_in(server: &TestServer, key: &str, cookie: Option<&str>) -> Answer {
    let own = format!("http://{}", server.address);
    let mut headers = vec![("content-type", "application/json"), ("origin", own.as_str())];
    headers.extend(cookie.map(|cookie| ("cookie", cookie)));
    server.send("POST", "/v1/session", &headers, json!({ "key": key }).to_string()).await
}

fn cookie_of(answer: &Answer) -> String {
    answer.header("set-cookie").split(';').next().expect("a cookie").to_owned()
}

async fn session_status(server: &TestServer, cookie: &str) -> StatusCode {
    server.send("GET", "/v1/session", &[("cookie", cookie)], "").await.status
}

#[tokio::test]
async fn nobodys_sign_in_ends_the_session_of_another() {
    let folder = data_folder();
    let [admin, edge] = [Role::Admin, Role::Edge].map(|role| create_key(&folder, role));
    let limits = [("SIGHTFIX_LIMITS__SESSIONS_PER_KEY", "3"), ("SIGHTFIX_LIMITS__SESSIONS", "4")];
    let server = TestServer::start_with(folder.path(), &limits);
    let of_admin = cookie_of(&signed_in(&server, &admin, None).await.expect(200));
    let mut of_edge = Vec::new();
    for _ in 0..8 {
        of_edge.push(cookie_of(&signed_in(&server, &edge, None).await.expect(200)));
    }
    assert_eq!(session_status(&server, &of_admin).await, 200, "of another key");
    for (index, cookie) in of_edge.iter().enumerate() {
        let status = if index < 5 { 401 } else { 200 };
        assert_eq!(session_status(&server, cookie).await, status, "the key's oldest end: {index}");
    }
    let refused = signed_in(&server, &admin, None).await.expect(503);
    assert!(refused.text().contains("4 sessions"), "{}", refused.text());
    assert_eq!(session_status(&server, &of_admin).await, 200);
    assert_eq!(session_status(&server, &of_edge[7]).await, 200);
}

#[tokio::test]
async fn the_audit_log_has_sign_ins_and_nobody_fills_it_with_theirs() {
    let (_folder, server, admin) = with_admin().await;
    let draft = json!({"name": "gate", "role": "edge", "camera_ids": ["c"]});
    let (id, edge) = create_remotely(&server, &admin, &draft).await;
    for _ in 0..15 {
        signed_in(&server, &edge, None).await.expect(200);
    }
    signed_in(&server, "sf_wrong", None).await.expect(401);
    signed_in(&server, &admin, None).await.expect(200);

    let log = send(&server, "GET", "/v1/audit", &admin, "").await.expect(200).json();
    let items = log["items"].as_array().expect("items");
    let sign_ins: Vec<&Value> = items.iter().filter(|entry| entry["action"] == "signed-in").collect();
    assert_eq!(sign_ins.len(), 11, "ten of the edge key in an hour, and the administrator's: {log}");
    assert!(sign_ins[1..].iter().all(|entry| entry["actor"] == "gate" && entry["key_id"] == id), "{log}");
    assert_eq!(sign_ins[0]["address"], "127.0.0.1");
    assert!(items.iter().any(|entry| entry["action"] == "camera-created"), "{log}");
}

#[tokio::test]
async fn a_browser_has_one_session_and_over_https_a_cookie_of_its_host_alone() {
    let (_folder, server, admin) = with_admin().await;
    let first = cookie_of(&signed_in(&server, &admin, None).await.expect(200));
    let second = cookie_of(&signed_in(&server, &admin, Some(&first)).await.expect(200));
    assert_eq!(session_status(&server, &first).await, 401, "the one before has ended");
    assert_eq!(session_status(&server, &second).await, 200);

    let own = format!("https://{}", server.address);
    let headers = [("content-type", "application/json"), ("origin", own.as_str())];
    let body = json!({ "key": admin }).to_string();
    let secure = server.send("POST", "/v1/session", &headers, body).await.expect(200);
    let cookie = secure.header("set-cookie").to_owned();
    assert!(cookie.starts_with("__Host-sightfix_session=") && cookie.ends_with("; Secure"), "{cookie}");
    assert!(cookie.contains("; Path=/;"), "{cookie}");
    let both = format!("{second}; {}", cookie_of(&secure));
    let ended = [("cookie", both.as_str()), ("origin", own.as_str())];
    server.send("DELETE", "/v1/session", &ended, "").await.expect(204);
    assert_eq!(session_status(&server, &cookie_of(&secure)).await, 401, "the host's own counts");
    assert_eq!(session_status(&server, &second).await, 200);
}

#[tokio::test]
async fn an_address_that_others_reach_needs_a_key() {
    let folder = data_folder();
    let path = folder.path().to_str().expect("UTF-8").to_owned();
    let serve = || {
        let mut command = sightfix();
        command
            .args(["serve", "--listen", "0.0.0.0:0"])
            .args(store_arguments(folder.path()))
            .stdout(Stdio::null());
        command
    };
    let refused = serve().output().expect("the binary runs");
    let reported = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success() && reported.contains("--insecure") && reported.contains("keys create"),
        "{reported}"
    );

    let mut insecure = serve();
    insecure.arg("--insecure");
    let server = TestServer::run(insecure);
    assert_eq!(server.log_lines("no key exists").len(), 1);
    drop(server);

    // The key of a container: from the environment, then from a file.
    let key = run(&["keys", "generate"]).trim().to_owned();
    let mut command = serve();
    command.env("SIGHTFIX_ADMIN_KEY", &key);
    let mut server = TestServer::run(command);
    server.address.set_ip([127, 0, 0, 1].into());
    server.get("/v1/keys").await.expect(401);
    let keys = send(&server, "GET", "/v1/keys", &key, "").await.expect(200).json();
    let id = keys["items"][0]["id"].as_str().expect("an id").to_owned();
    assert!(server.log_lines(&key).is_empty(), "the log has no secret");
    drop(server);
    let file = folder.path().join("admin-key");
    std::fs::write(&file, format!("{key}\n")).expect("a file");
    let mut command = serve();
    command.arg("--admin-key-file").arg(&file);
    let mut server = TestServer::run(command);
    server.address.set_ip([127, 0, 0, 1].into());
    let keys = send(&server, "GET", "/v1/keys", &key, "").await.expect(200).json();
    assert_eq!(keys["items"].as_array().map(Vec::len), Some(1), "the same key again: {keys}");
    drop(server);
    // Once revoked it does not come back by a restart.
    run(&["keys", "revoke", &id, "--data", &path]);
    let refused = serve().env("SIGHTFIX_ADMIN_KEY", &key).output().expect("the binary runs");
    assert!(String::from_utf8_lossy(&refused.stderr).contains("revoked"), "{refused:?}");
    let printed = run_with(&["config"], ("SIGHTFIX_ADMIN_KEY", &key));
    assert!(printed.contains("(hidden)") && !printed.contains(&key), "{printed}");
}

fn run_with(arguments: &[&str], variable: (&str, &str)) -> String {
    let output = sightfix().args(arguments).env(variable.0, variable.1).output().expect("the binary runs");
    String::from_utf8(output.stdout).expect("UTF-8")
}

#[tokio::test]
async fn keys_are_managed_over_grpc_as_over_rest() {
    let (_folder, server, admin) = with_admin().await;
    let mut keys = KeyServiceClient::new(server.channel().await);
    let draft = proto::CreateKeyRequest {
        name: "gate".to_owned(),
        role: proto::Role::Edge.into(),
        camera_ids: vec!["c".to_owned()],
        expires_at: None,
    };
    let created = keys.create_key(with_key(draft.clone(), &admin)).await.expect("created").into_inner();
    let key = created.key.expect("a key");
    let shown = send(&server, "GET", &format!("/v1/keys/{}", key.id), &admin, "").await.expect(200).json();
    assert_eq!((&shown["role"], &shown["camera_ids"]), (&json!("edge"), &json!(["c"])), "{shown}");
    let page = keys.list_keys(with_key(proto::ListKeysRequest::default(), &admin)).await.expect("a page");
    assert_eq!(page.into_inner().keys.len(), 2);
    let field = |status: &Status| {
        use tonic_types::StatusExt as _;
        status.get_details_bad_request().map(|details| details.field_violations[0].field.clone())
    };
    for (wrong, rest, at) in [
        (proto::CreateKeyRequest { role: 0, ..draft.clone() }, json!({"name": "n"}), "role"),
        (
            proto::CreateKeyRequest { camera_ids: Vec::new(), ..draft.clone() },
            json!({"name": "n", "role": "edge"}),
            "camera_ids",
        ),
        (
            proto::CreateKeyRequest { camera_ids: vec!["Not A Slug".to_owned()], ..draft.clone() },
            json!({"name": "n", "role": "edge", "camera_ids": ["Not A Slug"]}),
            "camera_ids[0]",
        ),
        (
            proto::CreateKeyRequest { name: String::new(), ..draft.clone() },
            json!({"name": "", "role": "edge", "camera_ids": ["c"]}),
            "name",
        ),
        (
            proto::CreateKeyRequest { expires_at: Some(prost_types::Timestamp::default()), ..draft.clone() },
            json!({"name": "n", "role": "edge", "camera_ids": ["c"], "expires_at": "1970-01-01T00:00:00Z"}),
            "expires_at",
        ),
    ] {
        let refused = keys.create_key(with_key(wrong, &admin)).await.expect_err(at);
        assert_eq!(
            (refused.code(), field(&refused).as_deref()),
            (Code::InvalidArgument, Some(at)),
            "{refused:?}"
        );
        let problem = send(&server, "POST", "/v1/keys", &admin, &rest.to_string()).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], at, "{problem}");
    }
    let request = proto::RevokeKeyRequest { key_id: key.id };
    let revoked = keys.revoke_key(with_key(request, &admin)).await.expect("revoked").into_inner();
    assert!(revoked.key.is_some_and(|key| key.revoked_at.is_some()));
    send(&server, "GET", "/v1/session", &created.secret, "").await.expect(401);
    let unknown = proto::GetKeyRequest { key_id: "nobody".to_owned() };
    assert_eq!(keys.get_key(with_key(unknown, &admin)).await.expect_err("none").code(), Code::NotFound);
    send(&server, "GET", "/v1/keys/nobody", &admin, "").await.expect(404);
}

#[tokio::test]
async fn a_replay_presents_its_key() {
    let (folder, server, admin) = with_admin().await;
    let draft = json!({"name": "box", "role": "edge", "camera_ids": ["c"]});
    let (_, key) = create_remotely(&server, &admin, &draft).await;
    let rows = folder.path().join("rows.csv");
    let text = "time,target_id,left,top,width,height,longitude,latitude\n\
                2026-01-01T00:00:00Z,a,1,2,3,4,103.9,30.6\n";
    std::fs::write(&rows, text).expect("a file");
    let url = format!("http://{}", server.address);
    let replay = || {
        let mut command = sightfix();
        command.arg("replay").arg(&rows);
        command.args(["--camera", "c", "--server", &url, "--speed", "max", "--attempts", "1"]);
        command
    };
    let refused = replay().output().expect("the binary runs");
    assert!(!refused.status.success(), "{refused:?}");
    let accepted = replay().env("SIGHTFIX_API_KEY", &key).output().expect("the binary runs");
    assert!(accepted.status.success(), "{accepted:?}");
    let file = folder.path().join("key");
    std::fs::write(&file, format!("{key}\n")).expect("a file");
    let accepted = replay().arg("--key-file").arg(&file).output().expect("the binary runs");
    assert!(accepted.status.success(), "{accepted:?}");
}

/// A server whose clock jumps past the expiry of a key and is set back answers the key again, without a restart.
#[tokio::test]
async fn a_key_works_again_when_a_wrong_clock_is_set_back() {
    let folder = data_folder();
    let wall_s = Arc::new(AtomicI64::new(1_800_000_000));
    let clock = {
        let wall_s = wall_s.clone();
        Clock::from_fn(move || jiff::Timestamp::from_second(wall_s.load(Ordering::SeqCst)).expect("in range"))
    };
    let mut config = Config { data: folder.path().to_owned(), ..Config::default() };
    config.listen.set_port(0);
    let server = Server::bind(config, clock, Randomness::seeded(1)).await.expect("a free port");
    let (app, address, shutdown) =
        (server.app().clone(), server.address().expect("a port"), server.shutdown());
    let expires_at = app.clock.now() + jiff::SignedDuration::from_hours(1);
    let scope = Scope::new(Role::Viewer, Vec::new()).expect("a scope");
    let key = NewKey::new("report", scope, Some(expires_at), app.clock.now()).expect("a key");
    let (_, secret) = app.keys().create(&key).await.expect("stored");
    let running = tokio::spawn(server.run());
    let client: HttpClient<_, Full<Bytes>> = HttpClient::builder(TokioExecutor::new()).build_http();
    let status = async || {
        let request = Request::get(format!("http://{address}/v1/cameras"))
            .header("authorization", format!("Bearer {}", secret.reveal()))
            .body(Full::default())
            .expect("a request");
        client.request(request).await.expect("an answer").status().as_u16()
    };
    assert_eq!(status().await, 200);
    wall_s.fetch_add(86_400, Ordering::SeqCst);
    // As the server does every two seconds, ends the requests and streams of the key.
    app.access.refresh(&app.store, &app.clock).await.expect("read");
    assert_eq!(status().await, 401);
    wall_s.fetch_sub(86_400, Ordering::SeqCst);
    app.access.refresh(&app.store, &app.clock).await.expect("read");
    assert_eq!(status().await, 200);
    shutdown.drain();
    running.await.expect("no panic").expect("ends well");
}
