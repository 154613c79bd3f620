//! A site is trained together: the versions of all cameras become active in one step or not at all.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use sightfix::domain::{CameraId, TargetId};
use sightfix::geo::{EastNorth, LocalPlane, Position};
use sightfix::grpc::proto;
use sightfix::grpc::proto::site_service_client::SiteServiceClient;
use sightfix::simulation::{LabelledDetection, SimulatedSite, SiteOptions, simulate_site};

use super::tracks::Events;
use crate::harness::{TestServer, data_folder, run};

const RUNS: &str = "/v1/sites/square/training-runs";
const CAMERAS: [&str; 2] = ["c1", "c2"];

/// Two cameras whose views overlap.
fn site(seed: u64) -> SimulatedSite {
    simulate_site(&SiteOptions {
        seed,
        receiver_seed: seed,
        cameras: 2,
        walkers: 14,
        vehicles: 0,
        receiver_share: 0.7,
        duration_s: 150.0,
        ..SiteOptions::default()
    })
}

/// Samples of a camera: the boxes of those who carry a receiver with the fix of the same instant.
pub(super) fn samples_csv(site: &SimulatedSite, camera: usize) -> String {
    let carrier: HashMap<_, &TargetId> = site.carriers.iter().map(|(id, target)| (id, target)).collect();
    let of_fix = |fix: &sightfix::domain::ReceivedFix| {
        let receiver = fix.receiver_id.as_ref().expect("named");
        ((fix.time, carrier[receiver]), fix.fix.position)
    };
    let fixes: HashMap<_, Position> = site.fixes.iter().map(of_fix).collect();
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for LabelledDetection { detection, target } in &site.cameras[camera].detections {
        let Some(target) = target else { continue };
        let Some(fix) = fixes.get(&(detection.time, target)) else { continue };
        let [left, top, width, height] = detection.bounding_box.sides_px();
        writeln!(
            csv,
            "{},{target},{left:.2},{top:.2},{width:.2},{height:.2},{:.8},{:.8}",
            detection.time,
            fix.longitude_deg(),
            fix.latitude_deg()
        )
        .expect("memory can be written");
    }
    csv
}

/// The site `square` with two cameras and their samples; the second camera gets at most `second_samples`.
async fn create(server: &TestServer, site: &SimulatedSite, second_samples: usize) {
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    let size = site.image_size;
    let size = json!({"width_px": size.width_px(), "height_px": size.height_px()});
    for (index, (camera, most)) in CAMERAS.into_iter().zip([usize::MAX, second_samples]).enumerate() {
        let profile = json!({"id": camera, "site": "square", "image_size": size});
        server.post("/v1/cameras", &profile).await.expect(201);
        let csv: Vec<String> =
            samples_csv(site, index).lines().take(most.saturating_add(1)).map(str::to_owned).collect();
        let headers = [("content-type", "text/csv")];
        server
            .send("POST", &format!("/v1/cameras/{camera}/samples"), &headers, csv.join("\n"))
            .await
            .expect(200);
    }
}

/// Waits until a run is as wanted.
pub(super) async fn until(server: &TestServer, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let mut seen = Value::Null;
    for _ in 0..6_000 {
        seen = server.get(path).await.expect(200).json();
        if wanted(&seen) {
            return seen;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("the run does not change: {seen}")
}

pub(super) fn has_ended(run: &Value) -> bool {
    !matches!(run["state"].as_str(), Some("queued" | "running" | "cancelling"))
}

pub(super) async fn start(server: &TestServer) -> String {
    server.post(RUNS, &json!({})).await.expect(202).header("location").to_owned()
}

async fn active_models(server: &TestServer) -> Vec<Value> {
    let mut active = Vec::new();
    for camera in CAMERAS {
        active.push(
            server.get(&format!("/v1/cameras/{camera}")).await.expect(200).json()["active_model"].clone(),
        );
    }
    active
}

/// Mean distance between the positions that the two cameras give to one target at one time, m.
async fn disagreement_m(server: &TestServer, site: &SimulatedSite) -> f64 {
    let plane = LocalPlane::new(site.origin);
    let mut positions: Vec<HashMap<(String, String), EastNorth>> = Vec::new();
    for (camera, simulated) in CAMERAS.into_iter().zip(&site.cameras) {
        let mut own = HashMap::new();
        let seen: Vec<_> = simulated.detections.iter().filter(|it| it.target.is_some()).step_by(3).collect();
        for batch in seen.chunks(500) {
            let observation = |it: &&LabelledDetection| {
                let [left, top, width, height] = it.detection.bounding_box.sides_px();
                let sides = json!({"left_px": left, "top_px": top, "width_px": width, "height_px": height});
                json!({"time": it.detection.time.to_string(), "bounding_box": sides})
            };
            let observations: Vec<Value> = batch.iter().map(observation).collect();
            let path = format!("/v1/cameras/{camera}/fusions");
            let answer = server.post(&path, &json!({"observations": observations})).await.expect(200).json();
            for (it, item) in batch.iter().zip(answer["items"].as_array().expect("items")) {
                let degrees = |name: &str| item["regressed"][name].as_f64().expect("degrees");
                let position =
                    Position::new(degrees("longitude_deg"), degrees("latitude_deg")).expect("valid");
                let target = it.target.as_ref().expect("filtered").to_string();
                own.insert((it.detection.time.to_string(), target), plane.to_plane(position));
            }
        }
        positions.push(own);
    }
    let common: Vec<f64> =
        positions[0].iter().filter_map(|(key, one)| Some(one.distance_m(*positions[1].get(key)?))).collect();
    assert!(common.len() > 50, "{} pairs", common.len());
    common.iter().sum::<f64>() / common.len() as f64
}

#[tokio::test]
async fn all_cameras_of_a_site_get_versions_that_agree_and_become_active_together() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let (trained, fresh) = (site(1), site(2));
    create(&server, &trained, usize::MAX).await;
    let key = [("content-type", "application/json"), ("idempotency-key", "tonight")];
    let first = server.send("POST", RUNS, &key, "{}").await.expect(202).json();
    let again = server.send("POST", RUNS, &key, "{}").await.expect(202).json();
    assert_eq!(first["id"], again["id"], "a repeated request starts no second run");
    let live = server.post(RUNS, &json!({})).await;
    if live.status == 409 {
        assert_eq!(live.json()["conflicting_id"], first["id"]);
    }
    let path = format!("{RUNS}/{}", first["id"].as_str().expect("an id"));
    let ended = until(&server, &path, has_ended).await;
    assert_eq!(ended["state"], "succeeded", "{ended}");
    println!("{}", ended["report_text"].as_str().expect("a text"));
    let report = &ended["report"];
    assert_eq!(report["is_activated"], true, "{ended}");
    let metres = |name: &str| report[name].as_f64().expect("metres");
    let (together_m, apart_m) = (metres("disagreement_m"), metres("disagreement_apart_m"));
    assert!(together_m < apart_m, "{together_m} {apart_m}");
    assert_eq!(active_models(&server).await, [1, 1]);
    let model = server.get("/v1/cameras/c1/models/1").await.expect(200).json();
    assert_eq!(model["metadata"]["joint_training"]["cameras"], json!(CAMERAS));
    let listed = server.get(RUNS).await.expect(200).json();
    assert!(listed["items"].as_array().expect("runs").iter().any(|run| run["id"] == first["id"]));

    let joint_m = disagreement_m(&server, &fresh).await;
    for camera in CAMERAS {
        let run = server.train(camera, &json!({"recipe": "projective", "epochs": 5})).await;
        let json_type = [("content-type", "application/json")];
        let number = json!({"number": run["model_version"]}).to_string();
        server
            .send("PUT", &format!("/v1/cameras/{camera}/active-model"), &json_type, number)
            .await
            .expect(200);
    }
    let single_m = disagreement_m(&server, &fresh).await;
    println!("people whom no camera had seen: {joint_m:.3} m together, {single_m:.3} m one by one");
    assert!(joint_m < single_m, "{joint_m} {single_m}");
}

#[tokio::test]
async fn world_tracks_state_the_error_that_the_cameras_have_in_common() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SITE_WAIT_MS", "5000")]);
    create(&server, &site(1), usize::MAX).await;
    let path = start(&server).await;
    assert_eq!(until(&server, &path, has_ended).await["state"], "succeeded");
    let mut live = Events::open(&server, "").await;
    let fresh = simulate_site(&SiteOptions {
        seed: 5,
        cameras: 2,
        walkers: 6,
        vehicles: 0,
        duration_s: 60.0,
        ..SiteOptions::default()
    });
    let plane = LocalPlane::new(fresh.origin);
    let truth: HashMap<(String, String), EastNorth> = fresh
        .truth
        .iter()
        .map(|(time, target, position)| ((time.to_string(), target.to_string()), plane.to_plane(*position)))
        .collect();
    feed(&server, &fresh).await;
    let (mut inside, mut all, mut error_m, mut radius_m) = (0.0, 0.0, 0.0, 0.0);
    while all < 100.0 {
        for event in live.until("track", 1).await.into_iter().filter(|event| event.name == "track") {
            let properties = &event.data["properties"];
            let Some(target) = properties["sightings"][0]["tracker_id"].as_str() else { continue };
            let time: jiff::Timestamp =
                properties["time"].as_str().expect("a time").parse().expect("RFC 3339");
            let Some(truth) = truth.get(&(time.to_string(), target.to_owned())) else { continue };
            let degrees = |at: usize| event.data["geometry"]["coordinates"][at].as_f64().expect("degrees");
            let position = Position::new(degrees(0), degrees(1)).expect("valid");
            let distance_m = plane.to_plane(position).distance_m(*truth);
            let r95_m = properties["r95_m"].as_f64().expect("a radius");
            inside += f64::from(u8::from(distance_m <= r95_m));
            (all, error_m, radius_m) = (all + 1.0, error_m + distance_m, radius_m + r95_m);
        }
    }
    let coverage = inside / all;
    println!(
        "{all} positions: error {:.2} m, radius {:.2} m, coverage {coverage:.3}",
        error_m / all,
        radius_m / all
    );
    // All positions share one draw of the receivers' errors, so the share is that of one draw too.
    assert!(coverage > 0.7 && radius_m < 6.0 * error_m, "{coverage}");
}

/// Boxes frame by frame; every camera's tracker knows the target's name.
pub(super) async fn feed(server: &TestServer, site: &SimulatedSite) {
    let mut frames: Vec<(jiff::Timestamp, CameraId, Value)> = Vec::new();
    for camera in &site.cameras {
        for LabelledDetection { detection, target } in &camera.detections {
            let [left, top, width, height] = detection.bounding_box.sides_px();
            let sides = json!({"left_px": left, "top_px": top, "width_px": width, "height_px": height});
            let target = target.as_ref().map(ToString::to_string);
            let item =
                json!({"time": detection.time.to_string(), "target_id": target, "bounding_box": sides});
            frames.push((detection.time, camera.id.clone(), item));
        }
    }
    frames.sort_by(|one, other| (one.0, &one.1).cmp(&(other.0, &other.1)));
    for frame in frames.chunk_by(|one, next| (one.0, &one.1) == (next.0, &next.1)) {
        let observations: Vec<&Value> = frame.iter().map(|(_, _, item)| item).collect();
        let path = format!("/v1/cameras/{}/tracks", frame[0].1);
        server.post(&path, &json!({"observations": observations})).await.expect(200);
    }
}

#[tokio::test]
async fn a_camera_with_too_few_samples_is_named_and_nothing_is_activated() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, &site(1), 15).await;
    let refused = server.post(RUNS, &json!({})).await.expect(422).json();
    let detail = refused["detail"].as_str().expect("a detail");
    assert!(detail.contains("15") && detail.contains("/v1/cameras/c2/samples"), "{refused}");
    assert_eq!(refused["type"], "urn:sightfix:problem:unusable-samples");
    let asked = proto::StartSiteTrainingRunRequest { site_id: "square".to_owned(), ..Default::default() };
    let mut client = SiteServiceClient::new(server.channel().await);
    let status = client.start_site_training_run(asked).await.expect_err("the same refusal");
    assert!(status.message().contains("/v1/cameras/c2/samples"), "{status}");

    // Enough to be asked for, too few to be held out.
    let csv: Vec<String> = samples_csv(&site(1), 1).lines().take(31).map(str::to_owned).collect();
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c2/samples", &headers, csv.join("\n")).await.expect(200);
    let ended = until(&server, &start(&server).await, has_ended).await;
    println!("{}", ended["outcome"]);
    if ended["state"] == "failed" {
        assert!(ended["outcome"].as_str().expect("a reason").contains("c2"), "{ended}");
        assert_eq!(active_models(&server).await, [Value::Null, Value::Null]);
    } else {
        assert_eq!(active_models(&server).await, [1, 1]);
    }

    let alone = json!({"site": null});
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/c2", &headers, alone.to_string()).await.expect(200);
    let refused = server.post(RUNS, &json!({})).await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "site", "{refused}");
}

#[tokio::test]
async fn a_cancelled_run_stores_nothing_and_both_interfaces_show_it_alike() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create(&server, &site(1), usize::MAX).await;
    let mut client = SiteServiceClient::new(server.channel().await);
    let asked = proto::StartSiteTrainingRunRequest { site_id: "square".to_owned(), ..Default::default() };
    let run = client.start_site_training_run(asked).await.expect("queued").into_inner().run.expect("a run");
    assert_eq!(run.subject, Some(proto::training_run::Subject::SiteId("square".to_owned())));
    let path = format!("{RUNS}/{}", run.id);
    server.post(&format!("{path}/cancel"), &json!({})).await.expect(200);
    let ended = until(&server, &path, has_ended).await;
    assert_eq!(ended["state"], "cancelled", "{ended}");
    assert_eq!(active_models(&server).await, [Value::Null, Value::Null]);
    let models = server.get("/v1/cameras/c1/models").await.expect(200).json();
    assert_eq!(models["items"], json!([]));
    let asked = proto::GetSiteTrainingRunRequest { site_id: "square".to_owned(), run_id: run.id.clone() };
    let same =
        client.get_site_training_run(asked.clone()).await.expect("known").into_inner().run.expect("a run");
    assert_eq!(same.state, i32::from(proto::TrainingRunState::Cancelled));
    let asked_page =
        proto::ListSiteTrainingRunsRequest { site_id: "square".to_owned(), ..Default::default() };
    let page = client.list_site_training_runs(asked_page).await.expect("a page").into_inner();
    assert_eq!(page.runs, [same]);
    let cancel = proto::CancelSiteTrainingRunRequest { site_id: "square".to_owned(), run_id: run.id };
    let refused = client.cancel_site_training_run(cancel).await.expect_err("it has ended");
    let rest = server.post(&format!("{path}/cancel"), &json!({})).await.expect(409).json();
    assert_eq!(rest["detail"], refused.message());
    let other = server.get("/v1/sites/other/training-runs").await.expect(404).json();
    assert_eq!(other["type"], "urn:sightfix:problem:site-not-found");
}

async fn running(folder: &Path) -> (TestServer, String) {
    let settings = [("SIGHTFIX_TRAINING__LEASE_S", "3")];
    let server = TestServer::start_with(folder, &settings);
    create(&server, &site(1), usize::MAX).await;
    let path = start(&server).await;
    until(&server, &path, |run| run["state"] == "running").await;
    (server, path)
}

#[tokio::test]
async fn a_run_whose_worker_was_killed_is_made_again_and_never_half_of_it() {
    let folder = data_folder();
    let (server, path) = running(folder.path()).await;
    server.kill();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_TRAINING__LEASE_S", "3")]);
    assert_eq!(active_models(&server).await, [Value::Null, Value::Null]);
    let ended = until(&server, &path, has_ended).await;
    assert_eq!((&ended["state"], &ended["attempt"]), (&json!("succeeded"), &json!(2)), "{ended}");
    assert_eq!(active_models(&server).await, [1, 1]);
}

#[tokio::test]
async fn the_command_line_trains_a_site() {
    let folder = data_folder();
    let data = folder.path().to_str().expect("UTF-8");
    let simulated = site(1);
    for (index, camera) in CAMERAS.into_iter().enumerate() {
        let file = folder.path().join(format!("{camera}.csv"));
        std::fs::write(&file, samples_csv(&simulated, index)).expect("written");
        let file = file.to_str().expect("UTF-8");
        run(&["import", file, "--camera", camera, "--create", "--site", "square", "--data", data]);
    }
    let text = run(&["train", "--site", "square", "--data", data]);
    println!("{text}");
    assert!(text.contains("c1: version 1") && text.contains("became active together"), "{text}");
}

#[tokio::test]
async fn a_site_run_has_its_limits() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CAMERAS_PER_SITE_RUN", "1")]);
    create(&server, &site(1), usize::MAX).await;
    let refused = server.post(RUNS, &json!({})).await.expect(422).json();
    assert!(
        refused["detail"].as_str().expect("a detail").contains("limits.cameras_per_site_run"),
        "{refused}"
    );
    assert!(server.terminate());
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SAMPLES_PER_SITE_RUN", "400")]);
    let ended = until(&server, &start(&server).await, has_ended).await;
    assert_eq!(ended["state"], "succeeded", "{ended}");
    for camera in ended["report"]["cameras"].as_array().expect("cameras") {
        assert_eq!(camera["samples"], 200, "{camera}");
    }
}
