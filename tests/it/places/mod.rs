//! Places: from the first place to events, statistics and deliveries, over REST and gRPC.

mod broker;
mod crash;
mod events;
mod resource;

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};

use crate::harness::TestServer;

/// Where the camera `gate` looks.
const ORIGIN: [f64; 2] = [8.54, 47.37];
/// Metres of a degree of longitude there.
const METRES_PER_DEGREE: f64 = 75_481.0;

fn longitude_deg(east_m: f64) -> f64 {
    ORIGIN[0] + east_m / METRES_PER_DEGREE
}

/// A square of 40 m about the origin.
fn square(rules: &Value) -> Value {
    let (west, east) = (longitude_deg(-20.0), longitude_deg(20.0));
    let (south, north) = (ORIGIN[1] - 0.000_18, ORIGIN[1] + 0.000_18);
    let ring = [[west, south], [east, south], [east, north], [west, north], [west, south]];
    let geometry = json!({"type": "Polygon", "coordinates": [ring]});
    json!({"id": "square", "camera_id": "gate", "geometry": geometry, "rules": rules})
}

/// A line from south to north through the origin.
fn line() -> Value {
    let points = [[ORIGIN[0], ORIGIN[1] - 0.000_5], [ORIGIN[0], ORIGIN[1] + 0.000_5]];
    json!({
        "id": "line", "camera_id": "gate", "geometry": {"type": "LineString", "coordinates": points},
        "rules": [{"id": "over", "kind": "cross"}],
    })
}

/// Stores a place, and waits until it is evaluated.
async fn create(server: &TestServer, place: &Value) {
    server.post("/v1/places", place).await.expect(201);
    // A place is taken up within a second.
    tokio::time::sleep(Duration::from_millis(1_500)).await;
}

/// Drives a target along the parallel through the origin by its fixes, two a second, from and to some metres east.
async fn drive(server: &TestServer, target: &str, range_m: (f64, f64), speed_mps: f64, start: Timestamp) {
    drive_as(server, (target, None), range_m, speed_mps, start).await;
}

/// The same of a target with a class.
async fn drive_as(
    server: &TestServer,
    (target, class): (&str, Option<&str>),
    (from_m, to_m): (f64, f64),
    speed_mps: f64,
    start: Timestamp,
) {
    let steps = ((to_m - from_m).abs() / speed_mps * 2.0) as i64;
    let observations = (0..=steps).map(|step| {
        let time = start + SignedDuration::from_millis(500 * step);
        let east_m = from_m + (to_m - from_m).signum() * speed_mps * 0.5 * step as f64;
        let fix = json!({"longitude_deg": longitude_deg(east_m), "latitude_deg": ORIGIN[1], "sigma_m": 0.5});
        json!({"time": time.to_string(), "target_id": target, "class": class, "fix": fix})
    });
    let body = json!({"observations": observations.collect::<Vec<_>>()});
    // In a database that nodes share, the lease of a node that was killed lasts for some seconds.
    for _ in 0..100 {
        let answer = server.post("/v1/cameras/gate/tracks", &body).await;
        if answer.status == 200 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    panic!("the camera has no owner");
}

/// The events of all places, once there are so many.
async fn events_when(server: &TestServer, count: usize) -> Vec<Value> {
    let mut events = Vec::new();
    for _ in 0..500 {
        let page = server.get("/v1/place-events?limit=1000").await.expect(200).json();
        events = page["items"].as_array().expect("events").clone();
        if events.len() >= count {
            return events;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("{count} events do not come: {events:?}")
}
