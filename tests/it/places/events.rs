//! What happens at places.

use jiff::{SignedDuration, Timestamp};
use serde_json::json;
use sightfix::grpc::proto;
use sightfix::grpc::proto::place_service_client::PlaceServiceClient;

use super::{create, drive, drive_as, events_when, line, square};
use crate::event_resume::Events;
use crate::harness::{TestServer, data_folder, now};
use crate::outside::peers::create_gate;

#[tokio::test]
async fn a_drive_is_reported_by_the_rules_of_places_and_counted() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let rules = json!([{"id": "in", "kind": "enter"}, {"id": "out", "kind": "leave"}]);
    server.post("/v1/places", &square(&rules)).await.expect(201);
    create(&server, &line()).await;
    let start = now() - SignedDuration::from_secs(60);
    drive(&server, "van", (-100.0, 100.0), 10.0, start).await;

    let events = events_when(&server, 3).await;
    let kinds: Vec<_> = events.iter().map(|event| event["kind"].as_str().expect("a kind")).collect();
    assert_eq!(kinds, ["enter", "cross", "leave"]);
    for (event, true_s) in events.iter().zip([8.0, 10.0, 12.0]) {
        let time: Timestamp = event["time"].as_str().expect("a time").parse().expect("a time");
        let error_s = time.duration_since(start).as_secs_f64() - true_s;
        let sigma_s = event["time_sigma_s"].as_f64().expect("a number");
        assert!(error_s.abs() < 3.0 * sigma_s && sigma_s < 0.3, "{error_s}: {event}");
        assert_eq!((&event["track_id"], &event["camera_id"]), (&json!("van"), &json!("gate")));
    }
    assert_eq!(events[1]["direction"], "left_to_right");

    let statistics = "/v1/places/line/statistics?interval=hour&from=";
    let from = (start - SignedDuration::from_hours(2)).to_string();
    let counted = server.get(&format!("{statistics}{from}")).await.expect(200).json();
    assert_eq!(counted["total"]["left_to_right"]["count"], 1, "{counted}");
    assert_eq!(counted["total"]["right_to_left"]["count"], 0);
    let median = counted["total"]["speed_mps"][1]["value"].as_f64().expect("a median");
    assert!((median - 10.0).abs() < 0.5, "{counted}");
    let inside = server.get("/v1/places/square/statistics").await.expect(200).json();
    let dwell_s = inside["total"]["dwell_s"][1]["value"].as_f64().expect("a dwell time");
    assert!((dwell_s - 4.0).abs() < 0.3, "{inside}");

    let mut client = PlaceServiceClient::new(server.channel().await);
    let asked = proto::ListPlaceEventsRequest {
        filter: Some(proto::PlaceEventFilter { kind: "cross".to_owned(), ..Default::default() }),
        ..Default::default()
    };
    let crossings = client.list_place_events(asked).await.expect("answered").into_inner();
    assert_eq!(crossings.events.len(), 1);
    assert_eq!(crossings.events[0].id, events[1]["id"].as_str().expect("an id"));
}

#[tokio::test]
async fn a_rule_for_a_class_holds_for_its_targets_alone() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    create(&server, &square(&json!([{"id": "in", "kind": "enter", "classes": ["car"]}]))).await;
    let start = now() - SignedDuration::from_secs(60);
    drive_as(&server, ("ann", Some("person")), (-50.0, 50.0), 10.0, start).await;
    drive(&server, "unknown", (-50.0, 50.0), 10.0, start).await;
    drive_as(&server, ("van", Some("car")), (-50.0, 50.0), 10.0, start).await;
    let events = events_when(&server, 1).await;
    assert_eq!((&events[0]["target_id"], &events[0]["class"]), (&json!("van"), &json!("car")));
    assert_eq!(events.len(), 1);
}

#[tokio::test]
async fn a_reader_of_the_stream_misses_nothing_and_a_replay_adds_nothing() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    create(&server, &line()).await;
    let start = now() - SignedDuration::from_secs(120);
    let mut events = Events::open(&server, "/v1/place-events/stream?place=line", None).await;
    drive(&server, "van", (-50.0, 50.0), 10.0, start).await;
    let first = events.next().await.expect("an event");
    assert_eq!((first.name.as_str(), &first.data["place_id"]), ("place_event", &json!("line")));
    drop(events);

    drive(&server, "bus", (50.0, -50.0), 10.0, start).await;
    events_when(&server, 2).await;
    server.kill();
    let server = TestServer::start(folder.path());
    let mut resumed = Events::open(&server, "/v1/place-events/stream", Some("1")).await;
    let second = resumed.next().await.expect("an event");
    assert_eq!(
        (&second.data["track_id"], &second.data["direction"]),
        (&json!("bus"), &json!("right_to_left"))
    );

    // The same recording again, after a start of the server: its events are those that are known.
    tokio::time::sleep(std::time::Duration::from_millis(1_500)).await;
    drive(&server, "van", (-50.0, 50.0), 10.0, start).await;
    drive(&server, "new", (-50.0, 50.0), 10.0, start).await;
    let events = events_when(&server, 3).await;
    let tracks: Vec<_> = events.iter().map(|event| event["track_id"].as_str().expect("a track")).collect();
    assert_eq!(tracks, ["van", "bus", "new"]);
}

#[tokio::test]
async fn a_place_of_a_site_is_evaluated_with_world_tracks() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/sites", &json!({"id": "harbour"})).await.expect(201);
    server.post("/v1/cameras", &json!({"id": "gate", "site": "harbour"})).await.expect(201);
    let mut place = square(&json!([{"id": "in", "kind": "enter"}, {"id": "out", "kind": "leave"}]));
    let fields = place.as_object_mut().expect("an object");
    fields.remove("camera_id");
    fields.insert("site_id".to_owned(), json!("harbour"));
    create(&server, &place).await;
    let start = now() - SignedDuration::from_secs(60);
    drive(&server, "van", (-50.0, 50.0), 5.0, start).await;
    let events = events_when(&server, 2).await;
    for (event, (kind, true_s)) in events.iter().zip([("enter", 6.0), ("leave", 14.0)]) {
        assert_eq!((&event["kind"], &event["site_id"]), (&json!(kind), &json!("harbour")));
        let time: Timestamp = event["time"].as_str().expect("a time").parse().expect("a time");
        let error_s = time.duration_since(start).as_secs_f64() - true_s;
        assert!(
            error_s.abs() < 3.0 * event["time_sigma_s"].as_f64().expect("a number"),
            "{error_s}: {event}"
        );
    }
    assert_eq!(events.len(), 2);
}
