//! Data folders that are in use, cannot be written, or hold what cannot be used: a clear message and exit
//! code, or a server that goes on answering from memory.

use std::fs::{OpenOptions, Permissions, set_permissions};
use std::io::{Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use crate::harness::{Answer, TestServer, data_folder, sightfix, simulated_csv};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const CSV: [(&str, &str); 1] = [("content-type", "text/csv")];
const PAGE_BYTES: u64 = 4_096;
/// Exit codes of docs/howto/run.md.
const IN_USE: Option<i32> = Some(3);
const UNUSABLE: Option<i32> = Some(4);

/// Runs `sightfix serve` on a folder that it cannot use; its exit code and what it says.
fn refused_start(folder: &Path) -> (Option<i32>, String) {
    let mut command = sightfix();
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(folder);
    ended(command)
}

fn ended(mut command: Command) -> (Option<i32>, String) {
    let output = command.output().expect("the binary runs");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// A folder with the camera `c`, its active model and 2,000 samples, whose server has ended.
async fn filled_folder() -> tempfile::TempDir {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let headers = [("content-type", "application/octet-stream")];
    let model = std::fs::read(MODEL).expect("a model");
    server.send("POST", "/v1/cameras/c/models", &headers, model).await.expect(201);
    let headers = [("content-type", "application/json")];
    server.send("PUT", "/v1/cameras/c/active-model", &headers, r#"{"number": 1}"#).await.expect(200);
    import(&server).await.expect(200);
    assert!(server.terminate());
    folder
}

async fn import(server: &TestServer) -> Answer {
    server.send("POST", "/v1/cameras/c/samples", &CSV, simulated_csv()).await
}

async fn fuse(server: &TestServer) -> Answer {
    let observation = json!({
        "time": "2026-01-01T00:00:00Z",
        "bounding_box": {"left_px": 900.0, "top_px": 500.0, "width_px": 40.0, "height_px": 90.0},
    });
    server.post("/v1/cameras/c/fusions", &observation).await
}

#[tokio::test]
async fn a_second_server_on_a_folder_is_refused_until_the_first_has_ended() {
    let folder = data_folder();
    let first = TestServer::start(folder.path());
    let (code, reported) = refused_start(folder.path());
    println!("second server: {code:?} {reported}");
    assert_eq!(code, IN_USE, "{reported}");
    let holder = format!("is in use by server with process id {}", first.pid());
    assert!(reported.contains(&holder), "{reported}");
    first.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    // A lock ends with its process, however it ends.
    first.kill();
    let second = TestServer::start(folder.path());
    second.get("/v1/cameras/c").await.expect(200);
}

#[test]
fn what_cannot_be_opened_ends_with_a_message_and_a_code() {
    let folder = data_folder();
    std::fs::write(folder.path().join("sightfix.db"), vec![b'x'; 5_000]).expect("written");
    let (code, reported) = refused_start(folder.path());
    assert!(code == UNUSABLE && reported.contains("is not a database"), "{code:?} {reported}");

    let folder = data_folder();
    drop(TestServer::start(folder.path()));
    let database = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    let later = "INSERT INTO _sqlx_migrations VALUES (9000, 'later', '', 1, x'00', 0)";
    database.execute_batch(later).expect("the row can be written");
    drop(database);
    let (code, reported) = refused_start(folder.path());
    assert!(
        code == UNUSABLE && reported.contains("newer version") && reported.contains("9000"),
        "{code:?} {reported}"
    );
}

/// Runs as another user where the test has the rights of the superuser, whom no permission stops.
#[test]
fn a_folder_that_cannot_be_written_ends_with_a_message_and_a_code() {
    const NOBODY: u32 = 65_534;
    let parent = data_folder();
    let folder = parent.path().join("data");
    let binary = parent.path().join("sightfix");
    std::fs::create_dir(&folder).expect("a folder");
    std::fs::copy(env!("CARGO_BIN_EXE_sightfix"), &binary).expect("copied");
    for (path, mode) in [(parent.path(), 0o755), (&folder, 0o555), (&binary, 0o755)] {
        set_permissions(path, Permissions::from_mode(mode)).expect("set");
    }
    let mut command = Command::new(&binary);
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(&folder).current_dir(parent.path());
    if std::fs::write(folder.join("probe"), "").is_ok() {
        command.uid(NOBODY).gid(NOBODY);
    }
    let (code, reported) = ended(command);
    println!("read-only folder: {code:?} {reported}");
    assert!(code == UNUSABLE && reported.contains("cannot be opened for writing"), "{code:?} {reported}");
}

#[tokio::test]
async fn a_database_that_another_process_holds_delays_writes_and_no_answer() {
    let folder = filled_folder().await;
    let path = folder.path().join("sightfix.db");
    let holder = rusqlite::Connection::open(&path).expect("the database");
    let server = TestServer::start(folder.path());
    holder.execute_batch("BEGIN IMMEDIATE").expect("the lock");
    fuse(&server).await.expect(200);
    let refused = server.post("/v1/cameras", &json!({"id": "d"})).await.expect(503);
    assert!(refused.text().contains("another process holds the store"), "{}", refused.text());
    assert_eq!(refused.header("retry-after"), "1");
    fuse(&server).await.expect(200);
    holder.execute_batch("ROLLBACK").expect("the lock is given back");
    server.post("/v1/cameras", &json!({"id": "d"})).await.expect(201);
    server.kill();

    holder.execute_batch("BEGIN IMMEDIATE").expect("the lock");
    let (code, reported) = refused_start(folder.path());
    assert!(code == IN_USE && reported.contains("is held by another process"), "{code:?} {reported}");
}

/// Overwrites pages near the end of the database, where its latest samples are.
pub(crate) fn damage_samples(folder: &Path) {
    let mut file = OpenOptions::new().write(true).open(folder.join("sightfix.db")).expect("the database");
    let bytes = file.metadata().expect("its size").len();
    file.seek(SeekFrom::Start(bytes - 12 * PAGE_BYTES)).expect("within");
    file.write_all(&vec![0xa5; 8 * PAGE_BYTES as usize]).expect("written");
}

#[tokio::test]
async fn damaged_pages_are_told_and_fusions_go_on() {
    let folder = filled_folder().await;
    damage_samples(folder.path());
    let server = TestServer::start(folder.path());
    fuse(&server).await.expect(200);
    assert_eq!(server.get("/readyz").await.expect(200).text(), "ready\n");
    let mut page = "/v1/cameras/c/samples?limit=1000".to_owned();
    let failed = loop {
        let answer = server.get(&page).await;
        if answer.status.as_u16() != 200 {
            break answer;
        }
        let next = answer.json()["next_cursor"].as_str().expect("damage before the end").to_owned();
        page = format!("/v1/cameras/c/samples?limit=1000&cursor={next}");
    };
    assert_eq!(failed.status.as_u16(), 500, "{}", failed.text());
    assert!(!failed.text().contains("damaged"), "a fault is for the log: {}", failed.text());
    let is_told = |entry: &Value| entry["error"].as_str().is_some_and(|it| it.contains("sightfix restore"));
    let logged = server.logged(is_told).await;
    let ready = server.get("/readyz").await.expect(200).text();
    assert!(ready.starts_with("ready\ndegraded: database:"), "{ready}");
    println!("log: {}", logged["error"]);
    fuse(&server).await.expect(200);
    assert!(server.log_lines("panicked").is_empty());

    let mut doctor = sightfix();
    doctor.args(["doctor", "--listen", &server.address.to_string(), "--data"]).arg(folder.path());
    let output = doctor.output().expect("the binary runs");
    let lines = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(output.status.code(), Some(1), "{lines}");
    assert!(lines.contains("failed   database") && lines.contains("sightfix restore"), "{lines}");
    let backup = folder.path().join("backup.db");
    let mut command = sightfix();
    command.arg("backup").arg(&backup).arg("--data").arg(folder.path());
    let (code, reported) = ended(command);
    assert!(code == UNUSABLE && reported.contains("damaged") && !backup.exists(), "{code:?} {reported}");
}
