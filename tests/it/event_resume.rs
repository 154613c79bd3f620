//! Event streams whose connection breaks: what a client gets when it comes back with the id of its last event.

use std::time::Duration;

use http_body_util::BodyExt as _;
use hyper::body::Incoming;
use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, simulated_csv};

const EVENTS: &str = "/v1/cameras/c/events";

/// An event as it was sent.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Event {
    id: String,
    pub(crate) name: String,
    pub(crate) data: Value,
}

/// The events of an open response.
pub(crate) struct Events {
    body: Incoming,
    text: String,
}

impl Events {
    pub(crate) async fn open(server: &TestServer, path: &str, last_event_id: Option<&str>) -> Self {
        let headers: Vec<(&str, &str)> = last_event_id.into_iter().map(|id| ("last-event-id", id)).collect();
        let response = server.open("GET", path, &headers, "").await;
        assert_eq!(response.status(), 200);
        Self { body: response.into_body(), text: String::new() }
    }

    /// The next event; `None` at the end of the stream.
    pub(crate) async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some((event, rest)) = self.text.split_once("\n\n") {
                let field = |name: &str| {
                    let prefix = format!("{name}: ");
                    let line = event.lines().find_map(|line| line.strip_prefix(prefix.as_str()));
                    line.unwrap_or_default().to_owned()
                };
                let read = Event {
                    id: field("id"),
                    name: field("event"),
                    data: serde_json::from_str(&field("data")).unwrap_or(Value::Null),
                };
                self.text = rest.to_owned();
                if !read.name.is_empty() {
                    return Some(read);
                }
                continue;
            }
            let frame = self.body.frame().await?.expect("an open stream");
            if let Ok(bytes) = frame.into_data() {
                self.text.push_str(std::str::from_utf8(&bytes).expect("UTF-8"));
            }
        }
    }
}

async fn with_camera() -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    (folder, server)
}

/// Follows a target through a fix per second.
async fn follow(server: &TestServer, seconds: std::ops::Range<u32>) {
    for second in seconds {
        let time = format!("2020-12-14T06:{:02}:{:02}Z", second / 60, second % 60);
        let fix = json!({"longitude_deg": 103.98678, "latitude_deg": 30.628, "sigma_m": 2.0});
        let observation = json!({"time": time, "target_id": "a", "fix": fix});
        server.post("/v1/cameras/c/tracks", &observation).await.expect(200);
    }
}

fn times(events: &[Event]) -> Vec<&str> {
    events.iter().filter_map(|event| event.data["properties"]["time"].as_str()).collect()
}

#[tokio::test]
async fn a_client_that_comes_back_gets_what_it_has_missed() {
    let (_folder, server) = with_camera().await;
    let mut events = Events::open(&server, EVENTS, None).await;
    follow(&server, 0..2).await;
    let first = [events.next().await.expect("an event"), events.next().await.expect("an event")];
    assert!(first.iter().all(|event| event.name == "track" && !event.id.is_empty()), "{first:?}");
    assert_ne!(first[0].id, first[1].id);
    drop(events);
    follow(&server, 2..5).await;
    let mut events = Events::open(&server, EVENTS, Some(&first[1].id)).await;
    let mut missed = Vec::new();
    for _ in 0..3 {
        missed.push(events.next().await.expect("an event"));
    }
    assert_eq!(times(&missed), ["2020-12-14T06:00:02Z", "2020-12-14T06:00:03Z", "2020-12-14T06:00:04Z"]);
    // From the middle, and then what happens now.
    let mut events = Events::open(&server, EVENTS, Some(&missed[1].id)).await;
    assert_eq!(events.next().await.as_ref(), Some(&missed[2]));
    follow(&server, 5..6).await;
    assert_eq!(times(&[events.next().await.expect("an event")]), ["2020-12-14T06:00:05Z"]);
}

#[tokio::test]
async fn what_is_kept_no_more_is_said_to_be_lost() {
    let (folder, server) = with_camera().await;
    let mut events = Events::open(&server, EVENTS, None).await;
    follow(&server, 0..1).await;
    let first = events.next().await.expect("an event");
    // A reader keeps the log going, and reads nothing.
    for hour in ["07", "08"] {
        let batch: Vec<Value> = (0..1_000)
            .map(|n| {
                let time = format!("2020-12-14T{hour}:{:02}:{:02}Z", n / 60, n % 60);
                json!({"time": time, "target_id": "a", "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.628}})
            })
            .collect();
        server.post("/v1/cameras/c/tracks", &json!({ "observations": batch })).await.expect(200);
    }
    let mut again = Events::open(&server, EVENTS, Some(&first.id)).await;
    let lost = again.next().await.expect("an event");
    // 2,000 have happened since, of which the latest 1,024 are kept.
    assert_eq!((lost.name.as_str(), &lost.data), ("lost", &json!(976)));
    let mut kept = Vec::new();
    for _ in 0..1_024 {
        kept.push(again.next().await.expect("an event"));
    }
    assert_eq!(times(&kept).last(), Some(&"2020-12-14T08:16:39Z"));
    // The next event goes on after the loss.
    let mut later = Events::open(&server, EVENTS, Some(&lost.id)).await;
    assert_eq!(later.next().await.as_ref(), kept.first());

    // Another run of the server knows nothing of these events.
    drop((events, again, later));
    server.kill();
    let server = TestServer::start(folder.path());
    for id in [first.id.as_str(), "nonsense", "0000000000000000-5"] {
        let mut events = Events::open(&server, EVENTS, Some(id)).await;
        let lost = events.next().await.expect("an event");
        assert_eq!((lost.name.as_str(), &lost.data), ("lost", &Value::Null), "{id}");
    }
}

#[tokio::test]
async fn a_run_is_sent_again_only_if_it_has_changed() {
    let (_folder, server) = with_camera().await;
    let csv = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &csv, simulated_csv()).await.expect(200);
    let wish = json!({"recipe": "projective", "epochs": 40});
    let run = server.post("/v1/cameras/c/training-runs", &wish).await.expect(202);
    let path = format!("{}/events", run.header("location"));
    let mut events = Events::open(&server, &path, None).await;
    let mut seen = Vec::new();
    while let Some(event) = events.next().await {
        seen.push(event);
    }
    let last = seen.last().expect("events");
    assert_eq!((last.id.as_str(), &last.data["state"]), ("ended", &json!("succeeded")));
    let mut ids: Vec<&str> = seen.iter().map(|event| event.id.as_str()).collect();
    assert!(ids.iter().all(|id| !id.is_empty()) && ids.len() > 1, "{ids:?}");
    ids.dedup();
    assert_eq!(ids.len(), seen.len(), "each event says something else");
    // Behind any event but the last comes the last alone, for the run has ended.
    let mut events = Events::open(&server, &path, Some(ids[0])).await;
    assert_eq!(events.next().await.as_ref(), Some(last));
    assert_eq!(tokio::time::timeout(Duration::from_secs(60), events.next()).await.expect("the end"), None);
    server.send("GET", &path, &[("last-event-id", "ended")], "").await.expect(204);
}
