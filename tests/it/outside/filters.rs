//! Which boxes a source takes, and how those without a position are watched.

use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::track_service_client::TrackServiceClient;
use sightfix::grpc::proto::watch_camera_response::Event;

use super::peers::{connection_when, create_gate, patch};
use crate::event_resume::Events;
use crate::harness::{TestServer, data_folder, now};

/// The lower half of the image, as seen by the camera.
fn lower_half() -> Value {
    json!([{"x_px": 0, "y_px": 360}, {"x_px": 1280, "y_px": 360}, {"x_px": 1280, "y_px": 720}, {"x_px": 0, "y_px": 720}])
}

fn frigate(area: &Value) -> Value {
    json!({"id": "frigate", "source": {
        "address": "push:", "format": "frigate", "classes": ["person"], "least_score": 0.5,
        "cameras": {"front_door": {"camera_id": "gate", "area": area}},
    }})
}

/// An event of Frigate, whose box has its foot in the given row.
async fn push(server: &TestServer, id: &str, label: &str, score: f64, foot_px: f64) {
    let event = json!({"type": "update", "after": {
        "id": id, "camera": "front_door", "frame_time": now().as_microsecond() as f64 * 1e-6, "label": label,
        "false_positive": false, "score": score, "box": [600, foot_px - 100.0, 640, foot_px],
    }});
    server.post("/v1/connections/frigate/messages", &event).await.expect(204);
}

#[tokio::test]
async fn a_source_takes_boxes_of_its_classes_scores_and_area_which_are_events() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    server.post("/v1/connections", &frigate(&lower_half())).await.expect(201);
    let mut rest = Events::open(&server, "/v1/cameras/gate/events", None).await;
    let request = proto::WatchCameraRequest { camera_id: "gate".to_owned(), resume_after: String::new() };
    let mut grpc = TrackServiceClient::new(server.channel().await)
        .watch_camera(request)
        .await
        .expect("watched")
        .into_inner();
    push(&server, "of-another-class", "car", 0.9, 500.0).await;
    push(&server, "of-a-low-score", "person", 0.4, 500.0).await;
    push(&server, "outside", "person", 0.9, 350.0).await;
    push(&server, "taken", "Person", 0.75, 500.0).await;

    let seen = rest.next().await.expect("an event");
    assert_eq!((seen.name.as_str(), &seen.data["tracker_id"]), ("box", &json!("taken")), "{seen:?}");
    assert_eq!((&seen.data["class"], &seen.data["score"]), (&json!("Person"), &json!(0.75)));
    let sides = json!({"left_px": 600.0, "top_px": 400.0, "width_px": 40.0, "height_px": 100.0});
    assert_eq!(seen.data["bounding_box"], sides);
    let event = grpc.message().await.expect("an event").expect("an event").event;
    let Some(Event::Box(same)) = event else { panic!("{event:?}") };
    assert_eq!((same.tracker_id.as_deref(), same.class.as_deref()), (Some("taken"), Some("Person")));
    assert_eq!((same.score, same.target_id), (Some(0.75), None));
    assert_eq!(same.bounding_box.expect("a box").height_px, Some(100.0));

    let status =
        connection_when(&server, "frigate", |status| status["messages"] == 4).await["status"].clone();
    assert_eq!((&status["items"], &status["skipped"]), (&json!(1), &json!(3)), "{status}");
    let reasons: Vec<&str> = status["reasons"]
        .as_array()
        .expect("reasons")
        .iter()
        .map(|it| it["reason"].as_str().expect("text"))
        .collect();
    for part in ["class car", "least_score", "outside of the source's area"] {
        assert!(reasons.iter().any(|reason| reason.contains(part)), "{part}: {reasons:?}");
    }

    // Without its area the source takes what is outside of it.
    let change = json!({"source": {"cameras": {"front_door": {"area": null}}}});
    let changed = patch(&server, "frigate", &change).await.expect(200).json();
    assert_eq!(changed["source"]["cameras"]["front_door"], json!({"camera_id": "gate"}));
    connection_when(&server, "frigate", |status| status["connects"] == 2).await;
    push(&server, "above", "person", 0.9, 350.0).await;
    assert_eq!(rest.next().await.expect("an event").data["tracker_id"], "above");
}

#[tokio::test]
async fn an_area_that_is_none_is_refused_with_its_field() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let corners: Vec<Value> = (0..65).map(|at| json!({"x_px": at, "y_px": at * at})).collect();
    for area in [
        json!([]),
        json!(corners[..2]),
        json!(corners),
        json!([corners[0], corners[1], {"x_px": 1e9, "y_px": 0}]),
    ] {
        let refused = server.post("/v1/connections", &frigate(&area)).await.expect(422).json();
        assert_eq!(refused["violations"][0]["field"], "source.cameras.front_door.area", "{refused}");
    }
}
