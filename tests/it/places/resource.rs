//! `/v1/places` and `PlaceService`: what is stored, changed and refused, alike on both transports.

use hyper::body::Bytes;
use jiff::SignedDuration;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::place_geometry::Shape;
use sightfix::grpc::proto::place_service_client::PlaceServiceClient;
use sightfix::grpc::proto::track_scope::Scope;
use tonic::Code;

use super::{create, drive, events_when, line, square};
use crate::harness::{Answer, TestServer, data_folder, now, own_address};
use crate::outside::peers::create_gate;

async fn patch(server: &TestServer, change: &Value, etag: &str) -> Answer {
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", etag)];
    server.send("PATCH", "/v1/places/square", &headers, Bytes::from(change.to_string())).await
}

fn geometry(places: &[[f64; 2]]) -> proto::PlaceGeometry {
    let position = |[longitude_deg, latitude_deg]: &[f64; 2]| proto::Position {
        longitude_deg: Some(*longitude_deg),
        latitude_deg: Some(*latitude_deg),
    };
    let ring = proto::PositionList { positions: places.iter().map(position).collect() };
    proto::PlaceGeometry { shape: Some(Shape::Polygon(proto::PlacePolygon { rings: vec![ring] })) }
}

fn new_place(id: &str, geometry: proto::PlaceGeometry) -> proto::CreatePlaceRequest {
    proto::CreatePlaceRequest {
        id: id.to_owned(),
        scope: Some(proto::TrackScope { scope: Some(Scope::CameraId("gate".to_owned())) }),
        profile: Some(proto::PlaceProfile { geometry: Some(geometry), ..Default::default() }),
    }
}

#[tokio::test]
async fn a_place_is_stored_changed_and_deleted() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let created = server.post("/v1/places", &square(&json!([]))).await.expect(201);
    assert_eq!(created.header("location"), "/v1/places/square");
    let (etag, place) = (created.header("etag").to_owned(), created.json());
    assert_eq!((&place["probability"], &place["display_name"]), (&json!(0.95), &json!("square")));
    server.post("/v1/places", &square(&json!([]))).await.expect(409);

    let rules = json!([{"id": "in", "kind": "enter", "classes": ["person"]}]);
    let changed =
        patch(&server, &json!({"rules": rules, "display_name": "Square"}), &etag).await.expect(200).json();
    assert_eq!((&changed["rules"], &changed["revision"]), (&rules, &json!(2)));
    assert_eq!(changed["geometry"], place["geometry"]);
    patch(&server, &json!({"display_name": "Other"}), &etag).await.expect(412);

    let geojson = [("accept", "application/geo+json")];
    let feature = server.send("GET", "/v1/places/square", &geojson, Bytes::new()).await.expect(200);
    let mut again = feature.json();
    assert_eq!((&again["type"], &again["properties"]["camera_id"]), (&json!("Feature"), &json!("gate")));
    again["id"] = json!("again");
    for answered in ["revision", "created_at", "updated_at"] {
        again["properties"].as_object_mut().expect("an object").remove(answered);
    }
    let headers = [("content-type", "application/geo+json")];
    server.send("POST", "/v1/places", &headers, Bytes::from(again.to_string())).await.expect(201);
    let listed =
        server.send("GET", "/v1/places?camera=gate", &geojson, Bytes::new()).await.expect(200).json();
    assert_eq!(listed["features"].as_array().map(Vec::len), Some(2));

    let mut client = PlaceServiceClient::new(server.channel().await);
    let asked = proto::UpdatePlaceRequest {
        place_id: "square".to_owned(),
        profile: Some(proto::PlaceProfile { probability: Some(0.9), ..Default::default() }),
        ..Default::default()
    };
    let profile =
        client.update_place(asked).await.expect("changed").into_inner().place.expect("a place").profile;
    let profile = profile.expect("a profile");
    assert_eq!((profile.probability, profile.rules.len(), &*profile.display_name), (Some(0.9), 1, "Square"));

    server.send("DELETE", "/v1/places/square", &[], Bytes::new()).await.expect(204);
    server.get("/v1/places/square").await.expect(404);
    let listed = client.list_places(proto::ListPlacesRequest::default()).await.expect("listed").into_inner();
    assert_eq!(listed.places.iter().map(|place| &*place.id).collect::<Vec<_>>(), ["again"]);
}

#[tokio::test]
async fn geometry_that_cannot_be_evaluated_is_refused_alike() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut client = PlaceServiceClient::new(server.channel().await);
    let bow = [[8.0, 47.0], [8.001, 47.001], [8.001, 47.0], [8.0, 47.001], [8.0, 47.0]];
    let open = [[8.0, 47.0], [8.001, 47.0], [8.001, 47.001], [8.0, 47.001]];
    let wrapped = [[179.9, 0.0], [-179.9, 0.0], [-179.9, 0.1], [179.9, 0.0]];
    let polar = [[8.0, 89.0], [8.1, 89.0], [8.1, 89.1], [8.0, 89.0]];
    let large = [[8.0, 47.0], [9.0, 47.0], [9.0, 47.1], [8.0, 47.0]];
    let cases: [(&[[f64; 2]], &str); 5] = [
        (&bow, "not valid"),
        (&open, "first corner"),
        (&wrapped, "antimeridian"),
        (&polar, "pole"),
        (&large, "large"),
    ];
    for (ring, word) in cases {
        let mut place = square(&json!([]));
        place["geometry"]["coordinates"] = json!([ring]);
        let problem = server.post("/v1/places", &place).await.expect(422).json();
        let violation = &problem["violations"][0];
        assert_eq!(violation["field"], "geometry.coordinates", "{problem}");
        assert!(violation["message"].as_str().is_some_and(|text| text.contains(word)), "{word}: {problem}");
        let status = client.create_place(new_place("square", geometry(ring))).await.expect_err(word);
        assert_eq!(status.code(), Code::InvalidArgument);
        assert!(status.message().contains(word), "{word}: {status}");
    }
    for (field, value) in [
        ("camera_id", json!("nobody")),
        ("probability", json!(0.3)),
        ("radius_m", json!(5.0)),
        ("rules", json!([{"id": "a", "kind": "cross"}])),
        ("rules", json!([{"id": "a", "kind": "dwell"}])),
        ("rules", json!([{"id": "a", "kind": "enter"}, {"id": "a", "kind": "leave"}])),
        ("colour", json!("red")),
    ] {
        let mut place = square(&json!([]));
        place[field] = value;
        let problem = server.post("/v1/places", &place).await.expect(422).json();
        let named = problem["violations"][0]["field"].as_str().expect("a field");
        assert!(named.starts_with(field), "{field}: {problem}");
    }
    let listed = server.get("/v1/places").await.expect(200).json();
    assert_eq!(listed["items"], json!([]), "nothing was stored");
}

#[tokio::test]
async fn places_have_a_limit_and_go_with_their_camera() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__PLACES", "1")]);
    create_gate(&server).await;
    server.post("/v1/places", &line()).await.expect(201);
    server.post("/v1/places", &square(&json!([]))).await.expect(507);
    server.send("DELETE", "/v1/cameras/gate", &[], Bytes::new()).await.expect(204);
    server.get("/v1/places/line").await.expect(404);
}

/// The value of a counter.
async fn counter(server: &TestServer, name: &str) -> u64 {
    let metrics = server.get("/metrics").await.expect(200).text();
    let value = metrics.lines().find_map(|line| line.strip_prefix(&format!("{name} ")));
    value.expect("it is printed").parse().expect("a number")
}

#[tokio::test]
async fn measurements_beyond_the_limit_of_the_queue_are_counted() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__PLACE_QUEUE", "1")]);
    create_gate(&server).await;
    create(&server, &line()).await;
    drive(&server, "van", (-50.0, 50.0), 1.0, now() - SignedDuration::from_secs(200)).await;
    assert!(counter(&server, "sightfix_place_measurements_dropped_total").await > 0);
}

#[tokio::test]
async fn messages_of_events_beyond_the_limit_of_an_outbox_are_counted() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__OUTBOX_MESSAGES", "1")]);
    create_gate(&server).await;
    let nobody = format!("http://{}/", own_address());
    let sink = json!({"address": nobody, "content": "place_events", "camera_ids": ["gate"]});
    server.post("/v1/connections", &json!({"id": "hook", "sink": sink})).await.expect(201);
    create(&server, &line()).await;
    for target in ["a", "b", "c"] {
        drive(&server, target, (-50.0, 50.0), 10.0, now() - SignedDuration::from_secs(60)).await;
    }
    events_when(&server, 3).await;
    assert_eq!(counter(&server, "sightfix_place_messages_dropped_total").await, 2);
}
