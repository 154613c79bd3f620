//! World tracks: hand-over, events that can be resumed, limits, and what ends them.

use std::collections::{BTreeMap, BTreeSet};

use http_body_util::BodyExt as _;
use hyper::body::Incoming;
use serde_json::{Value, json};
use sightfix::geo::{EastNorth, Position};
use sightfix::grpc::proto;
use sightfix::grpc::proto::site_service_client::SiteServiceClient;
use sightfix::grpc::proto::watch_tracks_response::Event;

use super::two_cameras::{CAMERAS, Crossing, Noise, box_json, create, plane};
use crate::harness::{TestServer, data_folder};
use crate::live_client::channel;
use crate::parity::same_motion;

/// An event stream of a site.
pub(super) struct Events {
    body: Incoming,
    buffer: String,
}

/// One event: its name, its id and its data.
pub(super) struct SiteEvent {
    pub(super) name: String,
    id: String,
    pub(super) data: Value,
}

impl Events {
    pub(super) async fn open(server: &TestServer, after: &str) -> Self {
        let headers: &[(&str, &str)] = if after.is_empty() { &[] } else { &[("last-event-id", after)] };
        let response = server.open("GET", "/v1/sites/square/events", headers, "").await;
        assert_eq!(response.status(), 200);
        Self { body: response.into_body(), buffer: String::new() }
    }

    /// The next event; `None` at the end of the stream.
    async fn next(&mut self) -> Option<SiteEvent> {
        loop {
            if let Some((block, rest)) = self.buffer.split_once("\n\n") {
                let field = |name: &str| {
                    let line = block.lines().find_map(|line| line.strip_prefix(name));
                    line.map(|text| text.trim_start().to_owned()).unwrap_or_default()
                };
                let (name, id, data) = (field("event:"), field("id:"), field("data:"));
                self.buffer = rest.to_owned();
                if !name.is_empty() {
                    return Some(SiteEvent { name, id, data: serde_json::from_str(&data).expect("JSON") });
                }
                continue;
            }
            let frame = self.body.frame().await?.ok()?;
            self.buffer.push_str(std::str::from_utf8(&frame.into_data().ok()?).expect("ASCII"));
        }
    }

    /// Events until `count` of a name have come.
    pub(super) async fn until(&mut self, name: &str, count: usize) -> Vec<SiteEvent> {
        let mut events: Vec<SiteEvent> = Vec::new();
        while events.iter().filter(|event| event.name == name).count() < count {
            events.push(self.next().await.expect("no end"));
        }
        events
    }
}

/// Feeds a crossing frame by frame; every world track that an answer named, by walker.
async fn feed(
    server: &TestServer,
    crossing: &Crossing,
    noise: &mut Noise,
) -> BTreeMap<usize, BTreeSet<String>> {
    let mut named: BTreeMap<usize, BTreeSet<String>> = BTreeMap::new();
    for frame in 0..Crossing::FRAMES {
        for (index, camera) in CAMERAS.into_iter().enumerate() {
            let seen = crossing.seen(index, frame, noise);
            if seen.is_empty() {
                continue;
            }
            let observations: Vec<Value> = seen
                .iter()
                .map(|seen| {
                    json!({
                        "time": crossing.time(frame), "target_id": seen.tracker_id,
                        "bounding_box": box_json(seen.sides_px),
                    })
                })
                .collect();
            let path = format!("/v1/cameras/{camera}/tracks");
            let answer =
                server.post(&path, &json!({ "observations": observations })).await.expect(200).json();
            for (seen, item) in seen.iter().zip(answer["items"].as_array().expect("items")) {
                if let Some(id) = item["world_track_id"].as_str() {
                    named.entry(seen.walker).or_default().insert(id.to_owned());
                }
            }
        }
    }
    named
}

fn crossing(walkers: usize) -> Crossing {
    Crossing { start: "2026-02-01T12:00:00Z".parse().expect("an instant"), walkers }
}

fn distance_m(feature: &Value, truth: EastNorth) -> f64 {
    let degrees = |at: usize| feature["geometry"]["coordinates"][at].as_f64().expect("degrees");
    let position = Position::new(degrees(0), degrees(1)).expect("valid");
    plane().to_plane(position).distance_m(truth)
}

#[tokio::test]
async fn people_keep_their_world_track_from_camera_to_camera() {
    let folder = data_folder();
    // Frames wait this long for a machine that is busy with other tests.
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SITE_WAIT_MS", "5000")]);
    create(&server, true).await;
    let mut live = Events::open(&server, "").await;
    let crossing = crossing(3);
    let named = feed(&server, &crossing, &mut Noise::new(5)).await;
    // All tracks end soon after the last frame.
    let events = live.until("track_ended", 3).await;

    let ids: Vec<&BTreeSet<String>> = named.values().collect();
    assert!(ids.len() == 3 && ids.iter().all(|ids| ids.len() == 1), "one world track per walker: {named:?}");
    assert_eq!(ids.iter().copied().flatten().collect::<BTreeSet<_>>().len(), 3, "{named:?}");
    let of = |name: &str| events.iter().filter(|event| event.name == name).collect::<Vec<_>>();
    assert_eq!(of("track_started").len(), 3, "no false tracks");
    let handed_over: BTreeSet<&str> =
        of("handed_over").iter().filter_map(|event| event.data["track_id"].as_str()).collect();
    assert_eq!(handed_over.len(), 3, "{handed_over:?}");

    let walker_of: BTreeMap<&str, usize> =
        named.iter().flat_map(|(walker, ids)| ids.iter().map(|id| (id.as_str(), *walker))).collect();
    let frame_of = |event: &SiteEvent| {
        let time: jiff::Timestamp =
            event.data["properties"]["time"].as_str().expect("a time").parse().expect("RFC 3339");
        (time.duration_since(crossing.start).as_millis() / 200) as usize
    };
    let tracks = of("track");
    let (mut error_m, mut inside) = (0.0, 0);
    for event in &tracks {
        let id = event.data["properties"]["id"].as_str().expect("an id");
        let truth = crossing.position(walker_of[id], frame_of(event));
        let distance = distance_m(&event.data, truth);
        error_m += distance / tracks.len() as f64;
        inside += usize::from(distance <= event.data["properties"]["r95_m"].as_f64().expect("a radius"));
    }
    let both =
        |event: &&&SiteEvent| event.data["properties"]["sightings"].as_array().expect("a list").len() == 2;
    println!(
        "{} positions, mean error {error_m:.2} m, {inside} within r95, {} seen by both cameras",
        tracks.len(),
        tracks.iter().filter(both).count()
    );
    assert!(error_m < 0.6 && tracks.iter().filter(both).count() > 30, "{error_m} m");

    let metrics = server.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_world_tracks_started_total 3"), "{metrics}");
    assert!(metrics.contains("sightfix_world_tracks 0"), "{metrics}");
    assert!(metrics.contains("sightfix_site_items_total{outcome=\"late\"} 0"), "{metrics}");

    resumes_alike(&server, &events).await;
}

/// Both transports continue after any event, with the same ids and kinds.
async fn resumes_alike(server: &TestServer, events: &[SiteEvent]) {
    let (read, rest) = events.split_at(events.len() / 2);
    let last = &read.last().expect("events").id;
    let mut resumed = Events::open(server, last).await;
    let mut client = SiteServiceClient::new(channel(server).await);
    let request = proto::WatchTracksRequest { site_id: "square".to_owned(), resume_after: last.clone() };
    let mut watched = client.watch_tracks(request).await.expect("a stream").into_inner();
    for expected in rest {
        let event = resumed.next().await.expect("no end");
        assert_eq!((&event.name, &event.id, &event.data), (&expected.name, &expected.id, &expected.data));
        let message = watched.message().await.expect("no error").expect("no end");
        assert_eq!(message.event_id, expected.id);
        let name = match message.event.expect("set") {
            Event::Track(point) => {
                assert_eq!(expected.data["properties"]["id"], point.id);
                assert_eq!(expected.data["properties"]["r95_m"], point.r95_m);
                same_motion(&expected.data["properties"], point.motion.as_ref());
                "track"
            }
            Event::Started(_) => "track_started",
            Event::HandedOver(_) => "handed_over",
            Event::Identified(_) => "identified",
            Event::Merged(_) => "merged",
            Event::Ended(_) => "track_ended",
            Event::Lost(_) => "lost",
        };
        assert_eq!(name, expected.name);
    }
}

/// Feeds fixes of a receiver, one a second, through a camera without a model.
async fn feed_fixes(server: &TestServer, camera: &str, target: &str, from: usize, count: usize) {
    let crossing = crossing(1);
    for second in from..from + count {
        let fix = plane().to_position(crossing.position(0, 5 * second));
        let observation = json!({
            "time": crossing.time(5 * second), "target_id": target,
            "fix": {"longitude_deg": fix.longitude_deg(), "latitude_deg": fix.latitude_deg(), "sigma_m": 1.5},
        });
        server.post(&format!("/v1/cameras/{camera}/tracks"), &observation).await.expect(200);
    }
}

/// A fix of a quarter of an hour later, by which all other tracks have ended.
async fn end_tracks(server: &TestServer) {
    feed_fixes(server, "west", "phone-of-later", 1_000, 1).await;
}

#[tokio::test]
async fn receivers_alone_are_tracked_and_read_in_both_forms() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, false).await;
    let empty = server.get("/v1/sites/square/tracks").await.expect(200).json();
    assert_eq!(empty["items"], json!([]));
    let mut events = Events::open(&server, empty["last_event_id"].as_str().expect("an id")).await;

    // A track ends some time after its last fix, so this goes on until one was read.
    let mut second = 0;
    let (track, id) = loop {
        feed_fixes(&server, "west", "phone-1", second, 2).await;
        second += 2;
        let tracks = server.get("/v1/sites/square/tracks").await.expect(200).json();
        let Some(track) = tracks["items"].get(0).cloned() else { continue };
        let id = track["id"].as_str().expect("an id").to_owned();
        let path = format!("/v1/sites/square/tracks/{id}");
        let geojson = server.send("GET", &path, &[("accept", "application/geo+json")], "").await;
        if geojson.status == 404 {
            continue;
        }
        let geojson = geojson.expect(200);
        assert_eq!(geojson.header("content-type"), "application/geo+json");
        let features = geojson.json()["features"].as_array().expect("features").clone();
        let times: Vec<&str> =
            features.iter().map(|it| it["properties"]["time"].as_str().expect("a time")).collect();
        if times.len() >= 3 {
            assert!(times.is_sorted(), "{times:?}");
            break (track, id);
        }
    };
    assert_eq!(track["target_id"], "phone-1", "{track}");
    assert!(
        track["r95_m"].as_f64().expect("a radius") > 0.0 && track["position"]["latitude_deg"].is_number()
    );
    assert_eq!(track["sightings"], json!([]), "no camera sees it");
    assert!(track["covariance"]["east_m2"].as_f64().expect("a variance") > 0.0);

    let started = events.until("identified", 1).await;
    assert_eq!(started[0].name, "track_started");
    assert_eq!(started.last().expect("one").data["target_id"], "phone-1");
    end_tracks(&server).await;
    while events.until("track_ended", 1).await.last().expect("one").data["track_id"] != id.as_str() {}
    let ended = server.get(&format!("/v1/sites/square/tracks/{id}")).await.expect(404).json();
    assert_eq!(ended["type"], "urn:sightfix:problem:track-not-found");
    server.get("/v1/sites/square/tracks/17").await.expect(404);
}

#[tokio::test]
async fn a_reader_that_comes_back_too_late_is_told() {
    let folder = data_folder();
    let limits = [("SIGHTFIX_LIMITS__SITE_EVENTS", "20")];
    let server = TestServer::start_with(folder.path(), &limits);
    create(&server, false).await;
    let begin = server.get("/v1/sites/square/tracks").await.expect(200).json();
    let begin = begin["last_event_id"].as_str().expect("an id").to_owned();
    let mut live = Events::open(&server, &begin).await;
    feed_fixes(&server, "west", "phone-1", 0, 60).await;
    end_tracks(&server).await;
    let last = live.until("track_ended", 1).await.pop().expect("events");
    let number =
        |event: &SiteEvent| event.id.split_once('-').expect("an id").1.parse::<u64>().expect("a number");
    assert!(number(&last) > 60, "{}", last.id);

    let mut late = Events::open(&server, &begin).await;
    let lost = late.next().await.expect("an event");
    assert_eq!((lost.name.as_str(), &lost.data["reason"]), ("lost", &json!("too_old")));
    let count = lost.data["events"].as_u64().expect("a count");
    let kept = late.until("track_ended", 1).await;
    assert!(kept.len() <= 20 && kept.iter().all(|event| event.name != "lost"), "{}", kept.len());
    assert_eq!((number(&lost), number(&kept[0])), (count, count + 1), "nothing is lost unsaid");
    let mut resumed = Events::open(&server, &kept[4].id).await;
    assert_eq!(resumed.next().await.expect("an event").id, kept[5].id);
    let wrong = [("last-event-id", "yesterday")];
    let refused = server.send("GET", "/v1/sites/square/events", &wrong, "").await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "last-event-id");
    let refused = server.get("/v1/sites/square/events?last_event_id=yesterday").await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "last_event_id");

    assert!(server.terminate());
    assert!(live.next().await.is_none(), "streams end with the server");
    let server = TestServer::start_with(folder.path(), &limits);
    let tracks = server.get("/v1/sites/square/tracks").await.expect(200).json();
    assert_eq!(tracks["items"], json!([]), "the site is there, its tracks start again");
    let mut resumed = Events::open(&server, &last.id).await;
    let lost = resumed.next().await.expect("an event");
    assert_eq!((lost.name.as_str(), lost.data), ("lost", json!({"reason": "restarted"})));
    feed_fixes(&server, "west", "phone-1", 0, 4).await;
    let started = resumed.next().await.expect("an event");
    assert_eq!(started.name, "track_started");
    assert_ne!(started.id.split_once('-').expect("an id").0, last.id.split_once('-').expect("an id").0);
}

#[tokio::test]
async fn readers_end_with_their_site() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, false).await;
    let mut events = Events::open(&server, "").await;
    let mut client = SiteServiceClient::new(channel(&server).await);
    let request = proto::WatchTracksRequest { site_id: "square".to_owned(), ..Default::default() };
    let mut watched = client.watch_tracks(request).await.expect("a stream").into_inner();
    feed_fixes(&server, "west", "phone-1", 0, 3).await;
    assert_eq!(events.next().await.expect("an event").name, "track_started");

    for camera in CAMERAS {
        let refused = server.send("DELETE", "/v1/sites/square", &[], "").await.expect(409).json();
        assert_eq!(refused["type"], "urn:sightfix:problem:site-in-use");
        let headers = [("content-type", "application/json"), ("if-match", "*")];
        let path = format!("/v1/cameras/{camera}");
        server.send("PATCH", &path, &headers, r#"{"site": null}"#).await.expect(200);
    }
    server.send("DELETE", "/v1/sites/square", &[], "").await.expect(204);
    while events.next().await.is_some() {}
    let ended = loop {
        match watched.message().await {
            Ok(message) => assert!(message.is_some(), "the stream ends with a status"),
            Err(status) => break status,
        }
    };
    assert_eq!(ended.code(), tonic::Code::NotFound);
    server.get("/v1/sites/square/tracks").await.expect(404);
    server.get("/v1/sites/square/events").await.expect(404);
}

#[tokio::test]
async fn what_comes_late_or_out_of_range_is_counted_and_harms_nothing() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, false).await;
    let mut events = Events::open(&server, "").await;
    feed_fixes(&server, "west", "phone-1", 100, 2).await;
    events.until("track", 2).await;
    // The same fixes once more, fixes of the time before, and one far away.
    feed_fixes(&server, "east", "phone-1", 100, 2).await;
    feed_fixes(&server, "west", "phone-2", 10, 3).await;
    let far = json!({
        "time": crossing(1).time(520), "target_id": "phone-3",
        "fix": {"longitude_deg": 0.0, "latitude_deg": 0.0},
    });
    server.post("/v1/cameras/west/tracks", &far).await.expect(200);
    let metrics = loop {
        let metrics = server.get("/metrics").await.expect(200).text();
        if metrics.contains("sightfix_site_items_total{outcome=\"out_of_range\"} 1") {
            break metrics;
        }
    };
    end_tracks(&server).await;
    let ended = events.until("track_ended", 1).await;
    let identified = ended.iter().filter(|event| event.name == "identified");
    let targets: Vec<&Value> = identified.map(|event| &event.data["target_id"]).collect();
    assert_eq!(targets, ["phone-of-later"], "neither became a track");
    for line in [
        "sightfix_site_items_total{outcome=\"tracked\"} 2",
        "sightfix_site_items_total{outcome=\"late\"} 3",
        "sightfix_site_items_total{outcome=\"overflow\"} 0",
    ] {
        assert!(metrics.contains(line), "{line} is missing: {metrics}");
    }
}

#[tokio::test]
async fn a_stream_names_the_world_track_of_its_targets() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    let yard = json!({"id": "yard", "site": "square", "image_size": {"width_px": 1920, "height_px": 1080}});
    server.post("/v1/cameras", &yard).await.expect(201);
    crate::live_client::add_model(&server).await;
    let mut client = crate::live_client::open(&channel(&server).await, "edge-1", false).await;
    let options =
        sightfix::simulation::Options { seed: 31, samples: 400, ..sightfix::simulation::Options::demo() };
    let mut named = BTreeSet::new();
    for row in crate::live_client::rows(&options) {
        client.item(crate::live_client::boxed(&row)).await;
        named.extend(client.answer().await.world_track_id);
        if !named.is_empty() {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(1)).await;
    }
    assert_eq!(named.len(), 1, "{named:?}");
}
