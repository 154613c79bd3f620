//! Storage and its duration: durability, full disks, deletions, limits, permissions, and other
//! processes in the same data folder.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use futures_util::stream;
use serde_json::{Value, json};
use sightfix::clock::Clock;
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::model_service_client::ModelServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;
use tonic::Code;
use tonic_types::StatusExt as _;

use crate::harness::{Answer, TestServer, data_folder, sightfix, simulated_csv};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const SAMPLES: &str = "/v1/cameras/c/samples";

async fn create_camera(server: &TestServer, id: &str) -> Answer {
    let profile = json!({"id": id, "image_size": {"width_px": 1920, "height_px": 1080}});
    server.post("/v1/cameras", &profile).await
}

async fn import(server: &TestServer, path: &str, csv: String) -> Answer {
    server.send("POST", path, &[("content-type", "text/csv")], csv).await
}

async fn delete(server: &TestServer, path: &str) -> Answer {
    server.send("DELETE", path, &[], "").await
}

async fn import_model(server: &TestServer) -> Value {
    let file = std::fs::read(MODEL).expect("the reference model");
    let headers = [("content-type", "application/vnd.safetensors")];
    server.send("POST", "/v1/cameras/c/models", &headers, file).await.expect(201).json()
}

async fn activate(server: &TestServer, number: u64) {
    let headers = [("content-type", "application/json")];
    let body = json!({ "number": number }).to_string();
    server.send("PUT", "/v1/cameras/c/active-model", &headers, body).await.expect(200);
}

/// So many samples a second apart, from that second of a day in 2020 on.
fn csv(seconds: std::ops::Range<i64>) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for second in seconds {
        let time = jiff::Timestamp::from_second(1_600_000_000 + second).expect("in range");
        let left = 10 + second % 1_000;
        writeln!(csv, "{time},person-1,{left},20,30,60,103.9,30.6").expect("memory");
    }
    csv
}

#[track_caller]
fn problem(answer: &Answer, status: u16, kind: &str) -> Value {
    assert_eq!(answer.status.as_u16(), status, "{}", answer.text());
    let problem = answer.json();
    assert_eq!(problem["type"], format!("urn:sightfix:problem:{kind}"), "{problem}");
    problem
}

/// Waits until the metrics have this line.
async fn metric(server: &TestServer, line: &str) {
    while !server.get("/metrics").await.expect(200).text().lines().any(|found| found == line) {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn imports_say_how_durable_they_are() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, "c").await.expect(201);
    for (query, durability, rows) in [
        ("", "synced", 0..2),
        ("?durability=relaxed", "relaxed", 2..4),
        ("?durability=synced", "synced", 4..6),
    ] {
        let report = import(&server, &format!("{SAMPLES}{query}"), csv(rows)).await.expect(200).json();
        assert_eq!((&report["accepted"], &report["durability"]), (&json!(2), &json!(durability)), "{report}");
    }
    let refused = import(&server, &format!("{SAMPLES}?durability=some"), csv(6..8)).await;
    assert_eq!(problem(&refused, 422, "invalid-argument")["violations"][0]["field"], "durability");

    let mut samples = SampleServiceClient::new(server.channel().await);
    for (asked, reported) in [
        (proto::Durability::Unspecified, proto::Durability::Synced),
        (proto::Durability::Synced, proto::Durability::Synced),
        (proto::Durability::Relaxed, proto::Durability::Relaxed),
    ] {
        let message = proto::ImportSamplesRequest {
            camera_id: "c".to_owned(),
            durability: asked.into(),
            ..Default::default()
        };
        let report = samples.import_samples(stream::iter([message])).await.expect("taken").into_inner();
        assert_eq!(report.durability(), reported);
    }

    let mut fusion = FusionServiceClient::new(server.channel().await);
    for (store_samples, reported) in
        [(true, proto::Durability::Relaxed), (false, proto::Durability::Unspecified)]
    {
        let opening = proto::StreamOpening {
            camera_id: "c".to_owned(),
            client_name: "edge-1".to_owned(),
            store_samples,
            durability: proto::Durability::Relaxed.into(),
            ..Default::default()
        };
        let first = proto::StreamRequest { kind: Some(proto::stream_request::Kind::Opening(opening)) };
        let mut answers = fusion.stream(stream::iter([first])).await.expect("taken").into_inner();
        let answer = answers.message().await.expect("no error").expect("an answer");
        let Some(proto::stream_response::Kind::Opened(opened)) = answer.kind else { panic!("{answer:?}") };
        assert_eq!(opened.durability(), reported);
    }
}

/// Fills the storage with imports until one is refused for want of space.
async fn fill(server: &TestServer) -> Answer {
    for round in 0..200 {
        let answer = import(server, SAMPLES, csv(round * 5_000..(round + 1) * 5_000)).await;
        if answer.status.as_u16() != 200 {
            return answer;
        }
    }
    panic!("a million samples fit");
}

/// Checks the behaviour on full storage, whatever filled it.
async fn check_full_storage(server: &TestServer, refused: &Answer) {
    let said = problem(refused, 507, "insufficient-storage");
    assert!(said["detail"].as_str().is_some_and(|detail| detail.contains("delete")), "{said}");
    let mut samples = SampleServiceClient::new(server.channel().await);
    let mut lines = 0;
    let batch = (9_000_000..9_005_000).map(|second| {
        lines += 1;
        proto::Sample {
            time: Some(prost_types::Timestamp { seconds: 1_500_000_000 + second, nanos: 0 }),
            target_id: "person-2".to_owned(),
            bounding_box: Some(proto::BoundingBox {
                left_px: Some(10.0),
                top_px: Some(20.0),
                width_px: Some(30.0),
                height_px: Some(60.0),
            }),
            fix: Some(Box::new(proto::Fix {
                longitude_deg: Some(103.9),
                latitude_deg: Some(30.6),
                sigma_m: None,
            })),
            ..Default::default()
        }
    });
    let message = proto::ImportSamplesRequest {
        camera_id: "c".to_owned(),
        samples: batch.collect(),
        ..Default::default()
    };
    let status = samples.import_samples(stream::iter([message])).await.expect_err("refused");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    let details = status.get_error_details();
    assert_eq!(details.error_info().expect("ErrorInfo").reason, "insufficient-storage");

    let ready = server.get("/readyz").await.expect(200).text();
    assert!(ready.starts_with("ready\n") && ready.contains("degraded: insufficient-storage"), "{ready}");
    metric(server, "sightfix_storage_full 1").await;
    let observation = json!({"observations": [{
        "time": "2026-01-01T00:00:00Z",
        "bounding_box": {"left_px": 900.0, "top_px": 500.0, "width_px": 40.0, "height_px": 90.0},
        "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.62801},
    }]});
    server.post("/v1/cameras/c/fusions", &observation).await.expect(200);

    let deleted = delete(server, &format!("{SAMPLES}?from=2020-01-01T00:00:00Z")).await.expect(200).json();
    assert!(deleted["deleted"].as_u64().is_some_and(|deleted| deleted >= 5_000), "{deleted}");
    let report = import(server, SAMPLES, csv(0..5_000)).await.expect(200).json();
    assert_eq!(report["accepted"], 5_000, "{report}");
    metric(server, "sightfix_storage_full 0").await;
    assert_eq!(server.get("/readyz").await.expect(200).text(), "ready\n");
}

#[tokio::test]
async fn a_full_database_refuses_imports_fuses_on_and_recovers_by_deleting() {
    let folder = data_folder();
    let settings =
        [("SIGHTFIX_LIMITS__DATABASE_BYTES", "8388608"), ("SIGHTFIX_LIMITS__RESERVE_BYTES", "1048576")];
    let server = TestServer::start_with(folder.path(), &settings);
    create_camera(&server, "c").await.expect(201);
    import_model(&server).await;
    activate(&server, 1).await;
    let refused = fill(&server).await;
    check_full_storage(&server, &refused).await;
    delete(&server, &format!("{SAMPLES}?from=2020-01-01T00:00:00Z")).await.expect(200);
    // The file gives back what is free, but for what the next imports will need.
    let file = folder.path().join("sightfix.db");
    while std::fs::metadata(&file).expect("the database").len() > 5 << 20 {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(server.terminate());
}

/// A file system of its own for a data folder; unmounted when the test ends, however it ends.
struct Mounted<'f>(&'f Path);

impl<'f> Mounted<'f> {
    fn new(folder: &'f Path) -> Self {
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", "size=48m", "tmpfs"]).arg(folder);
        assert!(mount.status().expect("mount runs").success(), "needs the superuser");
        Self(folder)
    }

    /// Another program takes all that is left, in pieces of this size.
    fn occupy(&self, name: &str, piece_bytes: usize) {
        let mut file = std::fs::File::create(self.0.join(name)).expect("a file");
        let piece = vec![b'x'; piece_bytes];
        while file.write_all(&piece).is_ok() {}
    }
}

impl Drop for Mounted<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0).status();
    }
}

const RESERVED: [(&str, &str); 1] = [("SIGHTFIX_LIMITS__RESERVE_BYTES", "20971520")];

/// Needs the rights to mount; `.ci/run` runs it.
#[tokio::test]
#[ignore = "mounts a file system, which needs the superuser"]
async fn a_full_disk_refuses_imports_fuses_on_and_recovers_by_deleting() {
    let folder = data_folder();
    let _mounted = Mounted::new(folder.path());
    let server = TestServer::start_with(folder.path(), &RESERVED);
    create_camera(&server, "c").await.expect(201);
    import_model(&server).await;
    activate(&server, 1).await;
    let refused = fill(&server).await;
    check_full_storage(&server, &refused).await;
}

/// Needs the rights to mount; `.ci/run` runs it.
#[tokio::test]
#[ignore = "mounts a file system, which needs the superuser"]
async fn a_server_that_was_killed_on_a_full_disk_starts_and_answers_however_often() {
    let folder = data_folder();
    let mounted = Mounted::new(folder.path());
    let mut server = TestServer::start_with(folder.path(), &RESERVED);
    create_camera(&server, "c").await.expect(201);
    import_model(&server).await;
    activate(&server, 1).await;
    fill(&server).await;
    for round in 0..6 {
        server.kill();
        mounted.occupy(&format!("other-{round}"), 1 << (2 * round));
        server = TestServer::start_with(folder.path(), &RESERVED);
        let ready = server.get("/readyz").await.expect(200).text();
        assert!(ready.contains("degraded: insufficient-storage"), "round {round}: {ready}");
        let observation = json!({"observations": [{
            "time": "2026-01-01T00:00:00Z",
            "bounding_box": {"left_px": 900.0, "top_px": 500.0, "width_px": 40.0, "height_px": 90.0},
        }]});
        server.post("/v1/cameras/c/fusions", &observation).await.expect(200);
        let reserve = std::fs::metadata(folder.path().join("sightfix.reserve")).expect("set aside again");
        assert!(reserve.len() >= 16 << 20, "round {round}: {} bytes are left of the reserve", reserve.len());
        problem(&fill(&server).await, 507, "insufficient-storage");
    }
    for round in 0..6 {
        std::fs::remove_file(folder.path().join(format!("other-{round}"))).expect("removed");
    }
    let refused = fill(&server).await;
    check_full_storage(&server, &refused).await;
}

#[tokio::test]
async fn models_and_runs_can_be_deleted_by_both_transports() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, "c").await.expect(201);
    for number in 1..=4 {
        assert_eq!(import_model(&server).await["number"], number);
    }
    for number in [1, 2, 1] {
        activate(&server, number).await;
    }
    problem(&delete(&server, "/v1/cameras/c/models/1").await, 409, "model-active");
    delete(&server, "/v1/cameras/c/models/2").await.expect(204);
    problem(&delete(&server, "/v1/cameras/c/models/2").await, 404, "model-not-found");
    let no_other = server.post("/v1/cameras/c/active-model/roll-back", &json!({})).await;
    problem(&no_other, 409, "no-earlier-model");

    let channel = server.channel().await;
    let mut models = ModelServiceClient::new(channel.clone());
    let model = |number| proto::DeleteModelRequest { camera_id: "c".to_owned(), number };
    models.delete_model(model(4)).await.expect("deleted");
    assert_eq!(models.delete_model(model(4)).await.expect_err("gone").code(), Code::NotFound);
    assert_eq!(models.delete_model(model(1)).await.expect_err("active").code(), Code::FailedPrecondition);
    assert_eq!(import_model(&server).await["number"], 5, "a number is never assigned again");

    import(&server, SAMPLES, simulated_csv()).await.expect(200);
    let run = server.train("c", &json!({"recipe": "hybrid", "epochs": 2})).await;
    let live = server.post("/v1/cameras/c/training-runs", &json!({})).await.expect(202).json();
    let path = |run: &Value| format!("/v1/cameras/c/training-runs/{}", run["id"].as_str().expect("an id"));
    problem(&delete(&server, &path(&live)).await, 409, "run-live");
    delete(&server, &path(&run)).await.expect(204);
    problem(&delete(&server, &path(&run)).await, 404, "run-not-found");
    server.get(&format!("/v1/cameras/c/models/{}", run["model_version"])).await.expect(200);
    let mut runs = TrainingServiceClient::new(channel);
    let request = proto::DeleteTrainingRunRequest {
        camera_id: "c".to_owned(),
        run_id: live["id"].as_str().expect("an id").to_owned(),
    };
    server.post(&format!("{}/cancel", path(&live)), &json!({})).await;
    while !matches!(server.get(&path(&live)).await.json()["state"].as_str(), Some("cancelled" | "succeeded"))
    {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    runs.delete_training_run(request.clone()).await.expect("deleted");
    assert_eq!(runs.delete_training_run(request).await.expect_err("gone").code(), Code::NotFound);
}

#[tokio::test]
async fn limits_refuse_cameras_and_samples_and_drop_old_models() {
    let folder = data_folder();
    let settings = [
        ("SIGHTFIX_LIMITS__CAMERAS", "2"),
        ("SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA", "100"),
        ("SIGHTFIX_LIMITS__SAMPLES", "150"),
        ("SIGHTFIX_LIMITS__MODELS_PER_CAMERA", "3"),
    ];
    let server = TestServer::start_with(folder.path(), &settings);
    create_camera(&server, "c").await.expect(201);
    create_camera(&server, "d").await.expect(201);
    problem(&create_camera(&server, "e").await, 507, "insufficient-storage");
    server.get("/v1/cameras/e").await.expect(404);

    import(&server, SAMPLES, csv(0..90)).await.expect(200);
    let refused = problem(&import(&server, SAMPLES, csv(90..101)).await, 507, "insufficient-storage");
    assert!(refused["detail"].as_str().is_some_and(|it| it.contains("samples_per_camera")), "{refused}");
    import(&server, SAMPLES, csv(90..100)).await.expect(200);
    import(&server, "/v1/cameras/d/samples", csv(0..50)).await.expect(200);
    let refused =
        problem(&import(&server, "/v1/cameras/d/samples", csv(50..51)).await, 507, "insufficient-storage");
    assert!(refused["detail"].as_str().is_some_and(|it| it.contains("limits.samples is 150")), "{refused}");
    delete(&server, &format!("{SAMPLES}?from=2020-01-01T00:00:00Z")).await.expect(200);
    import(&server, "/v1/cameras/d/samples", csv(50..51)).await.expect(200);
    import(&server, SAMPLES, csv(0..90)).await.expect(200);

    for number in 1..=6 {
        import_model(&server).await;
        if number == 1 {
            activate(&server, 1).await;
        }
    }
    let models = server.get("/v1/cameras/c/models").await.expect(200).json();
    let numbers: Vec<_> =
        models["items"].as_array().expect("a list").iter().map(|it| &it["number"]).collect();
    assert_eq!(numbers, [6, 5, 1], "the oldest go, but for the active one");
}

#[cfg(unix)]
#[tokio::test]
async fn the_data_folder_is_private_to_its_owner() {
    use std::fs::{Permissions, metadata, set_permissions};
    use std::os::unix::fs::PermissionsExt as _;

    let parent = data_folder();
    let folder = parent.path().join("data");
    let files = ["", "sightfix.db", "sightfix.db-wal", "sightfix.db-shm"].map(|name| folder.join(name));
    let modes = || files.clone().map(|path| metadata(path).expect("is there").permissions().mode() & 0o777);
    let server = TestServer::start(&folder);
    assert_eq!(modes(), [0o700, 0o600, 0o600, 0o600]);
    server.kill();
    for path in &files {
        let mode = if path == &files[0] { 0o755 } else { 0o644 };
        set_permissions(path, Permissions::from_mode(mode)).expect("set");
    }
    let server = TestServer::start(&folder);
    assert_eq!(modes(), [0o700, 0o600, 0o600, 0o600]);
    let logged =
        server.logged(|entry| entry["message"].as_str().is_some_and(|it| it.contains("restricted"))).await;
    assert_eq!(logged["path"], folder.to_str().expect("UTF-8"), "{logged}");
}

#[cfg(unix)]
#[tokio::test]
async fn a_server_and_the_commands_beside_it_know_of_each_other() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, "c").await.expect(201);
    // A file that does not end before the test lets it.
    let path = folder.path().join("samples.csv");
    assert!(Command::new("mkfifo").arg(&path).status().expect("mkfifo runs").success());
    let mut pipe = std::fs::OpenOptions::new().read(true).write(true).open(&path).expect("a pipe");
    let mut import = sightfix();
    import.args(["import", "--camera", "c", "--data"]).arg(folder.path()).arg(&path);
    let import = import.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the command runs");
    let is_other = |entry: &Value| entry["message"] == "another process uses the same data folder";
    let logged = server.logged(is_other).await;
    assert_eq!(
        (&logged["pid"], &logged["role"]),
        (&json!(import.id()), &json!("sightfix import")),
        "{logged}"
    );
    assert!(logged["host"].as_str().is_some_and(|host| !host.is_empty()), "{logged}");
    // The command has opened the pipe: its end is the end of the file.
    pipe.write_all(csv(0..20).as_bytes()).expect("written");
    drop(pipe);
    let output = import.wait_with_output().expect("the command ends");
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{errors}");
    assert!(errors.contains(&format!("server with process id {}", server.pid())), "{errors}");
    let count = server.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 20);
    server.kill();
    let server = TestServer::start(folder.path());
    assert!(server.terminate());
    let locks = std::fs::read_dir(folder.path()).expect("listed").filter_map(Result::ok);
    let names = locks.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let locks: Vec<_> =
        names.filter(|name| name.starts_with("sightfix.") && name.ends_with(".lock")).collect();
    assert!(locks.is_empty(), "stale files are removed: {locks:?}");
}

#[tokio::test]
async fn the_oldest_samples_give_way_where_the_settings_say_so() {
    let folder = data_folder();
    let settings = [
        ("SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA", "1000"),
        ("SIGHTFIX_LIMITS__SAMPLE_OVERFLOW", "delete_oldest"),
    ];
    let server = TestServer::start_with(folder.path(), &settings);
    create_camera(&server, "c").await.expect(201);
    create_camera(&server, "d").await.expect(201);
    import(&server, "/v1/cameras/d/samples", csv(0..10)).await.expect(200);
    let count = async || server.get(&format!("{SAMPLES}/count")).await.expect(200).json()["count"].clone();
    import(&server, SAMPLES, csv(0..1_000)).await.expect(200);
    assert_eq!(count().await, 1_000, "what fits is kept");
    import(&server, SAMPLES, csv(500..1_000)).await.expect(200);
    assert_eq!(count().await, 1_000, "duplicates delete nothing");
    let report = import(&server, SAMPLES, csv(1_000..1_005)).await.expect(200).json();
    assert_eq!((&report["accepted"], count().await), (&json!(5), json!(990)), "{report}");
    let first = server.get(&format!("{SAMPLES}?limit=1")).await.expect(200).json();
    let oldest = jiff::Timestamp::from_second(1_600_000_000 + 15).expect("in range");
    assert_eq!(first["items"][0]["time"], oldest.to_string(), "{first}");
    let other = server.get("/v1/cameras/d/samples/count").await.expect(200).json();
    assert_eq!(other["count"], 10, "other cameras keep theirs");
}

/// Rows of [`csv`] are years old; what is imported later goes with the next hour.
#[tokio::test]
async fn samples_older_than_the_days_of_the_setting_are_deleted() {
    let folder = data_folder();
    let now = Clock::system().now();
    let young = csv(0..0) + &format!("{now},young,10,20,30,60,103.9,30.6\n");
    {
        let server = TestServer::start(folder.path());
        create_camera(&server, "c").await.expect(201);
        import(&server, SAMPLES, csv(0..90)).await.expect(200);
        import(&server, SAMPLES, young).await.expect(200);
        assert_eq!(server.get("/v1/cameras/c").await.expect(200).json()["samples"], 91);
    }
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SAMPLE_DAYS", "30")]);
    while server.get("/v1/cameras/c").await.expect(200).json()["samples"] != 1 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let stored = server.get(SAMPLES).await.expect(200).json();
    assert_eq!(stored["items"][0]["target_id"], "young");
    let line = server.logged(|line| line["deleted"] == 90).await;
    assert!(line.to_string().contains("limits.sample_days"), "{line}");
    let audited = server.get("/v1/audit?limit=1").await.expect(200).json();
    let entry = &audited["items"][0];
    assert_eq!(
        (&entry["action"], &entry["actor"]),
        (&json!("samples-deleted"), &json!("retention")),
        "{entry}"
    );
    assert!(entry["subject"].as_str().expect("text").starts_with("samples from before "), "{entry}");
}

/// Rows of [`csv`] are years old: what a clock that is years ahead makes of samples of today.
#[tokio::test]
async fn a_clock_far_from_the_newest_sample_deletes_nothing() {
    let folder = data_folder();
    let days = ("SIGHTFIX_LIMITS__SAMPLE_DAYS", "30");
    {
        let server = TestServer::start(folder.path());
        create_camera(&server, "c").await.expect(201);
        import(&server, SAMPLES, csv(0..90)).await.expect(200);
    }
    let server = TestServer::start_with(folder.path(), &[days]);
    let line = server.logged(|line| line.to_string().contains("no samples are deleted")).await.to_string();
    assert!(line.contains("days ahead of the newest sample (2020-09-13T12:28:09Z)"), "{line}");
    assert_eq!(server.get("/v1/cameras/c").await.expect(200).json()["samples"], 90);
    let metrics = server.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_sample_retention_refused 1"), "{metrics}");

    let mut doctor = sightfix();
    doctor.args(["doctor", "--json", "--listen", &server.address.to_string(), "--data"]).arg(folder.path());
    let output = doctor.env(days.0, days.1).output().expect("the binary runs");
    let checks: Vec<Value> = serde_json::from_slice(&output.stdout).expect("JSON");
    let check = checks.iter().find(|check| check["name"] == "retention").expect("a check");
    assert_eq!(check["status"], "warning", "{check}");
    assert!(check["finding"].as_str().expect("text").contains("ahead of the newest sample"), "{check}");
}
