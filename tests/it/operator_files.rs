//! The files of `deploy/`: every metric that they name is one that the server prints, and every alert has its
//! section in the documentation.

use std::collections::BTreeSet;
use std::process::Command;

use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;

use crate::harness::{TestServer, data_folder, now};

const ALERTS: &str = include_str!("../../deploy/alerts.yml");
const DASHBOARD: &str = include_str!("../../deploy/grafana-dashboard.json");
const MONITORING: &str = include_str!("../../docs/howto/monitoring.md");
const UNIT: &str = include_str!("../../deploy/sightfix.service");

/// The metrics that a text names.
fn named(text: &str) -> BTreeSet<&str> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words.filter(|word| word.starts_with("sightfix_") || word.starts_with("process_")).collect()
}

/// True if metrics have a series of that name.
fn is_printed(metrics: &str, name: &str) -> bool {
    metrics.lines().any(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' '])))
}

/// The metrics of a server that has done something of everything that the files look at.
async fn metrics_of_a_server_at_work() -> String {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let mut cameras = CameraServiceClient::connect(format!("http://{}", server.address)).await.expect("gRPC");
    cameras.get_camera(proto::GetCameraRequest { camera_id: "c".to_owned() }).await.expect("known");
    for second in 0..5 {
        let fix = json!({"longitude_deg": 24.7453, "latitude_deg": 59.4371});
        let time = format!("2026-01-01T00:00:0{second}Z");
        let observation = json!({"time": time, "target_id": "p", "fix": fix});
        server.post("/v1/cameras/c/tracks", &observation).await.expect(200);
    }
    let source =
        json!({"address": "push:", "format": "traccar", "camera_ids": ["c"], "receiver_id": "phone"});
    server.post("/v1/connections", &json!({"id": "phone", "source": source})).await.expect(201);
    let position = json!({"position": {"fixTime": now(), "latitude": 48.0, "longitude": 11.0}});
    server.post("/v1/connections/phone/messages", &position).await.expect(204);
    // The figures of connections are gathered every ten seconds.
    loop {
        let metrics = server.get("/metrics").await.expect(200).text();
        if is_printed(&metrics, "sightfix_outside_connection_lag_seconds") {
            return metrics;
        }
        tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    }
}

#[tokio::test]
async fn dashboard_and_alerts_name_metrics_that_the_server_prints() {
    let metrics = metrics_of_a_server_at_work().await;
    for (file, text) in [("alerts.yml", ALERTS), ("grafana-dashboard.json", DASHBOARD)] {
        let names = named(text);
        let unknown: Vec<_> = names.iter().filter(|name| !is_printed(&metrics, name)).collect();
        println!("{file}: {} metrics, not printed: {unknown:?}", names.len());
        assert!(names.len() > 10 && unknown.is_empty(), "{file}: {unknown:?}");
    }
    let dashboard: Value = serde_json::from_str(DASHBOARD).expect("JSON");
    assert!(dashboard["panels"].as_array().is_some_and(|panels| panels.len() > 20));
}

#[test]
fn every_alert_has_its_section() {
    let values =
        |key: &'static str| ALERTS.lines().filter_map(move |line| line.split_once(key)).map(|it| it.1.trim());
    let alerts: Vec<_> = values("- alert:").collect();
    let runbooks: Vec<_> = values("runbook:").collect();
    assert!(alerts.len() > 10 && alerts.len() == runbooks.len(), "{alerts:?} {runbooks:?}");
    for (alert, runbook) in alerts.iter().zip(runbooks) {
        assert_eq!(runbook, format!("docs/howto/monitoring.md#{}", alert.to_lowercase()));
        let heading = format!("\n### {alert}\n");
        let section = MONITORING.split_once(&heading).unwrap_or_else(|| panic!("no section {alert}")).1;
        let text = section.split("\n#").next().unwrap_or_default().trim();
        assert!(text.len() > 80, "the section {alert} says what to do: {text}");
    }
}

/// Needs systemd's tools; `.ci/run` runs it.
#[test]
#[ignore = "needs systemd-analyze"]
fn systemd_takes_the_unit() {
    let folder = data_folder();
    let path = folder.path().join("sightfix.service");
    let unit = UNIT.replace("ExecStart=sightfix", concat!("ExecStart=", env!("CARGO_BIN_EXE_sightfix")));
    std::fs::write(&path, unit).expect("written");
    let verified = Command::new("systemd-analyze").arg("verify").arg(&path).output().expect("it runs");
    let reported = String::from_utf8_lossy(&verified.stderr).into_owned();
    assert!(verified.status.success() && reported.trim().is_empty(), "{reported}");
    for setting in ["ExecReload=/bin/kill -HUP", "NoNewPrivileges=yes", "RestartPreventExitStatus=2 4"] {
        assert!(UNIT.contains(setting), "{setting}");
    }
}
