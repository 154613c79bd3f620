//! Applications for phones at the front door: their credentials, and the answers that they expect.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use jiff::{Timestamp, ToSpan as _};
use serde_json::{Value, json};

use super::peers::create_gate;
use crate::harness::{TestServer, data_folder, now};

/// A server with the source `phones` for the camera `gate`, as "Add phone" in the console makes it, the key of its administrator and one of a device.
async fn start(settings: &[(&str, &str)]) -> (TestServer, tempfile::TempDir, String, String) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    create_gate(&server).await;
    let source = json!({"id": "phones", "source": {"address": "push:", "format": "phone", "camera_ids": ["gate"],
        "receiver_from": "sender", "store_samples": true}});
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

/// A request of an application with the settings of "Add phone" in the console, and the receiver that it names.
struct PhoneRequest {
    target: &'static str,
    path: String,
    authorization: Option<String>,
    body: String,
    states_time: bool,
}

/// One position of each application, at a time.
fn phone_requests(key: &str, time: Timestamp) -> Vec<PhoneRequest> {
    const LATITUDE: f64 = 30.628;
    const LONGITUDE: f64 = 103.98678;
    let (url, with_key) = (MESSAGES.to_owned(), format!("{MESSAGES}/{key}"));
    let basic = || Some(format!("Basic {}", STANDARD.encode(format!("jane:{key}"))));
    let request = |target, path: &str, authorization, body: Value| PhoneRequest {
        target,
        path: path.to_owned(),
        authorization,
        body: if body.is_null() { String::new() } else { body.to_string() },
        states_time: body["type"] != "update_location",
    };
    let (second, millisecond) = (time.as_second(), time.as_millisecond());
    let query = format!("lat={LATITUDE}&lon={LONGITUDE}&timestamp={second}&accuracy=6.0");
    vec![
        request(
            "anna/phone",
            &url,
            basic(),
            json!({"_type": "location", "topic": "owntracks/anna/phone", "tid": "an",
            "tst": second, "lat": LATITUDE, "lon": LONGITUDE, "acc": 6, "vac": 3, "batt": 81, "conn": "m", "t": "u"}),
        ),
        request(
            "82879256",
            &with_key,
            None,
            json!({"location": {"timestamp": time.to_string(), "is_moving": true,
            "coords": {"latitude": LATITUDE, "longitude": LONGITUDE, "accuracy": 6.1}}, "device_id": "82879256"}),
        ),
        request(
            "old-traccar",
            &format!("{with_key}?id=old-traccar&{query}&speed=0.2&bearing=26.2"),
            None,
            Value::Null,
        ),
        request("gpslogger", &format!("{url}?{query}&id=gpslogger"), basic(), Value::Null),
        request(
            "iphone",
            &url,
            Some(format!("Bearer {key}")),
            json!({"locations": [{"type": "Feature",
            "geometry": {"type": "Point", "coordinates": [LONGITUDE, LATITUDE]},
            "properties": {"timestamp": time.to_string(), "horizontal_accuracy": 5, "device_id": "iphone"}}]}),
        ),
        request(
            "pixel",
            &with_key,
            None,
            json!({"messageId": 0, "sessionId": "s", "deviceId": "pixel", "payload": [
            {"name": "location", "time": millisecond * 1_000_000,
             "values": {"latitude": LATITUDE, "longitude": LONGITUDE, "horizontalAccuracy": 4}}]}),
        ),
        // It names neither a receiver nor a time.
        request(
            "jane",
            &with_key,
            None,
            json!({"type": "update_location",
            "data": {"gps": [LATITUDE, LONGITUDE], "gps_accuracy": 6}}),
        ),
    ]
}

#[tokio::test]
async fn fixes_of_every_application_become_samples_with_the_boxes_that_come_after_them() {
    let (server, _folder, admin, edge) = start(&[]).await;
    let time = Timestamp::from_second(now().as_second()).expect("in range");
    let requests = phone_requests(&edge, time);
    for request in &requests {
        let PhoneRequest { path, authorization, body, .. } = request;
        let headers: Vec<_> = authorization.iter().map(|value| ("authorization", value.as_str())).collect();
        let answer = server.send("POST", path, &headers, body.clone()).await;
        assert!(answer.status.is_success(), "{path}: {} {}", answer.status, answer.text());
    }
    // A fix whose answer waited for its box would be too old for one that comes now.
    let seen = |target: &str, time: Timestamp| {
        json!({"time": time.to_string(), "target_id": target,
            "bounding_box": {"left_px": 600.0, "top_px": 300.0, "width_px": 40.0, "height_px": 90.0}})
    };
    let (untimed, timed): (Vec<_>, Vec<_>) = requests.iter().partition(|request| !request.states_time);
    let mut observations: Vec<Value> = timed.iter().map(|request| seen(request.target, time)).collect();
    // The instant at which the other came is known to the server alone.
    let instants = time.series(400.milliseconds()).take_while(|instant| *instant <= now());
    observations.extend(instants.map(|instant| seen(untimed[0].target, instant)));
    let boxes = json!({"observations": observations});
    let headers = [("content-type", "application/json"), ("authorization", admin.as_str())];
    let path = "/v1/cameras/gate/tracks?store_samples=true";
    server.send("POST", path, &headers, boxes.to_string()).await.expect(200);

    let samples = server.send("GET", "/v1/cameras/gate/samples", &headers[1..], "").await.expect(200).json();
    let samples = samples["items"].as_array().expect("items").iter();
    let mut stored: Vec<&str> = samples.map(|it| it["target_id"].as_str().expect("an id")).collect();
    stored.sort_unstable();
    let mut expected: Vec<&str> = requests.iter().map(|request| request.target).collect();
    expected.sort_unstable();
    assert_eq!(stored, expected);
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
