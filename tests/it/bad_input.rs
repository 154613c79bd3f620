//! Bad input: each piece is refused by a 4xx problem that names the field, and leaves nothing behind.

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder};

const FUSIONS: &str = "/v1/cameras/c/fusions";

async fn with_camera(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    let profile = json!({"id": "c", "image_size": {"width_px": 640, "height_px": 480}});
    server.post("/v1/cameras", &profile).await.expect(201);
    (folder, server)
}

/// A good observation with one place changed.
fn changed(place: &str, value: Value) -> String {
    let mut observation = json!({
        "time": "2026-01-01T00:00:00Z",
        "bounding_box": {"left_px": 10.0, "top_px": 10.0, "width_px": 20.0, "height_px": 40.0},
        "fix": {"longitude_deg": 103.9, "latitude_deg": 30.6},
    });
    let (parents, name) = place.rsplit_once('/').expect("a place");
    let parent = observation.pointer_mut(parents).expect("its parent").as_object_mut().expect("an object");
    parent.insert(name.to_owned(), value);
    observation.to_string()
}

async fn refused(server: &TestServer, path: &str, content_type: &str, body: String, field: &str) {
    let answer = server.send("POST", path, &[("content-type", content_type)], body.clone()).await;
    let said = format!("{body:.200}: {}", answer.text());
    assert!(answer.status.is_client_error(), "{said}");
    assert_eq!(answer.header("content-type"), "application/problem+json", "{said}");
    let problem = answer.json();
    assert!(problem["type"].as_str().is_some_and(|name| name.starts_with("urn:sightfix:problem:")), "{said}");
    let named = problem["violations"]
        .as_array()
        .into_iter()
        .flatten()
        .any(|violation| violation["field"].as_str().is_some_and(|named| named.ends_with(field)));
    assert!(named || field.is_empty(), "the field {field} is not named: {said}");
}

#[tokio::test]
async fn observations_with_bad_values_name_the_field() {
    let (_folder, server) = with_camera(&[]).await;
    for (place, value, field) in [
        ("/fix/latitude_deg", json!(91), "latitude_deg"),
        ("/fix/longitude_deg", json!(181), "longitude_deg"),
        ("/fix/longitude_deg", json!(null), "longitude_deg"),
        ("/fix/longitude_deg", json!("103.9"), "longitude_deg"),
        ("/fix/sigma_m", json!(-1), "sigma_m"),
        ("/bounding_box/width_px", json!(0), "width_px"),
        ("/bounding_box/height_px", json!(-5), "height_px"),
        ("/bounding_box/left_px", json!(1e39), "left_px"),
        ("/bounding_box/left_px", json!(5000), "left_px"),
        ("/bounding_box/depth_px", json!(5), "depth_px"),
        ("/time", json!("2026-01-01T00:00:00"), "time"),
        ("/time", json!("2999-01-01T00:00:00Z"), "time"),
        ("/time", json!(5), "time"),
        ("/target_id", json!(""), "target_id"),
        ("/box", json!({}), "box"),
    ] {
        refused(&server, FUSIONS, "application/json", changed(place, value), field).await;
    }
    for (word, field) in [("NaN", ""), ("Infinity", ""), ("1e400", "")] {
        let body = changed("/bounding_box/left_px", json!("HERE")).replace("\"HERE\"", word);
        refused(&server, FUSIONS, "application/json", body, field).await;
    }
    let neither = json!({"time": "2026-01-01T00:00:00Z"}).to_string();
    refused(&server, FUSIONS, "application/json", neither, "bounding_box").await;
    refused(&server, FUSIONS, "application/json", "{".to_owned(), "").await;
    refused(&server, FUSIONS, "text/html", "{}".to_owned(), "").await;
    refused(&server, "/v1/cameras/none/fusions", "application/json", changed("/target_id", json!("a")), "")
        .await;
}

#[tokio::test]
async fn bodies_beyond_the_limit_are_refused_and_leave_nothing() {
    let (_folder, server) = with_camera(&[]).await;
    let hundred_megabytes = " ".repeat(100 << 20);
    for (path, content_type) in [(FUSIONS, "application/json"), ("/v1/cameras/c/samples", "text/csv")] {
        let headers = [("content-type", content_type)];
        let answer = server.send("POST", path, &headers, hundred_megabytes.clone()).await.expect(413);
        assert!(answer.json()["type"].as_str().is_some_and(|name| name.ends_with("too-large")));
    }
    let many =
        vec![json!({"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": 1, "latitude_deg": 2}}); 1_001];
    let body = json!({"observations": many}).to_string();
    refused(&server, FUSIONS, "application/json", body, "observations").await;
    let count = server.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 0);
}

#[tokio::test]
async fn one_bad_row_never_loses_the_others() {
    let (_folder, server) = with_camera(&[]).await;
    let csv = "target_id,time,left,top,width,height,longitude,latitude,sigma_m\n\
               a,2026-01-01T00:00:00Z,1,2,3,4,103.9,30.6,\n\
               a,2026-01-01T00:00:01Z,1,2,3,4,103.9,91,\n\
               a,2026-01-01T00:00:02,1,2,3,4,103.9,30.6,\n\
               a,2026-01-01T00:00:03Z,1,2,0,4,103.9,30.6,\n\
               a,2026-01-01T00:00:04Z,1,2,3,4,103.9,30.6,2.5\n\
               a,2026-01-01T00:00:04Z,1,2,3,4,103.9,30.6,2.5\n";
    let headers = [("content-type", "text/csv")];
    let report = server.send("POST", "/v1/cameras/c/samples", &headers, csv).await.expect(200).json();
    assert_eq!(report["accepted"], 2, "{report}");
    assert_eq!(report["duplicate"], 1, "{report}");
    assert_eq!(report["rejected"], 3, "{report}");
    let reported: Vec<_> = report["rejected_rows"]
        .as_array()
        .expect("rows")
        .iter()
        .map(|row| {
            (row["line"].as_u64().expect("a line"), row["field"].as_str().expect("a field").to_owned())
        })
        .collect();
    assert_eq!(reported.len(), 3, "{report}");
    for ((line, field), (expected_line, part)) in
        reported.iter().zip([(3, "latitude"), (4, "time"), (5, "width")])
    {
        assert_eq!(*line, expected_line, "{report}");
        assert!(field.contains(part), "{report}");
    }
    refused(&server, "/v1/cameras/c/samples", "text/csv", "time,nothing\n".to_owned(), "").await;
}

#[tokio::test]
async fn runs_that_cannot_succeed_are_refused() {
    let (_folder, server) = with_camera(&[]).await;
    let runs = "/v1/cameras/c/training-runs";
    refused(&server, runs, "application/json", "{}".to_owned(), "samples").await;
    refused(&server, runs, "application/json", json!({"epochs": 0}).to_string(), "epochs").await;
    refused(&server, runs, "application/json", json!({"recipe": "best"}).to_string(), "recipe").await;

    let row = |second: u32| format!("a,2026-01-01T00:00:{second:02}Z,1,2,3,4,103.9,30.6\n");
    let head = "target_id,time,left,top,width,height,longitude,latitude\n".to_owned();
    let headers = [("content-type", "text/csv")];
    let few: String = std::iter::once(head.clone()).chain((0..3).map(row)).collect();
    server.send("POST", "/v1/cameras/c/samples", &headers, few).await.expect(200);
    refused(&server, runs, "application/json", "{}".to_owned(), "samples").await;

    let one_spot: String = std::iter::once(head).chain((0..60).map(row)).collect();
    server.send("POST", "/v1/cameras/c/samples", &headers, one_spot).await.expect(200);
    refused(&server, runs, "application/json", "{}".to_owned(), "samples").await;
    let runs = server.get(runs).await.expect(200).json();
    assert_eq!(runs["items"], json!([]), "nothing was queued");
}
