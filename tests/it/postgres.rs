//! Several processes with one PostgreSQL database. `.ci/postgres` starts the server.

use std::fmt::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use sightfix::app::Retention;
use sightfix::clock::{Clock, Randomness};
use sightfix::config::Config;
use sightfix::server::Server;

use crate::harness::{TestServer, data_folder, now, run, sightfix, simulated_csv, store_arguments};

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

/// Samples a second apart; the last is `days` days old.
fn csv(count: i64, days: i64) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for second in 0..count {
        let time = now() - jiff::SignedDuration::from_secs(days * 86_400 + count - second);
        writeln!(csv, "{time},van,10,20,30,60,103.9,30.6").expect("memory");
    }
    csv
}

async fn import(server: &TestServer, csv: String) {
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &headers, csv).await.expect(200);
}

/// The output of a statement in the database of a folder.
fn sql(folder: &Path, statement: &str) -> String {
    let [_, url] = store_arguments(folder);
    let output = std::process::Command::new("psql").args([&url, "-Atqc", statement]).output();
    let output = output.expect("psql runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// The clock of one of two processes is 400 days ahead. Samples are deleted by the clock of the database.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn the_wrong_clock_of_one_node_deletes_no_samples() {
    let folder = data_folder();
    let right = node(folder.path(), "serve");
    right.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    import(&right, csv(500, 0)).await;
    import(&right, csv(40, 60)).await;
    let ahead = Clock::from_fn(|| now() + jiff::SignedDuration::from_hours(400 * 24));
    let [_, url] = store_arguments(folder.path());
    let mut config = Config { database: Some(url.into()), ..Config::default() };
    config.listen.set_port(0);
    config.limits.sample_days = 30;
    let wrong = Server::bind(config, ahead, Randomness::seeded(1)).await.expect("a free port");
    let deleted = wrong.app().samples().retain().await.expect("deleted");
    assert_eq!(deleted, Retention::Deleted(40), "those that are older by the right clock");
    let count = right.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 500);
    let audited = right.get("/v1/audit?limit=1").await.expect(200).json();
    assert_eq!(audited["items"][0]["action"], "samples-deleted", "{audited}");
}

/// Every page reads what it shows, not what is left: 20 pages of 20,000 samples read 20,000 rows, not 210,000.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_page_of_samples_reads_no_more_than_the_page() {
    const ROWS: i64 = 20_000;
    let folder = data_folder();
    let server = node(folder.path(), "serve");
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    import(&server, csv(ROWS, 0)).await;
    // Figures are published by each connection a second after it has used them.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let read = || {
        let sum = "SELECT sum(coalesce(seq_tup_read, 0) + coalesce(idx_tup_fetch, 0)) FROM pg_stat_user_tables \
                   WHERE relname LIKE 'samples%'";
        sql(folder.path(), sum).parse::<i64>().expect("a number")
    };
    sql(folder.path(), "ANALYZE");
    let before = read();
    let mut cursor = String::new();
    let (mut pages, mut shown) = (0, 0);
    loop {
        let path = format!("/v1/cameras/c/samples?limit=1000{cursor}");
        let page = server.get(&path).await.expect(200).json();
        (pages, shown) = (pages + 1, shown + page["items"].as_array().expect("items").len());
        let Some(next) = page["next_cursor"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    assert_eq!((pages, shown as i64), (20, ROWS));
    tokio::time::sleep(Duration::from_secs(2)).await;
    let rows = read() - before;
    println!("{pages} pages of {ROWS} samples read {rows} rows");
    assert!((ROWS..2 * ROWS).contains(&rows), "{rows} rows were read");
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

/// Several nodes that start on a new database with one admin key: all start, and none ever serves anybody without it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn nodes_that_start_at_once_with_one_admin_key_serve_nobody_without_it() {
    let secret = run(&["keys", "generate"]).trim().to_owned();
    let new_key = json!({"name": "mine", "role": "admin"});
    for _ in 0..4 {
        let folder = data_folder();
        run(&["migrate", "--data", folder.path().to_str().expect("UTF-8")]);
        let starting = (0..4).map(|_| {
            let (folder, secret) = (folder.path().to_owned(), secret.clone());
            tokio::task::spawn_blocking(move || {
                TestServer::start_with(&folder, &[("SIGHTFIX_ADMIN_KEY", &*secret)])
            })
        });
        for starting in starting.collect::<Vec<_>>() {
            let server = starting.await.expect("it starts");
            assert_eq!(server.post("/v1/keys", &new_key).await.status, 401);
        }
    }
}

/// Idle workers look for runs whose lease has expired, at moments of their own.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn live_runs_are_not_taken_by_idle_workers() {
    let folder = data_folder();
    let server = node(folder.path(), "serve");
    let mut paths = Vec::new();
    let headers = [("content-type", "text/csv")];
    for camera in ["a", "b"] {
        server.post("/v1/cameras", &json!({"id": camera})).await.expect(201);
        let samples = format!("/v1/cameras/{camera}/samples");
        server.send("POST", &samples, &headers, simulated_csv()).await.expect(200);
        let runs = format!("/v1/cameras/{camera}/training-runs");
        let run =
            server.post(&runs, &json!({"recipe": "paper", "seed": 7, "epochs": 2_000})).await.expect(202);
        paths.push(run.header("location").to_owned());
    }
    let workers: Vec<_> = (0..6).map(|_| node(folder.path(), "train")).collect();
    for path in paths {
        let ended = until(&server, &path, |run| run["ended_at"].is_string()).await;
        assert_eq!((&ended["state"], &ended["attempt"]), (&json!("succeeded"), &json!(1)), "{ended}");
    }
    drop(workers);
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
    let copy = folder.path().join("copy");
    let refused = sightfix().args(["copy", "--from", &url, "--to"]).arg(&copy).output().expect("runs");
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && text.contains(&server.address.to_string()), "{text}");
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
