//! The real client with the real server: killed, terminated, restarted.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Output, Stdio};
use std::time::Duration;

use jiff::Timestamp;
use serde_json::{Value, json};
use sightfix::domain::{Sample, TargetId, TimeBounds};
use sightfix::exchange::{Format, RowRules, read_samples, write_samples};
use sightfix::simulation::{Options, Scene, simulate};

use crate::harness::{TestServer, data_folder, own_address, shared, sightfix};

/// All faults together.
const FAULTS: [&str; 6] = ["--lose", "0.1", "--duplicate", "0.1", "--reorder", "0.2"];

async fn create_camera(server: &TestServer) {
    server.post("/v1/cameras", &json!({"id": "square"})).await.expect(201);
}

async fn count(server: &TestServer) -> u64 {
    let count = server.get("/v1/cameras/square/samples/count").await.expect(200).json();
    count["count"].as_u64().expect("a number")
}

async fn wait_for(server: &TestServer, samples: u64) {
    while count(server).await < samples {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn start(address: SocketAddr, arguments: &[&str]) -> Child {
    let mut command = sightfix();
    command.args(["replay", "--json", "--camera", "square", "--server", &format!("http://{address}")]);
    command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().expect("the binary runs")
}

/// The report of a successful replay, with its sums checked.
fn report(replaying: Child) -> Value {
    let output = replaying.wait_with_output().expect("it ends");
    let report = parse_report(&output);
    assert!(output.status.success(), "{report}: {}", String::from_utf8_lossy(&output.stderr));
    report
}

fn parse_report(output: &Output) -> Value {
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)));
    let number = |name: &str| report[name].as_u64().unwrap_or_else(|| panic!("{name}: {report}"));
    let refused: u64 =
        report["refused"].as_object().expect("counts").values().filter_map(Value::as_u64).sum();
    let all = number("answered") + refused + number("lost_answers") + number("unanswered");
    assert_eq!(all, number("items"), "{report}");
    if !report["acknowledged"].is_null() {
        assert_eq!(number("acknowledged") + number("unacknowledged"), number("items"), "{report}");
    }
    report
}

fn samples(csv: &[u8]) -> Vec<Sample> {
    let bounds = TimeBounds::at("2027-01-01T00:00:00Z".parse().expect("a time"));
    let rules = RowRules { time_bounds: bounds, image_size: None };
    let rows = read_samples(csv, Format::Csv, &rules).expect("a header");
    rows.map(|row| row.expect("a file").expect("a row").with_fix().expect("a fix")).collect()
}

/// Number of stored samples; asserts that each is stored once and as it was sent.
async fn count_stored(server: &TestServer, sent: &[Sample]) -> usize {
    let path = "/v1/cameras/square/samples";
    let csv = server.send("GET", path, &[("accept", "text/csv")], "").await.expect(200).body;
    let sent: BTreeMap<(TargetId, Timestamp), &Sample> =
        sent.iter().map(|sample| ((sample.target_id.clone(), sample.time), sample)).collect();
    let stored = samples(&csv);
    let mut seen = BTreeMap::new();
    for sample in &stored {
        let key = (sample.target_id.clone(), sample.time);
        let original = sent.get(&key).unwrap_or_else(|| panic!("{key:?} was never sent"));
        let (is, was) = (sample.bounding_box.sides_px(), original.bounding_box.sides_px());
        assert!(is.iter().zip(was).all(|(is, was)| (is - was).abs() < 1e-9), "{sample:?} {original:?}");
        let (is, was) = (sample.fix.position, original.fix.position);
        assert!((is.longitude_deg() - was.longitude_deg()).abs() < 1e-9, "{sample:?} {original:?}");
        assert!((is.latitude_deg() - was.latitude_deg()).abs() < 1e-9, "{sample:?} {original:?}");
        assert!(seen.insert(key, ()).is_none(), "{sample:?} is stored twice");
    }
    stored.len()
}

/// A file with rows of three pedestrians on a simulated square.
fn simulated(folder: &Path, rows: usize) -> (PathBuf, Vec<Sample>) {
    let options = Options { samples: rows, targets: 3, ..Options::new(Scene::Square) };
    let mut csv = Vec::new();
    write_samples(&mut csv, Format::Csv, &simulate(&options).training_samples())
        .expect("memory can be written");
    let path = folder.join("simulated.csv");
    std::fs::write(&path, &csv).expect("the file can be written");
    (path, samples(&csv))
}

/// Replays with faults while the server is killed and restarted; every item that was not dropped by a
/// fault is stored once.
async fn faults_and_a_kill(path: &Path, sent: &[Sample], rate: &str) {
    let folder = data_folder();
    let address = own_address();
    let server = TestServer::start_at(folder.path(), address);
    create_camera(&server).await;
    let file = path.to_str().expect("UTF-8");
    let arguments = [&[file, "--store-samples", "--rate", rate, "--seed", "5"], &FAULTS[..]].concat();
    let replaying = start(address, &arguments);
    wait_for(&server, sent.len() as u64 / 3).await;
    server.kill();
    let server = TestServer::start_at(folder.path(), address);
    let report = report(replaying);

    let injected = |name: &str| report["injected"][name].as_u64().expect("a count");
    let rows = sent.len() as u64;
    assert!(injected("lost") > 0 && injected("duplicated") > 0 && injected("reordered") > 0, "{report}");
    assert_eq!(report["items"], rows - injected("lost") + injected("duplicated"), "{report}");
    assert_eq!(report["acknowledged"], report["items"], "{report}");
    assert!(report["reconnects"].as_u64() >= Some(1), "{report}");
    assert_eq!(count_stored(&server, sent).await as u64, rows - injected("lost"), "{report}");
}

#[tokio::test]
async fn simulated_rows_with_faults_are_stored_once_although_the_server_is_killed() {
    let folder = data_folder();
    let (path, sent) = simulated(folder.path(), 2_000);
    faults_and_a_kill(&path, &sent, "800").await;
}

#[tokio::test]
#[ignore = "needs ../shared/data"]
async fn shared_rows_with_faults_are_stored_once_although_the_server_is_killed() {
    let path = shared("square/training.csv");
    let sent = samples(&std::fs::read(&path).expect("the file can be read"));
    faults_and_a_kill(&path, &sent, "4000").await;
}

#[tokio::test]
#[ignore = "needs ../shared/data"]
async fn shared_boxes_and_fixes_are_paired_live_although_the_server_is_killed() {
    let (boxes, fixes) = (shared("square/detections.csv"), shared("square/gnss.csv"));
    let sent = samples(&std::fs::read(shared("square/training.csv")).expect("the file can be read"));
    let folder = data_folder();
    let address = own_address();
    let server = TestServer::start_at(folder.path(), address);
    create_camera(&server).await;
    let [boxes, fixes] = [&boxes, &fixes].map(|path| path.to_str().expect("UTF-8"));
    let files = ["--detections", boxes, "--fixes", fixes, "--store-samples", "--rate", "8000"];
    let replaying = start(address, &files);
    wait_for(&server, sent.len() as u64 / 3).await;
    server.kill();
    let server = TestServer::start_at(folder.path(), address);
    let report = report(replaying);
    assert!(report["reconnects"].as_u64() >= Some(1), "{report}");
    assert_eq!(count_stored(&server, &sent).await, sent.len());
}

#[tokio::test]
async fn streams_of_a_terminated_server_move_to_its_successor() {
    let folder = data_folder();
    let (path, sent) = simulated(folder.path(), 1_500);
    let data = folder.path().join("server");
    let address = own_address();
    let server = TestServer::start_at(&data, address);
    create_camera(&server).await;
    let replaying = start(address, &[path.to_str().expect("UTF-8"), "--store-samples", "--rate", "600"]);
    wait_for(&server, 500).await;
    assert!(server.terminate(), "it exits successfully");
    let server = TestServer::start_at(&data, address);
    let report = report(replaying);
    assert!(report["reconnects"].as_u64() >= Some(1), "{report}");
    assert_eq!(report["resent"], 0, "everything was acknowledged before the exit: {report}");
    assert_eq!(count_stored(&server, &sent).await, sent.len());
}

#[tokio::test]
async fn hundreds_of_cameras_stream_concurrently() {
    let folder = data_folder();
    let (path, _) = simulated(folder.path(), 20);
    let server = TestServer::start(&folder.path().join("server"));
    create_camera(&server).await;
    server.post("/v1/cameras", &json!({"id": "gate"})).await.expect(201);
    let cameras = ["--cameras", "300", "--camera", "gate", "--speed", "max", "--store-samples"];
    let report = report(start(server.address, &[&[path.to_str().expect("UTF-8")], &cameras[..]].concat()));
    assert_eq!((&report["items"], &report["streams"]), (&json!(6_000), &json!(300)), "{report}");
    // 150 on each of the two, with distinct targets.
    assert_eq!(count(&server).await, 3_000);
}

#[tokio::test]
async fn a_replay_that_cannot_succeed_reports_why_and_fails() {
    let folder = data_folder();
    let (path, _) = simulated(folder.path(), 20);
    let file = path.to_str().expect("UTF-8");
    let server = TestServer::start(&folder.path().join("server"));
    let unknown = start(server.address, &[file, "--speed", "max"]).wait_with_output().expect("it ends");
    assert!(!unknown.status.success());
    assert!(parse_report(&unknown)["reasons"][0].as_str().expect("why").contains("camera-not-found"));

    let absent = start(own_address(), &[file, "--attempts", "2"]).wait_with_output().expect("it ends");
    assert!(!absent.status.success());
    let report = parse_report(&absent);
    assert_eq!(report["broken"].as_object().expect("counts").values().next(), Some(&json!(3)), "{report}");

    let wrong = start(server.address, &[file, "--lose", "1.5"]).wait_with_output().expect("it ends");
    assert!(!wrong.status.success());
}

/// The track of a recording that ended takes nothing of its beginning.
#[tokio::test]
async fn a_recording_that_is_replayed_again_is_told_to_be_too_late() {
    let (data, files) = (data_folder(), data_folder());
    let server = TestServer::start(data.path());
    create_camera(&server).await;
    let csv = files.path().join("fixes.csv");
    let row = |second: u32| format!("2026-01-01T00:{:02}:{:02}Z,a,11,48\n", second / 60, second % 60);
    let rows: String = (0..30).map(row).collect();
    std::fs::write(&csv, format!("time,target_id,longitude,latitude\n{rows}")).expect("written");
    let csv = csv.to_str().expect("UTF-8");
    let first = report(start(server.address, &[csv, "--speed", "max"]));
    assert_eq!((&first["answered"], &first["too_late"]), (&json!(30), &json!(0)), "{first}");
    let again = report(start(server.address, &[csv, "--speed", "max"]));
    assert_eq!(again["answered"], 30, "{again}");
    assert!(again["too_late"].as_u64().expect("a number") > 20, "{again}");
    let shifted = report(start(server.address, &[csv, "--speed", "max", "--shift-to-now"]));
    assert_eq!(shifted["too_late"], 0, "{shifted}");
}

#[test]
fn a_server_that_is_not_there_is_named() {
    let files = data_folder();
    let csv = files.path().join("fixes.csv");
    std::fs::write(&csv, "time,target_id,longitude,latitude\n2026-01-01T00:00:00Z,a,11,48\n")
        .expect("written");
    // A port that was free a moment ago.
    let address = std::net::TcpListener::bind("127.0.0.1:0").and_then(|it| it.local_addr()).expect("a port");
    let output =
        start(address, &[csv.to_str().expect("UTF-8"), "--attempts", "1"]).wait_with_output().expect("ends");
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains(&format!("no stream could be opened at http://{address}")), "{told}");
}
