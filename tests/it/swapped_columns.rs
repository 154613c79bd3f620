//! Latitude and longitude swapped where both orders are positions: imports and training runs tell.

use std::fmt::Write as _;

use futures_util::stream;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::simulation::{Options, simulate};
use tonic_types::StatusExt as _;

use crate::harness::{TestServer, data_folder, sightfix};

#[derive(Clone, Copy)]
enum Columns {
    Right,
    Swapped,
}

/// A row of a file: time, target, the four sides of the box, longitude and latitude.
type Row = (String, String, [f64; 4], [f64; 2]);

/// Samples of the simulated camera, which is in Europe.
fn rows(columns: Columns) -> Vec<Row> {
    let samples = simulate(&Options::demo()).training_samples();
    let row = |sample: &sightfix::domain::Sample| {
        let position = sample.fix.position;
        let mut place = [position.longitude_deg(), position.latitude_deg()];
        if let Columns::Swapped = columns {
            place.reverse();
        }
        (sample.time.to_string(), sample.target_id.to_string(), sample.bounding_box.sides_px(), place)
    };
    samples.iter().map(row).collect()
}

fn csv(rows: &[Row]) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for (time, target, [left, top, width, height], [longitude, latitude]) in rows {
        writeln!(csv, "{time},{target},{left},{top},{width},{height},{longitude},{latitude}")
            .expect("memory");
    }
    csv
}

async fn import(server: &TestServer, camera: &str, query: &str, rows: &[Row]) -> Value {
    let path = format!("/v1/cameras/{camera}/samples{query}");
    let report = server.send("POST", &path, &[("content-type", "text/csv")], csv(rows)).await;
    report.expect(200).json()
}

fn warning(report: &Value) -> &str {
    report["warnings"][0].as_str().unwrap_or_default()
}

async fn with_cameras(cameras: &[&str]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    for id in cameras {
        let camera = json!({"id": id, "image_size": {"width_px": 1920, "height_px": 1080}});
        server.post("/v1/cameras", &camera).await.expect(201);
    }
    (folder, server)
}

#[tokio::test]
async fn a_first_import_with_swapped_columns_is_told_and_so_is_its_training_run() {
    let (_folder, server) = with_cameras(&["right", "swapped"]).await;
    let right = import(&server, "right", "", &rows(Columns::Right)).await;
    assert_eq!(right["warnings"], json!([]), "{right}");
    let swapped = import(&server, "swapped", "", &rows(Columns::Swapped)).await;
    assert_eq!(swapped["accepted"], right["accepted"]);
    let told = warning(&swapped);
    assert!(told.contains("swapped") && told.contains("on_conflict=replace"), "{swapped}");
    let advice = async |camera: &str| {
        let run = server.train(camera, &json!({"recipe": "hybrid", "epochs": 2})).await;
        run["report"]["advice"].to_string()
    };
    let (of_right, of_swapped) = (advice("right").await, advice("swapped").await);
    assert!(!of_right.contains("swapped"), "{of_right}");
    assert!(of_swapped.contains("swap the two columns"), "{of_swapped}");
    // The remedy.
    import(&server, "swapped", "?on_conflict=replace", &rows(Columns::Right)).await;
    let of_mended = advice("swapped").await;
    assert!(!of_mended.contains("swapped"), "{of_mended}");
}

#[tokio::test]
async fn swapped_rows_are_told_by_the_cameras_other_positions() {
    let (_folder, server) = with_cameras(&["stored", "mixed"]).await;
    let (right, swapped) = (rows(Columns::Right), rows(Columns::Swapped));
    assert_eq!(import(&server, "stored", "", &right[..5]).await["warnings"], json!([]));
    let report = import(&server, "stored", "", &swapped[5..8]).await;
    assert!(warning(&report).contains("swapped in 3 of 3 fixes"), "{report}");
    // Within one import, too.
    let mixed: Vec<Row> = right[..40].iter().chain(&swapped[40..45]).cloned().collect();
    let report = import(&server, "mixed", "", &mixed).await;
    assert!(warning(&report).contains("swapped in 5 of 45 fixes"), "{report}");
    let run = server.train("mixed", &json!({"recipe": "hybrid", "epochs": 2})).await;
    assert!(run["report"]["advice"].to_string().contains("swapped in 5 of 45 samples"), "{run}");
}

#[tokio::test]
async fn fixes_are_compared_with_the_location_of_the_camera() {
    let (_folder, server) = with_cameras(&["gate"]).await;
    let (right, swapped) = (rows(Columns::Right), rows(Columns::Swapped));
    let [longitude, latitude] = right[0].3;
    let location = async |longitude: f64, latitude: f64| {
        let change = json!({"location": {"longitude_deg": longitude, "latitude_deg": latitude}});
        let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
        server.send("PATCH", "/v1/cameras/gate", &headers, change.to_string()).await
    };
    location(longitude + 0.1, latitude - 0.1).await.expect(200);
    let camera = server.get("/v1/cameras/gate").await.expect(200).json();
    assert_eq!(camera["location"]["longitude_deg"], json!(longitude + 0.1));
    // Five rows are too few for a mirror image, and there is no other position.
    assert_eq!(import(&server, "gate", "", &right[..5]).await["warnings"], json!([]));
    let report = import(&server, "gate", "", &swapped[5..10]).await;
    let told = warning(&report);
    assert!(told.contains("swapped in 5 of 5 fixes, or in the location of the camera's profile"), "{report}");
    // A location in another city, although the fixes are where the stored ones are.
    location(longitude + 1.0, latitude).await.expect(200);
    let report = import(&server, "gate", "", &right[10..14]).await;
    let told = warning(&report);
    assert!(
        told.contains("4 of 4 fixes are far from the camera") && told.contains("correct the location"),
        "{report}"
    );
    let refused = location(longitude, 91.0).await.expect(422);
    assert!(refused.text().contains("location.latitude_deg"), "{}", refused.text());
}

#[tokio::test]
async fn grpc_and_the_command_tell_of_swapped_columns() {
    let (folder, server) = with_cameras(&["by-grpc", "by-command"]).await;
    let rows = rows(Columns::Swapped);
    let sample = |(time, target, [left, top, width, height], [longitude, latitude]): &Row| {
        let time: jiff::Timestamp = time.parse().expect("a time");
        proto::Sample {
            time: Some(prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() }),
            target_id: target.clone(),
            bounding_box: Some(proto::BoundingBox {
                left_px: Some(*left),
                top_px: Some(*top),
                width_px: Some(*width),
                height_px: Some(*height),
            }),
            fix: Some(Box::new(proto::Fix {
                longitude_deg: Some(*longitude),
                latitude_deg: Some(*latitude),
                sigma_m: None,
            })),
            ..Default::default()
        }
    };
    let messages: Vec<_> = rows
        .chunks(200)
        .map(|rows| proto::ImportSamplesRequest {
            camera_id: "by-grpc".to_owned(),
            samples: rows.iter().map(sample).collect(),
            ..Default::default()
        })
        .collect();
    let mut samples = SampleServiceClient::new(server.channel().await);
    let report = samples.import_samples(stream::iter(messages)).await.expect("taken").into_inner();
    assert!(report.warnings[0].contains("swap the two columns"), "{report:?}");

    let mut cameras = CameraServiceClient::new(server.channel().await);
    let (longitude_deg, latitude_deg) = (Some(11.5), Some(48.1));
    let location = Some(proto::Position { longitude_deg, latitude_deg });
    let profile = Some(proto::CameraProfile { location, ..Default::default() });
    let change =
        proto::UpdateCameraRequest { camera_id: "by-grpc".to_owned(), profile, ..Default::default() };
    let changed = cameras.update_camera(change.clone()).await.expect("taken").into_inner();
    assert_eq!(changed.camera.expect("a camera").profile.expect("a profile").location, location);
    let latitude_deg = Some(-91.0);
    let profile = proto::CameraProfile {
        location: Some(proto::Position { longitude_deg, latitude_deg }),
        ..Default::default()
    };
    let refused =
        cameras.update_camera(proto::UpdateCameraRequest { profile: Some(profile), ..change }).await;
    let refused = refused.expect_err("no latitude").get_details_bad_request().expect("a field");
    assert_eq!(refused.field_violations[0].field, "profile.location.latitude_deg");

    let file = folder.path().join("samples.csv");
    std::fs::write(&file, csv(&rows)).expect("written");
    let mut command = sightfix();
    command.arg("import").arg(&file).args(["--camera", "by-command", "--data"]).arg(folder.path());
    let output = command.output().expect("the binary runs");
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    assert!(output.status.success() && text.contains("warning: latitude and longitude"), "{text}");
    let mut command = sightfix();
    command.arg("import").arg(&file).args(["--camera", "elsewhere", "--data"]).arg(folder.path());
    let output = command.args(["--create", "--location", "-70.5,-33.4"]).output().expect("the binary runs");
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    assert!(output.status.success() && text.contains("fixes are far from the camera"), "{text}");
}
