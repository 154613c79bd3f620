//! A walk with a phone beside a camera: fixes of a receiver over REST, boxes of the camera over a live stream,
//! samples of both, a model of these.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::simulation::{Options, SimulatedRow};

use crate::harness::{TestServer, data_folder};
use crate::live_client::{boxed, channel, open, rows, yard};

const TRACKS: &str = "/v1/cameras/yard/tracks?store_samples=true";

/// A row's fix as the phone page sends it. The phone's clock is half a second ahead of the camera's.
fn fix_of_phone(row: &SimulatedRow) -> Value {
    let position = row.fix.expect("a fix").position;
    let fix = json!({
        "longitude_deg": position.longitude_deg(), "latitude_deg": position.latitude_deg(), "sigma_m": 2.0,
    });
    json!({"time": row.time + SignedDuration::from_millis(500), "receiver_id": "phone-1", "fix": fix})
}

/// Until when the target is tracked: a camera without a model tracks it by its fixes alone.
async fn tracked_until(server: &TestServer) -> Option<Timestamp> {
    let tracks = server.get("/v1/cameras/yard/tracks").await.expect(200).json();
    tracks["features"][0]["properties"]["time"].as_str()?.parse().ok()
}

#[tokio::test]
async fn fixes_of_a_phone_and_boxes_of_a_stream_become_samples_that_train_the_camera() {
    let folder = data_folder();
    let receivers = json!([{"receiver_id": "phone-1", "target_id": "walker", "clock_offset_s": -0.5}]);
    let server = yard(folder.path(), &[], json!({ "receivers": receivers }), false).await;
    let world = rows(&Options::demo());
    let walker = &world[0].target_id;
    // Each request has one of the camera's 64 places for streams until its fixes are decided, some seconds later.
    let walked: Vec<_> =
        world.iter().filter(|row| row.target_id == *walker && row.fix.is_some()).take(50).collect();
    assert_eq!(walked.len(), 50);

    let server = Arc::new(server);
    let channel = channel(&server).await;
    let mut edge = open(&channel, "edge", true).await;
    let mut requests = Vec::new();
    // Both devices send a second of the walk at a time, so neither is ahead by more than may be late.
    for part in walked.chunk_by(|a, b| a.time.as_second() == b.time.as_second()) {
        for row in part {
            edge.item(proto::StreamItem { target_id: Some("walker".to_owned()), ..boxed(row) }).await;
        }
        let body = json!({ "observations": part.iter().map(|row| fix_of_phone(row)).collect::<Vec<_>>() });
        let sender = server.clone();
        // Its answer comes when it is decided what becomes of the fixes, so the walk goes on meanwhile.
        requests.push(tokio::spawn(async move { sender.post(TRACKS, &body).await.expect(200).json() }));
        let latest = part[part.len() - 1].time;
        let mut waits = 0;
        while tracked_until(&server).await.is_none_or(|time| time < latest) {
            assert!(waits < 12_000, "the fixes of {latest} are not tracked");
            tokio::time::sleep(Duration::from_millis(5)).await;
            waits += 1;
        }
    }
    let mut in_samples = 0;
    for request in requests {
        let answer = request.await.expect("no panic");
        in_samples += answer["stored"]["in_samples"].as_u64().unwrap_or_default();
    }
    edge.finish().await;
    let path = "/v1/cameras/yard/samples";
    let count = server.get(&format!("{path}/count")).await.expect(200).json();
    assert_eq!(count, json!({"count": walked.len(), "without_fix": 0}), "{in_samples}");
    assert_eq!(in_samples, walked.len() as u64);
    let sample = server.get(&format!("{path}?limit=1")).await.expect(200).json()["items"][0].clone();
    assert_eq!(sample["target_id"], "walker", "the receivers of the profile say whose the phone is");
    assert_eq!(sample["time"], walked[0].time.to_string(), "in the camera's time");

    let run = server.train("yard", &json!({"recipe": "projective"})).await;
    assert_eq!((&run["state"], &run["model_version"]), (&json!("succeeded"), &json!(1)), "{run}");
}

#[tokio::test]
async fn what_finds_no_partner_is_said_and_nothing_is_stored_unasked() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "yard"})).await.expect(201);
    let fix = json!({"longitude_deg": 103.9, "latitude_deg": 30.6});
    let of_phone = json!({"time": "2026-01-01T00:00:00Z", "receiver_id": "phone-1", "fix": fix});
    let of_nobody = json!({"time": "2026-01-01T00:00:00Z", "fix": fix});
    let body = json!({"observations": [of_phone, of_nobody]});
    let answer = server.post(TRACKS, &body).await.expect(200).json();
    let expected = json!({
        "in_samples": 0, "no_target": 1, "unpaired": 1, "unmatched": 0, "too_late": 0, "duplicate": 0
    });
    assert_eq!(answer["stored"], expected, "{answer}");
    let unasked = server.post("/v1/cameras/yard/tracks", &body).await.expect(200).json();
    assert!(unasked.get("stored").is_none(), "{unasked}");
    // An unknown receiver is a target of its own name.
    let tracks = server.get("/v1/cameras/yard/tracks").await.expect(200).json();
    assert_eq!(tracks["features"][0]["properties"]["target_id"], "phone-1");
    // A whole sample needs no partner.
    let bounding_box = json!({"left_px": 1.0, "top_px": 2.0, "width_px": 3.0, "height_px": 4.0});
    let whole =
        json!({"time": "2026-01-01T00:00:01Z", "target_id": "a", "fix": fix, "bounding_box": bounding_box});
    let answer = server.post(TRACKS, &whole).await.expect(200).json();
    assert_eq!(answer["stored"]["in_samples"], 1, "{answer}");
    assert_eq!(server.get("/v1/cameras/yard/samples/count").await.expect(200).json()["count"], 1);
    let wrong = json!({"time": "2026-01-01T00:00:02Z", "receiver_id": "", "fix": fix});
    let problem = server.post(TRACKS, &wrong).await.expect(422).json();
    assert_eq!(problem["violations"][0]["field"], "receiver_id", "{problem}");
}
