//! The resource `/v1/connections`.

use serde_json::{Value, json};

use super::peers::{connection_when, create_gate, patch};
use crate::harness::{TestServer, data_folder};

const SECRET: &str = "a-secret-of-the-operator";

fn webhook(id: &str) -> Value {
    json!({
        "id": id, "paused": true, "secrets": {"signing_key": SECRET},
        "sink": {"address": "http://127.0.0.1:9/hook", "camera_ids": ["gate"]},
    })
}

#[tokio::test]
async fn a_connection_is_created_read_changed_and_deleted_and_its_secrets_are_never_shown() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__OUTSIDE_CONNECTIONS", "2")]);
    let refused = server.post("/v1/connections", &webhook("hook")).await.expect(422).text();
    assert!(refused.contains("sink.camera_ids") && refused.contains("there is no camera gate"), "{refused}");
    create_gate(&server).await;
    let created = server.post("/v1/connections", &webhook("hook")).await.expect(201);
    assert_eq!(created.header("location"), "/v1/connections/hook");
    assert!(!created.text().contains(SECRET));
    assert_eq!(created.json()["secret_names"], json!(["signing_key"]));
    let shown = server.get("/v1/connections/hook").await.expect(200);
    assert_eq!(shown.json()["status"]["state"], "paused");
    assert_eq!(shown.json()["sink"]["address"], "http://127.0.0.1:9/hook");

    let changed =
        patch(&server, "hook", &json!({"display_name": "Hook", "sink": {"min_interval_s": 5}})).await;
    let changed = changed.expect(200).json();
    assert_eq!((&changed["display_name"], &changed["revision"]), (&json!("Hook"), &json!(2)));
    assert_eq!(changed["sink"]["camera_ids"], json!(["gate"]), "what a patch leaves out stays");
    assert_eq!(changed["secret_names"], json!(["signing_key"]), "so do secrets");
    let changed =
        patch(&server, "hook", &json!({"secrets": {"signing_key": null, "authorization": SECRET}})).await;
    assert_eq!(changed.expect(200).json()["secret_names"], json!(["authorization"]));
    let changed = patch(&server, "hook", &json!({"sink": {"address": "http://127.0.0.1:9/other"}})).await;
    assert_eq!(changed.expect(200).json()["secret_names"], json!(["authorization"]), "the same peer");

    server.post("/v1/connections", &webhook("hook")).await.expect(409);
    server.post("/v1/connections", &webhook("other")).await.expect(201);
    let full = server.post("/v1/connections", &webhook("third")).await.expect(507);
    assert!(full.text().contains("limits.outside_connections is 2"), "{}", full.text());
    let page = server.get("/v1/connections?limit=1").await.expect(200).json();
    assert_eq!(page["items"][0]["id"], "hook");
    assert!(page["next_cursor"].is_string());

    server.send("DELETE", "/v1/connections/hook", &[], "").await.expect(204);
    server.get("/v1/connections/hook").await.expect(404);
    let audit = server.get("/v1/audit").await.expect(200);
    let actions: Vec<Value> =
        audit.json()["items"].as_array().expect("entries").iter().map(|it| it["action"].clone()).collect();
    assert_eq!(
        actions,
        [
            "connection-deleted",
            "connection-created",
            "connection-changed",
            "connection-changed",
            "connection-changed",
            "connection-created",
            "camera-created"
        ]
    );
    let listed = server.get("/v1/connections").await.expect(200);
    assert!(!audit.text().contains(SECRET) && !listed.text().contains(SECRET));
    assert!(server.log_lines(SECRET).is_empty());
}

#[tokio::test]
async fn settings_that_cannot_work_are_refused_with_their_field() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let source = |source: Value| json!({"id": "a", "source": source});
    let sink = |sink: Value| json!({"id": "a", "sink": sink});
    let mqtt = json!({"address": "mqtt://broker:1883", "format": "frigate", "topics": ["frigate/events"]});
    let both = json!({"id": "a", "source": mqtt, "sink": {"address": "udp://239.2.3.1:6969", "camera_ids": ["gate"]}});
    for (draft, field) in [
        (json!({"id": "a"}), "source"),
        (both, "source"),
        (source(json!({"address": "ftp://broker", "format": "frigate"})), "source.address"),
        (
            source(json!({"address": "mqtt://user:word@broker", "format": "frigate", "topics": ["a"]})),
            "source.address",
        ),
        (
            source(json!({"address": "tcp://receiver", "format": "nmea", "camera_ids": ["gate"]})),
            "source.address",
        ),
        (source(json!({"address": "mqtt://broker", "format": "frigate"})), "source.topics"),
        (source(json!({"address": "tcp://receiver:4001", "format": "nmea"})), "source.camera_ids"),
        (
            source(json!({"address": "gpsd://receiver", "format": "nmea", "camera_ids": ["gate"]})),
            "source.format",
        ),
        (source(json!({"address": "rtsp://camera/metadata", "format": "frigate"})), "source.format"),
        (source(json!({"address": "rtsp://user@camera/metadata", "format": "onvif"})), "source.address"),
        (
            source(
                json!({"address": "push:", "format": "frigate", "cameras": {"x": {"camera_id": "Not a slug"}}}),
            ),
            "source.cameras.x.camera_id",
        ),
        (sink(json!({"address": "http://hook", "camera_ids": []})), "sink.camera_ids"),
        (sink(json!({"address": "gpsd://hook", "camera_ids": ["gate"]})), "sink.address"),
        (sink(json!({"address": "mqtt://b", "camera_ids": ["gate"], "topic": "a/#"})), "sink.topic"),
        (sink(json!({"address": "nats://b", "camera_ids": ["gate"], "topic": "a.>"})), "sink.topic"),
        (
            sink(json!({"address": "http://h", "camera_ids": ["gate"], "format": "home_assistant"})),
            "sink.format",
        ),
        (
            sink(json!({"address": "http://h", "camera_ids": ["gate"], "min_interval_s": -1})),
            "sink.min_interval_s",
        ),
        (
            json!({"id": "a", "sink": {"address": "http://h", "camera_ids": ["gate"]}, "secrets": {"pin": "1"}}),
            "secrets.pin",
        ),
    ] {
        let refused = server.post("/v1/connections", &draft).await.expect(422).json();
        assert_eq!(refused["violations"][0]["field"], field, "{draft}: {refused}");
    }
    assert_eq!(server.get("/v1/connections").await.expect(200).json()["items"], json!([]));
}

#[tokio::test]
async fn only_operators_may_have_the_server_connect_to_others() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let key = |role: &str, cameras: Value| json!({"name": role, "role": role, "camera_ids": cameras});
    let admin = server.post("/v1/keys", &key("admin", json!([]))).await.expect(201).json();
    let bearer = |key: &Value| format!("Bearer {}", key["secret"].as_str().expect("a secret"));
    let admin = bearer(&admin);
    let mut bearers = Vec::new();
    for (role, cameras) in [("viewer", json!([])), ("edge", json!(["other"])), ("operator", json!([]))] {
        let headers = [("content-type", "application/json"), ("authorization", admin.as_str())];
        let created =
            server.send("POST", "/v1/keys", &headers, key(role, cameras).to_string()).await.expect(201);
        bearers.push(bearer(&created.json()));
    }
    let [viewer, edge, operator] = &bearers[..] else { panic!("three keys") };
    let push =
        json!({"id": "push", "source": {"address": "push:", "format": "traccar", "camera_ids": ["gate"]}});
    for (key, status) in [(viewer, 403), (edge, 403), (operator, 201)] {
        let headers = [("content-type", "application/json"), ("authorization", key.as_str())];
        server.send("POST", "/v1/connections", &headers, push.to_string()).await.expect(status);
    }
    for key in [viewer, edge] {
        server.send("GET", "/v1/connections/push", &[("authorization", key.as_str())], "").await.expect(403);
    }
    // A device hands in messages for its own cameras only.
    let path = "/v1/connections/push/messages";
    let refused = server.send("POST", path, &[("authorization", edge.as_str())], "{}").await.expect(403);
    assert!(refused.text().contains("gate"), "{}", refused.text());
}

#[tokio::test]
async fn a_peer_that_is_away_is_tried_again_and_a_paused_connection_rests() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let address = crate::harness::own_address();
    let draft = json!({"id": "receiver", "source": {
        "address": format!("tcp://{address}"), "format": "nmea", "camera_ids": ["gate"], "receiver_id": "boat",
    }});
    server.post("/v1/connections", &draft).await.expect(201);
    let waiting = connection_when(&server, "receiver", |status| status["state"] == "waiting").await;
    let error = waiting["status"]["last_error"]["message"].as_str().expect("an error");
    assert!(error.contains("refused"), "{error}");
    let listener = tokio::net::TcpListener::bind(address).await.expect("the address is free");
    let (_stream, _) = listener.accept().await.expect("the server connects");
    connection_when(&server, "receiver", |status| status["state"] == "running").await;
    patch(&server, "receiver", &json!({"paused": true})).await.expect(200);
    connection_when(&server, "receiver", |status| status["state"] == "paused").await;
    patch(&server, "receiver", &json!({"paused": false})).await.expect(200);
    let (stream, _) = listener.accept().await.expect("the server connects again");
    drop(stream);
    listener.accept().await.expect("a closed connection is opened again");
}

#[tokio::test]
async fn a_connection_of_the_settings_is_created_and_changed_at_the_start() {
    let folder = data_folder();
    let file = folder.path().join("settings.toml");
    let start = |topic: &str| {
        let text = format!(
            "[[connections]]\nid = \"frigate\"\npaused = true\nsecrets = {{ password = \"{SECRET}\" }}\n\
             source = {{ address = \"mqtt://broker\", topics = [\"{topic}\"], format = \"frigate\" }}\n"
        );
        std::fs::write(&file, text).expect("a file can be written");
        let mut command = crate::harness::sightfix();
        command.arg("--config").arg(&file).args(["serve", "--listen", "127.0.0.1:0", "--data"]);
        command.arg(folder.path().join("data")).stdout(std::process::Stdio::null());
        TestServer::run(command)
    };
    for (topic, revision) in [("frigate/events", 1), ("frigate/events", 1), ("other/events", 2)] {
        let server = start(topic);
        let shown = server.get("/v1/connections/frigate").await.expect(200).json();
        assert_eq!((&shown["source"]["topics"], &shown["revision"]), (&json!([topic]), &json!(revision)));
        assert_eq!(shown["secret_names"], json!(["password"]));
    }
    let settings =
        crate::harness::sightfix().arg("--config").arg(&file).arg("config").output().expect("it runs");
    let shown = String::from_utf8(settings.stdout).expect("text");
    assert!(shown.contains("other/events") && !shown.contains(SECRET), "{shown}");
}
