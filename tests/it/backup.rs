//! Backups of a server that is at work, and what restoring them brings back.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use serde_json::json;
use tempfile::TempDir;

use crate::data_folder::damage_samples;
use crate::harness::{TestServer, data_folder, sightfix};

/// Rows of one import, which is stored as a whole.
const ROWS: u64 = 250;

/// Runs a command on a data folder; its exit code, and all that it prints.
fn command(name: &str, file: &Path, folder: &Path, flags: &[&str]) -> (Option<i32>, String) {
    let mut command = sightfix();
    command.arg(name).arg(file).args(flags).arg("--data").arg(folder);
    let output = command.output().expect("the binary runs");
    let text =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    (output.status.code(), text)
}

fn csv(import: u64) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for row in 0..ROWS {
        let second = i64::try_from(1_600_000_000 + import * ROWS + row).expect("in range");
        let time = jiff::Timestamp::from_second(second).expect("in range");
        csv += &format!("{time},person-1,{},20,30,60,103.9,30.6\n", row % 1_000);
    }
    csv
}

fn count(database: &Path) -> u64 {
    let database = rusqlite::Connection::open(database).expect("a database");
    let check: String =
        database.query_row("PRAGMA integrity_check", [], |row| row.get(0)).expect("it can be checked");
    assert_eq!(check, "ok");
    let count: i64 =
        database.query_row("SELECT count(*) FROM samples", [], |row| row.get(0)).expect("a count");
    u64::try_from(count).expect("not negative")
}

/// Imports until the flag says stop, and counts what was acknowledged.
async fn import_until(server: &TestServer, stop: &AtomicBool, acknowledged: &AtomicU64) {
    for import in 0.. {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        let headers = [("content-type", "text/csv")];
        server.send("POST", "/v1/cameras/c/samples", &headers, csv(import)).await.expect(200);
        acknowledged.fetch_add(ROWS, Ordering::Relaxed);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_during_imports_holds_what_was_acknowledged_before_and_can_be_restored() {
    let folder = data_folder();
    let data = folder.path().join("data");
    let file = folder.path().join("backup.db");
    let server = TestServer::start(&data);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let (stop, acknowledged) = (AtomicBool::new(false), Arc::new(AtomicU64::new(0)));
    let backing_up = async {
        let mut backups = Vec::new();
        for round in 1..=3_u64 {
            while acknowledged.load(Ordering::Relaxed) < round * 8 * ROWS {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            let before = acknowledged.load(Ordering::Relaxed);
            let flags: &'static [&'static str] = if round == 1 { &[] } else { &["--replace"] };
            let (file, data) = (file.clone(), data.clone());
            let backup =
                tokio::task::spawn_blocking(move || (command("backup", &file, &data, flags), count(&file)));
            let ((code, text), stored) = backup.await.expect("no panic");
            assert_eq!(code, Some(0), "{text}");
            println!("backup {round}: acknowledged before {before}, in the backup {stored}; {}", text.trim());
            assert!(stored >= before && stored.is_multiple_of(ROWS), "{stored} of {before}: {text}");
            backups.push(stored);
        }
        stop.store(true, Ordering::Relaxed);
        backups
    };
    let (backups, ()) = tokio::join!(backing_up, import_until(&server, &stop, &acknowledged));

    let (code, text) = command("backup", &file, &data, &[]);
    assert!(code == Some(1) && text.contains("--replace"), "{code:?} {text}");
    server.post("/v1/cameras", &json!({"id": "later"})).await.expect(201);
    let (code, text) = command("restore", &file, &data, &[]);
    assert!(code == Some(3) && text.contains("in use by server"), "{code:?} {text}");
    server.get("/v1/cameras/later").await.expect(200);
    server.kill();

    let (code, text) = command("restore", &file, &data, &[]);
    assert_eq!(code, Some(0), "{text}");
    let server = TestServer::start(&data);
    server.get("/v1/cameras/later").await.expect(404);
    let count_path = "/v1/cameras/c/samples/count";
    let restored = server.get(count_path).await.expect(200).json()["count"].as_u64();
    assert_eq!(restored, backups.last().copied());
    let kept = kept_databases(&data);
    assert_eq!(kept.len(), 1, "{kept:?}");
    let database = rusqlite::Connection::open(&kept[0]).expect("the database before");
    let cameras: i64 =
        database.query_row("SELECT count(*) FROM cameras", [], |row| row.get(0)).expect("a count");
    assert_eq!(
        (cameras, count(&kept[0])),
        (2, acknowledged.load(Ordering::Relaxed)),
        "nothing of it is lost"
    );
}

fn kept_databases(data: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(data).expect("listed").filter_map(Result::ok);
    let paths = entries.map(|entry| entry.path());
    paths.filter(|path| path.to_string_lossy().contains("before-restore")).collect()
}

/// A folder with samples, and a backup of it.
async fn folder_and_backup() -> (TempDir, PathBuf) {
    let folder = data_folder();
    let data = folder.path().join("data");
    let server = TestServer::start(&data);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    for import in 0..8 {
        let headers = [("content-type", "text/csv")];
        server.send("POST", "/v1/cameras/c/samples", &headers, csv(import)).await.expect(200);
    }
    let file = folder.path().join("backup.db");
    let (code, text) = command("backup", &file, &data, &[]);
    assert_eq!(code, Some(0), "{text}");
    assert!(server.terminate());
    (folder, file)
}

#[tokio::test]
async fn a_backup_with_one_flipped_bit_is_not_restored() {
    let (folder, file) = folder_and_backup().await;
    let sound = std::fs::read(&file).expect("the backup");
    let target = folder.path().join("restored");
    let last = sound.len() - 1;
    let bytes = (0..40).map(|n| n * last / 39).chain((0..116).step_by(9).map(|n| last - n));
    for (at, byte) in bytes.enumerate() {
        let mut flipped = sound.clone();
        flipped[byte] ^= 1 << (at % 8);
        std::fs::write(&file, &flipped).expect("written");
        let (code, text) = command("restore", &file, &target, &["--without-digest"]);
        assert!(
            code == Some(4) && !target.join("sightfix.db").exists(),
            "bit of byte {byte}: {code:?} {text}"
        );
    }
    // Cut off where the pages end, it is a database as any other.
    std::fs::write(&file, &sound[..sound.len() - 116]).expect("written");
    let (code, text) = command("restore", &file, &target, &[]);
    assert!(code == Some(1) && text.contains("has no digest"), "{code:?} {text}");
    std::fs::write(&file, &sound).expect("written");
    let (code, text) = command("restore", &file, &target, &[]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(count(&target.join("sightfix.db")), 8 * ROWS);
}

#[tokio::test]
async fn a_backup_without_a_digest_is_restored_only_on_request_and_doctor_tells() {
    let (folder, file) = folder_and_backup().await;
    let examined = |file: &Path| {
        let mut doctor = sightfix();
        doctor.args(["doctor", "--json", "--listen", "127.0.0.1:0", "--backup"]).arg(file);
        let output = doctor.arg("--data").arg(folder.path().join("data")).output().expect("the binary runs");
        let checks: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).expect("JSON");
        checks.into_iter().find(|check| check["name"] == "backup").expect("the check")["status"].clone()
    };
    assert_eq!(examined(&file), "ok");
    // It can be opened and read as any database, and stays as it is.
    assert_eq!(count(&file), 8 * ROWS);
    assert_eq!(examined(&file), "ok");
    let plain = folder.path().join("plain.db");
    let source = rusqlite::Connection::open(folder.path().join("data/sightfix.db")).expect("a database");
    source.execute("VACUUM INTO ?", [plain.to_str().expect("UTF-8")]).expect("copied");
    assert_eq!(examined(&plain), "warning");
    let target = folder.path().join("restored");
    let (code, text) = command("restore", &plain, &target, &[]);
    assert!(code == Some(1) && text.contains("--without-digest") && !target.exists(), "{code:?} {text}");
    let (code, text) = command("restore", &plain, &target, &["--without-digest"]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(count(&target.join("sightfix.db")), 8 * ROWS);
    std::fs::write(&plain, [std::fs::read(&file).expect("read"), vec![0]].concat()).expect("written");
    assert_eq!(examined(&plain), "failed");
}

#[tokio::test]
async fn a_damaged_backup_is_not_restored() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    for import in 0..8 {
        let headers = [("content-type", "text/csv")];
        server.send("POST", "/v1/cameras/c/samples", &headers, csv(import)).await.expect(200);
    }
    let other = data_folder();
    // Under the name that the test's damage is done to.
    let file = other.path().join("sightfix.db");
    let (code, text) = command("backup", &file, folder.path(), &[]);
    assert_eq!(code, Some(0), "{text}");
    assert!(server.terminate());
    damage_samples(other.path());
    let (code, text) = command("restore", &file, folder.path(), &[]);
    assert!(code == Some(4) && text.contains("is damaged"), "{code:?} {text}");
    std::fs::write(&file, "no database at all, but long enough for its header to be looked at")
        .expect("written");
    let (code, text) = command("restore", &file, folder.path(), &[]);
    assert!(code == Some(4) && text.contains("not a database"), "{code:?} {text}");
    assert_eq!(count(&folder.path().join("sightfix.db")), 8 * ROWS);
    assert!(kept_databases(folder.path()).is_empty());
    let nothing = data_folder();
    let (code, text) = command("backup", &other.path().join("b"), nothing.path(), &[]);
    assert!(code == Some(4) && text.contains("there is no database"), "{code:?} {text}");
}
