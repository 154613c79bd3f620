//! Sinks of files: GPX and KML.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::peers::{connection_when, create_gate, send_fix};
use crate::harness::{TestServer, data_folder, now};

/// Files of a folder, in the order of their names.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    files
}

fn text(path: &Path) -> String {
    let text = std::fs::read_to_string(path).expect("a file");
    let mut reader = quick_xml::Reader::from_str(&text);
    while !matches!(reader.read_event().expect("XML"), quick_xml::events::Event::Eof) {}
    text
}

/// Sends fixes of two targets, some seconds apart, the last of now; returns their number.
async fn send_walks(server: &TestServer, seconds: i64) -> usize {
    let now = now();
    for index in 1..=seconds {
        let time = (now - jiff::SignedDuration::from_secs(seconds - index)).to_string();
        for target in ["van", "a&b"] {
            send_fix(server, target, &time, 103.98678 + index as f64 * 1e-5, false).await;
        }
    }
    2 * seconds as usize
}

#[tokio::test]
async fn tracks_go_into_files_that_are_always_complete() {
    let (folder, exports) = (data_folder(), data_folder());
    let export_folder = exports.path().to_str().expect("a path");
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_EXPORT_FOLDER", export_folder)]);
    create_gate(&server).await;
    for format in ["gpx", "kml"] {
        let sink = json!({"address": "file:", "format": format, "camera_ids": ["gate"], "min_interval_s": 0});
        server.post("/v1/connections", &json!({"id": format, "sink": sink})).await.expect(201);
        connection_when(&server, format, |status| status["state"] == "running").await;
    }
    let sent = send_walks(&server, 3).await;
    for (format, point) in [("gpx", "<trkpt "), ("kml", "<gx:coord>")] {
        connection_when(&server, format, |status| status["messages"] == sent).await;
        let written = files(&exports.path().join(format));
        assert_eq!(written.len(), 1, "{written:?}");
        let content = text(&written[0]);
        assert_eq!(content.matches(point).count(), sent, "{content}");
        assert_eq!(content.matches("<name>").count(), 2, "a track per target: {content}");
        assert!(content.contains("<name>a&amp;b</name>"), "{content}");
    }
    // The importer of fixes reads what the sink has written.
    let gpx = std::fs::read(&files(&exports.path().join("gpx"))[0]).expect("a file");
    let refused = sightfix::exchange::read_fixes(
        std::io::Cursor::new(gpx),
        sightfix::exchange::FixFormat::Gpx,
        sightfix::domain::TimeBounds::at(now()),
    );
    assert_eq!(refused.expect("GPX").filter(|row| matches!(row, Ok(Ok(_)))).count(), sent);
}

#[tokio::test]
async fn files_are_only_written_where_the_operator_of_the_machine_says() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let draft = |address: &str, format: &str| json!({"id": "gpx", "sink": {"address": address, "format": format, "camera_ids": ["gate"]}});
    for (address, format) in [("file:", "json"), ("udp://127.0.0.1:9", "gpx"), ("file:///etc", "gpx")] {
        let refused = server.post("/v1/connections", &draft(address, format)).await.expect(422);
        assert!(refused.text().contains("sink."), "{address} {format}: {}", refused.text());
    }
    server.post("/v1/connections", &draft("file:", "gpx")).await.expect(201);
    let status = connection_when(&server, "gpx", |status| status["state"] == "waiting").await;
    let error = status["status"]["last_error"].to_string();
    assert!(error.contains("export_folder"), "{status}");
}
