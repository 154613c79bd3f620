//! Leases of background jobs: orderly restarts, and clocks that were wrong.

use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, simulated_csv};

const RUNS: &str = "/v1/cameras/c/training-runs";

/// A server over a camera with samples and a run that takes longer than any test; the run's path.
async fn with_long_run(folder: &Path) -> (TestServer, String) {
    let server = TestServer::start(folder);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &headers, simulated_csv()).await.expect(200);
    let path = start_long_run(&server).await;
    (server, path)
}

async fn start_long_run(server: &TestServer) -> String {
    let request = json!({"recipe": "paper", "epochs": 10_000});
    let run = server.post(RUNS, &request).await.expect(202);
    run.header("location").to_owned()
}

/// Waits until a run is as wanted.
async fn until(server: &TestServer, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let mut seen = Value::Null;
    for _ in 0..1_200 {
        seen = server.get(path).await.expect(200).json();
        if wanted(&seen) {
            return seen;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("the run does not change: {seen}")
}

fn trains(run: &Value) -> bool {
    run["state"] == "running" && run["progress"]["epoch"].as_u64() > Some(0)
}

#[tokio::test]
async fn orderly_restarts_are_no_attempts() {
    let folder = data_folder();
    let (mut server, path) = with_long_run(folder.path()).await;
    let mut restarts = 0;
    loop {
        let run = until(&server, &path, |run| trains(run) || run["state"] == "failed").await;
        assert_eq!((&run["state"], &run["attempt"]), (&json!("running"), &json!(1)), "{restarts}: {run}");
        if restarts == 6 {
            break;
        }
        assert!(server.terminate(), "the server ends in order");
        server = TestServer::start(folder.path());
        restarts += 1;
    }
    println!("{restarts} orderly restarts, still at attempt 1");
    server.post(&format!("{path}/cancel"), &json!({})).await.expect(200);
    until(&server, &path, |run| run["state"] == "cancelled").await;
}

/// The run was claimed while the clock was 400 days ahead; then the power failed and the clock was set
/// right. Its row is written as that claim has left it.
#[tokio::test]
async fn a_lease_of_a_clock_that_was_ahead_counts_as_expired() {
    let folder = data_folder();
    let (server, path) = with_long_run(folder.path()).await;
    until(&server, &path, trains).await;
    server.kill();
    let ahead_us: i64 = 400 * 86_400 * 1_000_000;
    let database = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    let changed = database
        .execute(
            "UPDATE training_runs SET lease_until_us = lease_until_us + ?1, started_at_us = started_at_us + ?1",
            [ahead_us],
        )
        .expect("the row can be written");
    assert_eq!(changed, 1);
    drop(database);

    let server = TestServer::start(folder.path());
    let run = until(&server, &path, |run| trains(run) && run["attempt"] == 2).await;
    println!("claimed again: attempt {}", run["attempt"]);
    server.post(&format!("{path}/cancel"), &json!({})).await.expect(200);
    until(&server, &path, |run| run["state"] == "cancelled").await;
    let next = start_long_run(&server).await;
    until(&server, &next, trains).await;
}
