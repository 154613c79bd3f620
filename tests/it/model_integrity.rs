//! Model files and stored models that are damaged or absurd: refused, or served without.

use std::ops::ControlFlow;
use std::path::Path;
use std::time::Duration;

use rand::{RngExt as _, SeedableRng as _};
use safetensors::SafeTensors;
use serde_json::{Value, json};
use sightfix::domain::{GnssError, Recipe};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::model::{Artifact, FitOptions, fit};
use sightfix::simulation::{Options, simulate};

use crate::harness::{Answer, TestServer, data_folder};

const FUSIONS: &str = "/v1/cameras/c/fusions";

fn artifact(recipe: Recipe) -> Artifact {
    let options = FitOptions {
        recipe,
        seed: 1,
        epochs: Some(2),
        image_size: None,
        gnss_error: GnssError::Unknown,
        gnss_bias_sigma_m: None,
    };
    let samples = simulate(&Options::demo()).training_samples();
    fit(&samples, &options, &mut |_| ControlFlow::Continue(())).expect("a fit")
}

async fn with_camera(folder: &Path) -> TestServer {
    let server = TestServer::start(folder);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    server
}

async fn upload(server: &TestServer, file: Vec<u8>) -> Answer {
    server.send("POST", "/v1/cameras/c/models", &[("content-type", "application/octet-stream")], file).await
}

async fn activate(server: &TestServer, number: u32) -> Answer {
    let json = [("content-type", "application/json")];
    let path = "/v1/cameras/c/active-model";
    server.send("PUT", path, &json, json!({"number": number}).to_string()).await
}

/// The artifact with the bytes of one tensor replaced, number by number.
fn with_tensor(artifact: &Artifact, name: &str, value: f64) -> Artifact {
    let tensors = SafeTensors::deserialize(&artifact.weights).expect("tensors");
    let view = tensors.tensor(name).expect("the tensor");
    let wide = view.dtype() == safetensors::Dtype::F64;
    let bytes = if wide { value.to_le_bytes().to_vec() } else { (value as f32).to_le_bytes().to_vec() };
    let begin = view.data().as_ptr() as usize - artifact.weights.as_ptr() as usize;
    let mut weights = artifact.weights.to_vec();
    for at in (begin..begin + view.data().len()).step_by(bytes.len()) {
        weights[at..at + bytes.len()].copy_from_slice(&bytes);
    }
    Artifact { metadata: artifact.metadata.clone(), weights: weights.into() }
}

fn with_parameter(artifact: &Artifact, name: &str, value: f64) -> Artifact {
    let mut changed = artifact.clone();
    changed.metadata.parameters.insert(name.to_owned(), value);
    changed
}

/// Without the scene that would limit its positions.
fn without_scene(mut artifact: Artifact) -> Artifact {
    artifact.metadata.parameters.retain(|name, _| !name.starts_with("scene_"));
    artifact
}

fn with_factor(artifact: &Artifact, factor: f64) -> Artifact {
    let mut changed = artifact.clone();
    changed.metadata.features[0].factor = factor;
    changed
}

#[tokio::test]
async fn absurd_but_finite_numbers_are_refused_by_name() {
    let folder = data_folder();
    let server = with_camera(folder.path()).await;
    let (projective, hybrid) = (artifact(Recipe::Projective), artifact(Recipe::Hybrid));
    let cases = [
        ("bounds", with_tensor(&projective, "bounds", 1e300)),
        ("from the origin", without_scene(with_tensor(&projective, "bounds", 1e9))),
        ("projection", with_tensor(&projective, "projection", 1e305)),
        ("coverage.radius", with_tensor(&projective, "coverage.radius", 3e38)),
        ("features", with_factor(&projective, 1e308)),
        ("features", with_factor(&hybrid, 1e308)),
        ("east_offset_m", with_parameter(&hybrid, "east_offset_m", 1e308)),
        ("from the origin", with_parameter(&hybrid, "east_offset_m", 1e9)),
        ("position_scale_m", with_parameter(&hybrid, "position_scale_m", 1e300)),
        ("r95_scale", with_parameter(&hybrid, "r95_scale", 1e9)),
    ];
    for good in [&projective, &hybrid] {
        upload(&server, good.to_file().expect("a file").to_vec()).await.expect(201);
    }
    let count = cases.len();
    for (named, absurd) in cases {
        let answer = upload(&server, absurd.to_file().expect("a file").to_vec()).await.expect(422);
        assert!(answer.text().contains(named), "{named}: {}", answer.text());
    }
    println!("{count} of {count} absurd models refused");
}

#[tokio::test]
async fn a_flipped_bit_anywhere_in_a_file_is_refused() {
    let folder = data_folder();
    let server = with_camera(folder.path()).await;
    let file = artifact(Recipe::Hybrid).to_file().expect("a file").to_vec();
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let (flips, mut refused) = (96, 0);
    for flip in 0..flips {
        let mut damaged = file.clone();
        // Half of them in the header, which is shorter than the tensors.
        let within = if flip % 2 == 0 { 4_000 } else { file.len() };
        let at = random.random_range(0..within);
        damaged[at] ^= 1u8 << random.random_range(0..8u32);
        let answer = upload(&server, damaged).await;
        refused += u32::from(answer.status.is_client_error());
    }
    println!("{refused} of {flips} flipped bits refused");
    assert_eq!(refused, flips);
    upload(&server, file).await.expect(201);
}

#[tokio::test]
async fn a_file_without_a_checksum_is_refused() {
    let folder = data_folder();
    let server = with_camera(folder.path()).await;
    let file = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors"));
    let file = file.expect("the reference model");
    let (_, header) = SafeTensors::read_metadata(&file).expect("safetensors");
    let mut entries = header.metadata().clone().expect("entries");
    entries.remove("sightfix.sha256").expect("the checksum");
    let tensors = SafeTensors::deserialize(&file).expect("safetensors").tensors();
    let without = safetensors::serialize(tensors, Some(entries)).expect("a file");
    let refused = upload(&server, without).await.expect(422);
    assert!(refused.text().contains("checksum"), "{}", refused.text());
    upload(&server, file).await.expect(201);
}

fn observation(with_fix: bool) -> Value {
    let mut observation = json!({
        "time": "2026-01-01T00:00:00Z",
        "bounding_box": {"left_px": 600.0, "top_px": 300.0, "width_px": 30.0, "height_px": 80.0},
    });
    if with_fix {
        observation["fix"] = json!({"longitude_deg": 24.7453, "latitude_deg": 59.4371});
    }
    observation
}

/// Waits until the camera answers a box without a fix by that status.
async fn until_answered_by(server: &TestServer, camera: &str, status: u16) {
    for _ in 0..600 {
        let answer = server.post(&format!("/v1/cameras/{camera}/fusions"), &observation(false)).await;
        if answer.status.as_u16() == status {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{camera} does not answer by {status}")
}

async fn model_fault_by_grpc(server: &TestServer) -> Option<String> {
    let address = format!("http://{}", server.address);
    let mut cameras = CameraServiceClient::connect(address).await.expect("gRPC is on the same port");
    let request = proto::GetCameraRequest { camera_id: "c".to_owned() };
    let camera = cameras.get_camera(request).await.expect("the camera").into_inner().camera;
    camera.expect("set").model_fault
}

#[tokio::test]
async fn a_damaged_stored_model_leaves_fixes_and_tells_once() {
    let folder = data_folder();
    let server = with_camera(folder.path()).await;
    let file = artifact(Recipe::Hybrid).to_file().expect("a file").to_vec();
    upload(&server, file.clone()).await.expect(201);
    activate(&server, 1).await.expect(200);
    // A second camera with the same model shows later when the server has looked for changes.
    server.post("/v1/cameras", &json!({"id": "other"})).await.expect(201);
    let headers = [("content-type", "application/octet-stream")];
    server.send("POST", "/v1/cameras/other/models", &headers, file).await.expect(201);
    let sound = server.post(FUSIONS, &observation(true)).await.expect(200).json();
    assert_eq!(sound["items"][0]["model_version"], 1);
    server.kill();

    let path = folder.path().join("sightfix.db");
    let database = rusqlite::Connection::open(path).expect("the database");
    let weights: Vec<u8> = database
        .query_row("SELECT weights FROM models ORDER BY camera_key LIMIT 1", [], |row| row.get(0))
        .expect("the weights");
    let mut damaged = weights.clone();
    // A bit in the middle of a number's mantissa: the model loads, and answers a little differently.
    let at = damaged.len() - 2_001;
    damaged[at] ^= 4;
    let write = |weights: &[u8]| {
        let sql = "UPDATE models SET weights = ?1 WHERE camera_key = (SELECT min(camera_key) FROM models)";
        assert_eq!(database.execute(sql, [weights]).expect("the row can be written"), 1);
    };
    write(&damaged);

    let server = TestServer::start(folder.path());
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    println!("profile: {}", camera["model_fault"]);
    assert!(camera["model_fault"].as_str().is_some_and(|fault| fault.contains("checksum")), "{camera}");
    assert!(model_fault_by_grpc(&server).await.is_some_and(|fault| fault.contains("checksum")));
    let passed = server.post(FUSIONS, &observation(true)).await.expect(200).json();
    let item = &passed["items"][0];
    assert_eq!((&item["fused"], item["confidence_gnss"].as_f64()), (&item["gnss"], Some(1.0)), "{passed}");
    let refused = server.post(FUSIONS, &observation(false)).await.expect(409);
    assert!(refused.text().contains("no-model") && refused.text().contains("checksum"), "{}", refused.text());
    let ready = server.get("/readyz").await.expect(200).text();
    assert!(ready.starts_with("ready\n") && ready.contains("degraded: camera c: version 1"), "{ready}");
    for answer in [activate(&server, 1).await, server.get("/v1/cameras/c/models/1/file").await] {
        assert!(answer.expect(409).text().contains("model-unusable"));
    }
    for (active, status) in [("1", 200), ("NULL", 409), ("1", 200)] {
        database
            .execute_batch(&format!("UPDATE cameras SET active_model = {active} WHERE id = 'other'"))
            .expect("the row can be written");
        until_answered_by(&server, "other", status).await;
    }
    let lines = server.log_lines("active model cannot be used");
    println!("log lines after three looks: {}", lines.len());
    assert_eq!(lines.len(), 1, "{lines:?}");

    write(&weights);
    until_answered_by(&server, "c", 200).await;
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    assert!(camera["model_fault"].is_null(), "{camera}");
    assert_eq!(server.post(FUSIONS, &observation(true)).await.expect(200).json(), sound);
}
