//! A camera that is knocked is found by what the other cameras of its site see, without any fix.

use std::time::Duration;

use serde_json::{Value, json};
use sightfix::domain::BoundingBox;
use sightfix::simulation::{SimulatedSite, SiteOptions, simulate_site};

use super::training::{feed, has_ended, samples_csv, start, until};
use crate::harness::{TestServer, data_folder};

const CAMERAS: [&str; 3] = ["c1", "c2", "c3"];
/// What the second camera is knocked by, image widths: 60 px of 1,920.
const KNOCK: f64 = 1.0 / 32.0;

/// Three cameras that see one place; the walkers of each seed are others.
fn site(seed: u64, duration_s: f64) -> SimulatedSite {
    let walkers =
        SiteOptions { seed, receiver_seed: seed, walkers: 14, vehicles: 0, ..SiteOptions::default() };
    simulate_site(&SiteOptions { cameras: 3, cameras_per_group: 3, duration_s, ..walkers })
}

async fn create(server: &TestServer, site: &SimulatedSite) {
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    let size = json!({"width_px": site.image_size.width_px(), "height_px": site.image_size.height_px()});
    for (index, camera) in CAMERAS.into_iter().enumerate() {
        let profile = json!({"id": camera, "site": "square", "image_size": size});
        server.post("/v1/cameras", &profile).await.expect(201);
        let (path, headers) = (format!("/v1/cameras/{camera}/samples"), [("content-type", "text/csv")]);
        server.send("POST", &path, &headers, samples_csv(site, index)).await.expect(200);
    }
}

/// The second camera turns to the left in the middle; it sees no box that leaves the image.
fn knocked(mut site: SimulatedSite) -> SimulatedSite {
    let width_px = f64::from(site.image_size.width_px());
    let detections = &mut site.cameras[1].detections;
    let middle = detections[detections.len() / 2].detection.time;
    detections.retain_mut(|own| {
        if own.detection.time < middle {
            return true;
        }
        let [left, top, width, height] = own.detection.bounding_box.sides_px();
        let left = left + KNOCK * width_px;
        let moved = BoundingBox::new(left, top, width, height).ok().filter(|_| left + width <= width_px);
        moved.map(|moved| own.detection.bounding_box = moved).is_some()
    });
    site
}

async fn moved(server: &TestServer, camera: &str) -> Value {
    server.get(&format!("/v1/cameras/{camera}")).await.expect(200).json()["moved"].clone()
}

#[tokio::test]
async fn a_knocked_camera_is_found_by_the_others_of_its_site() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, &site(1, 150.0)).await;
    let path = start(&server).await;
    assert_eq!(until(&server, &path, has_ended).await["state"], "succeeded");
    feed(&server, &knocked(site(5, 240.0))).await;
    let mut found = Value::Null;
    for _ in 0..100 {
        found = moved(&server, "c2").await;
        if !found.is_null() {
            break;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(found["model_version"], 1, "{found}");
    assert!(found["targets"].as_u64() >= Some(3), "{found}");
    for camera in ["c1", "c3"] {
        assert!(moved(&server, camera).await.is_null(), "{camera}");
    }
    // Its positions say so, and state the shift as an error.
    let sides = json!({"left_px": 600.0, "top_px": 330.0, "width_px": 27.0, "height_px": 73.0});
    let observation = json!({"time": "2026-02-01T12:00:00Z", "bounding_box": sides});
    let answer = server.post("/v1/cameras/c2/fusions", &json!({"observations": [observation]})).await;
    let fused = answer.expect(200).json()["items"][0].clone();
    assert!(fused["flags"].to_string().contains("camera_moved"), "{fused}");
}
