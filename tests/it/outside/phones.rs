//! Applications for phones at the front door: their credentials, and the answers that they expect.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

use super::peers::create_gate;
use crate::harness::{TestServer, data_folder, now};

/// A server with the source `phones` for the camera `gate`, the key of its administrator and one of a device.
async fn start(settings: &[(&str, &str)]) -> (TestServer, tempfile::TempDir, String, String) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    create_gate(&server).await;
    let source =
        json!({"id": "phones", "source": {"address": "push:", "format": "phone", "camera_ids": ["gate"]}});
    server.post("/v1/connections", &source).await.expect(201);
    let admin = json!({"name": "admin", "role": "admin"});
    let admin = secret(&server.post("/v1/keys", &admin).await.expect(201).json());
    let edge = json!({"name": "jane", "role": "edge", "camera_ids": ["gate"]}).to_string();
    let bearer = format!("Bearer {admin}");
    let headers = [("content-type", "application/json"), ("authorization", bearer.as_str())];
    let edge = secret(&server.send("POST", "/v1/keys", &headers, edge).await.expect(201).json());
    (server, folder, bearer, edge)
}

fn secret(key: &Value) -> String {
    key["secret"].as_str().expect("a secret").to_owned()
}

const MESSAGES: &str = "/v1/connections/phones/messages";

fn own_tracks() -> String {
    let second = now().as_second();
    format!(
        r#"{{"_type":"location","lat":30.628,"lon":103.98678,"tst":{second},"acc":4,"topic":"owntracks/jane/phone"}}"#
    )
}

async fn targets(server: &TestServer, bearer: &str) -> Vec<String> {
    let tracks = server.send("GET", "/v1/cameras/gate/tracks", &[("authorization", bearer)], "").await;
    let tracks = tracks.expect(200).json();
    let features = tracks["features"].as_array().expect("features").iter();
    let mut targets: Vec<String> =
        features.map(|it| it["properties"]["target_id"].as_str().expect("an id").to_owned()).collect();
    targets.sort();
    targets
}

#[tokio::test]
async fn phones_present_their_key_as_they_can_and_read_the_answer_that_they_expect() {
    let (server, _folder, admin, edge) = start(&[]).await;
    let basic = format!("Basic {}", STANDARD.encode(format!("jane:{edge}")));
    let with_basic = [("authorization", basic.as_str())];
    let taken = server.send("POST", MESSAGES, &with_basic, own_tracks()).await.expect(200);
    assert_eq!((taken.text().as_str(), taken.header("content-type")), ("[]", "application/json"));

    let overland = json!({"locations": [{"type": "Feature", "geometry": {"type": "Point", "coordinates": [103.98678, 30.628]},
        "properties": {"timestamp": now().to_string(), "horizontal_accuracy": 5, "device_id": "iphone"}}]});
    let in_path = format!("{MESSAGES}/{edge}");
    let taken = server.send("POST", &in_path, &[], overland.to_string()).await.expect(200);
    assert_eq!(taken.json(), json!({"result": "ok"}));

    let query = format!("id=car&lat=30.628&lon=103.98678&timestamp={}&accuracy=8", now().as_millisecond());
    server.send("GET", &format!("{in_path}?{query}"), &[], "").await.expect(204);
    server
        .send("POST", &format!("{MESSAGES}?{}", query.replace("car", "bus")), &with_basic, "")
        .await
        .expect(204);
    let form = [("authorization", basic.as_str()), ("content-type", "application/x-www-form-urlencoded")];
    server.send("POST", MESSAGES, &form, query.replace("car", "van")).await.expect(204);
    assert_eq!(targets(&server, &admin).await, ["bus", "car", "iphone", "jane/phone", "van"]);
}

#[tokio::test]
async fn what_a_phone_sends_wrongly_is_refused_with_the_reason() {
    let (server, _folder, admin, edge) = start(&[]).await;
    let bearer = format!("Bearer {edge}");
    let headers = [("authorization", bearer.as_str())];
    let send = |body: &'static str| server.send("POST", MESSAGES, &headers, body);
    for (body, reason) in [
        (r#"{"_type":"encrypted","data":"SL7ubL6Z"}"#, "encryption key"),
        (r#"{"_type":"location","lat":30.6,"lon":103.9}"#, "tst is missing"),
        ("latitude=30.6", "lon is missing"),
        ("lat=30.6&lon=103.9&timestamp=yesterday", "RFC 3339"),
        ("{", "JSON"),
    ] {
        let refused = send(body).await.expect(400);
        assert!(refused.text().contains(reason), "{body}: {}", refused.text());
    }
    send(r#"{"_type":"lwt","tst":1}"#).await.expect(200);
    assert_eq!(targets(&server, &admin).await, [""; 0]);
}

#[tokio::test]
async fn a_key_in_the_path_is_neither_logged_nor_shown() {
    let (server, _folder, admin, edge) = start(&[("SIGHTFIX_LOG_FILTER", "debug")]).await;
    let wrong = edge.replace("sf_", "sf_x");
    for (key, status) in [(&edge, 204), (&wrong, 401)] {
        let path = format!("{MESSAGES}/{key}?id=car&lat=30.628&lon=103.98678");
        let answer = server.send("GET", &path, &[], "").await.expect(status);
        assert!(!answer.text().contains(key.as_str()), "{}", answer.text());
    }
    let refused = server.send("POST", &format!("{MESSAGES}/{edge}"), &[], "{").await.expect(400);
    assert_eq!(refused.json()["instance"], "/v1/connections/phones/messages/{key}");
    let metrics =
        server.send("GET", "/metrics", &[("authorization", admin.as_str())], "").await.expect(200).text();
    assert!(metrics.contains(r#"route="/v1/connections/{connection}/messages/{key}""#), "{metrics}");
    assert!(!server.log_lines("messages/{key}").is_empty(), "requests are logged");
    for key in [&edge, &wrong] {
        assert!(!metrics.contains(key.as_str()) && server.log_lines(key).is_empty());
    }
    let connection =
        server.send("GET", "/v1/connections/phones", &[("authorization", admin.as_str())], "").await;
    assert!(!connection.expect(200).text().contains(edge.as_str()));
}
