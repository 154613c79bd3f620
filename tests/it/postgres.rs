//! Several processes with one PostgreSQL database. `.ci/postgres` starts the server.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, run, sightfix, simulated_csv, store_arguments};

const RUNS: &str = "/v1/cameras/c/training-runs";

/// A process of a role with the database of a folder. Leases are short.
fn node(folder: &Path, role: &str) -> TestServer {
    let settings = [("SIGHTFIX_ROLE", role), ("SIGHTFIX_TRAINING__LEASE_S", "3")];
    TestServer::start_with(folder, &settings)
}

async fn with_samples(server: &TestServer) {
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &headers, simulated_csv()).await.expect(200);
}

async fn start_run(server: &TestServer, request: &Value) -> String {
    server.post(RUNS, request).await.expect(202).header("location").to_owned()
}

/// Waits until a run is as wanted.
async fn until(server: &TestServer, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let mut seen = Value::Null;
    for _ in 0..2_400 {
        seen = server.get(path).await.expect(200).json();
        if wanted(&seen) {
            return seen;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("it does not change: {seen}")
}

fn trains(run: &Value) -> bool {
    run["state"] == "running" && run["progress"]["epoch"].as_u64() > Some(0)
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_worker_trains_and_every_node_serves_the_new_version_soon() {
    let folder = data_folder();
    let (first, second) = (node(folder.path(), "serve"), node(folder.path(), "serve"));
    with_samples(&first).await;
    let path = start_run(&first, &json!({"seed": 7, "epochs": 30})).await;
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    assert_eq!(first.get(&path).await.expect(200).json()["state"], "queued", "no worker is there");

    let worker = node(folder.path(), "train");
    worker.get("/livez").await.expect(200);
    worker.get("/v1/cameras").await.expect(404);
    let ended = until(&second, &path, |run| run["ended_at"].is_string()).await;
    assert_eq!((&ended["state"], &ended["model_version"]), (&json!("succeeded"), &json!(1)), "{ended}");

    let observation = json!({"time": "2020-12-14T00:00:00Z", "bounding_box":
        {"left_px": 500, "top_px": 400, "width_px": 60, "height_px": 120}});
    let activated = Instant::now();
    let mut took = Vec::new();
    for server in [&first, &second] {
        loop {
            let fused = server.post("/v1/cameras/c/fusions", &observation).await;
            if fused.status == 200 {
                assert_eq!(fused.json()["items"][0]["model_version"], 1);
                break took.push(activated.elapsed());
            }
            assert_eq!(fused.status, 409, "{}", fused.text());
            assert!(activated.elapsed() < Duration::from_secs(30), "the version does not arrive");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
    println!("served by two nodes {took:?} after the run was seen to have ended");
}

/// A worker that sleeps through its lease wakes up to a run that another has finished.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_frozen_worker_can_neither_end_nor_overwrite_a_run() {
    let folder = data_folder();
    let server = node(folder.path(), "serve");
    with_samples(&server).await;
    let frozen = node(folder.path(), "train");
    let path = start_run(&server, &json!({"recipe": "paper", "seed": 7, "epochs": 10_000})).await;
    until(&server, &path, trains).await;
    frozen.signal("-STOP");
    let awake = node(folder.path(), "train");
    let ended = until(&server, &path, |run| run["ended_at"].is_string()).await;
    assert_eq!((&ended["state"], &ended["attempt"]), (&json!("succeeded"), &json!(2)), "{ended}");

    frozen.signal("-CONT");
    // Where it was stopped within a transaction the database has ended its connection, and its heartbeat fails.
    let gives_up = ["lost its lease", "is left to the next worker"];
    let lost = frozen.logged(|entry| gives_up.iter().any(|words| entry.to_string().contains(words))).await;
    println!("the worker that woke up: {lost}");
    assert_eq!(server.get(&path).await.expect(200).json(), ended, "nothing has changed");
    let models = server.get("/v1/cameras/c/models").await.expect(200).json();
    assert_eq!(models["items"].as_array().map(Vec::len), Some(1), "{models}");
    drop(awake);
}

/// A command and a server share the database; the URL's password is nowhere in logs or errors.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn commands_use_the_database_and_those_for_folders_say_so() {
    let folder = data_folder();
    let samples = folder.path().join("samples.csv");
    std::fs::write(&samples, simulated_csv()).expect("written");
    let (samples, data) = (samples.to_str().expect("UTF-8"), folder.path().to_str().expect("UTF-8"));
    run(&["import", samples, "--camera", "c", "--create", "--data", data]);
    run(&["train", "--camera", "c", "--epochs", "20", "--data", data]);
    let server = TestServer::start(folder.path());
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    assert_eq!(camera["active_model"], 1, "{camera}");
    assert!(!folder.path().join("sightfix.db").exists(), "nothing is in the folder");

    let [flag, url] = store_arguments(folder.path());
    for command in [["backup", "copy.db"], ["restore", "copy.db"]] {
        let refused = sightfix().args(command).args([&flag, &url]).output().expect("runs");
        let text = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && text.contains("pg_dump"), "{text}");
    }
    let doctor = sightfix().args(["doctor", &flag, &url]).output().expect("runs");
    let text = String::from_utf8_lossy(&doctor.stdout).into_owned();
    assert!(text.contains("reachable, schema up to date"), "{text}");

    let absent = "postgres://someone:secret-word@127.0.0.1:1/none?application_name=secret-word";
    let refused = sightfix().args(["serve"]).env("SIGHTFIX_DATABASE", absent).output().expect("runs");
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(text.contains("postgres://127.0.0.1:1/none") && !text.contains("secret-word"), "{text}");
    assert_eq!(refused.status.code(), Some(3), "it may be tried again: {text}");
    let shown = sightfix().args(["config"]).env("SIGHTFIX_DATABASE", absent).output().expect("runs");
    let text = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(text.contains("database = \"(hidden)\""), "{text}");
}
