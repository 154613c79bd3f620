//! `sightfix doctor` on folders that are sound, missing or wrong.

use std::net::TcpListener;
use std::path::Path;

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, sightfix};

/// Runs the checks; the exit code, and the checks by name.
fn examine(folder: &Path, listen: &str) -> (Option<i32>, Vec<Value>) {
    let mut command = sightfix();
    command.args(["doctor", "--json", "--listen", listen, "--data"]).arg(folder);
    let output = command.output().expect("the binary runs");
    let checks = serde_json::from_slice(&output.stdout).expect("JSON");
    (output.status.code(), checks)
}

#[track_caller]
fn check<'c>(checks: &'c [Value], name: &str) -> &'c Value {
    checks.iter().find(|check| check["name"] == name).unwrap_or_else(|| panic!("no check {name}: {checks:?}"))
}

#[tokio::test]
async fn a_sound_server_passes_every_check() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let (code, checks) = examine(folder.path(), &server.address.to_string());
    for check in &checks {
        println!("{} {}: {} {}", check["status"], check["name"], check["finding"], check["remedy"]);
        assert_ne!(check["status"], "failed", "{check}");
        let has_remedy = check["remedy"].as_str().is_some_and(|remedy| !remedy.is_empty());
        assert_eq!(has_remedy, check["status"] != "ok", "{check}");
    }
    assert_eq!(code, Some(0));
    let names: Vec<_> = checks.iter().filter_map(|check| check["name"].as_str()).collect();
    let all = [
        "folder",
        "space",
        "lock",
        "database",
        "models",
        "retention",
        "clock",
        "port",
        "open files",
        "memory",
    ];
    assert_eq!(names, all);
    let lock = check(&checks, "lock")["finding"].as_str().expect("text").to_owned();
    assert!(lock.contains(&format!("process id {}", server.pid())), "{lock}");
    assert!(check(&checks, "port")["finding"].as_str().is_some_and(|it| it.contains("a server answers")));
    // Looking has changed nothing.
    server.get("/v1/cameras/c").await.expect(200);
    assert!(server.terminate());
}

#[tokio::test]
async fn what_is_wrong_is_named_with_its_remedy() {
    let folder = data_folder();
    let missing = folder.path().join("typo");
    let (code, checks) = examine(&missing, "127.0.0.1:0");
    assert_eq!((code, &check(&checks, "folder")["status"]), (Some(0), &json!("warning")), "{checks:?}");
    assert!(!missing.exists(), "looking makes no folder");

    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let ahead = jiff::Timestamp::from_second(4_000_000_000).expect("in range");
    let path = folder.path().join("sightfix.db");
    server.kill();
    let database = rusqlite::Connection::open(&path).expect("the database");
    let sql = "INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
               longitude_deg, latitude_deg) VALUES (1, ?1, 'p', 1, 1, 1, 1, 1, 1)";
    database.execute(sql, [ahead.as_microsecond()]).expect("a row");
    drop(database);
    // A program that accepts connections and never answers.
    let silent = TcpListener::bind("127.0.0.1:0").expect("a port");
    let (code, checks) = examine(folder.path(), &silent.local_addr().expect("its address").to_string());
    assert_eq!(code, Some(1));
    let (clock, port) = (check(&checks, "clock"), check(&checks, "port"));
    assert_eq!(clock["status"], "warning", "{clock}");
    assert!(clock["finding"].as_str().is_some_and(|finding| finding.contains("2096")), "{clock}");
    assert_eq!(port["status"], "failed", "{port}");
    assert!(port["remedy"].as_str().is_some_and(|remedy| remedy.contains("--listen")), "{port}");

    std::fs::write(&path, vec![b'x'; 5_000]).expect("written");
    for name in ["sightfix.db-wal", "sightfix.db-shm"] {
        let _ = std::fs::remove_file(folder.path().join(name));
    }
    let (code, checks) = examine(folder.path(), "127.0.0.1:0");
    assert_eq!((code, &check(&checks, "database")["status"]), (Some(1), &json!("failed")), "{checks:?}");
}
