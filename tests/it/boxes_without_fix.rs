//! Samples without a fix: imported, paired, listed, exported, counted, replaced, deleted, limited, and used by
//! training.

use std::fmt::Write as _;
use std::path::Path;

use futures_util::stream;
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;

use crate::harness::{TestServer, data_folder, run, sightfix, simulated_csv};

const SAMPLES: &str = "/v1/cameras/c/samples";
const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";

fn time(second: i64) -> jiff::Timestamp {
    jiff::Timestamp::from_second(1_600_000_000 + second).expect("in range")
}

/// A row of `person-1`, with a fix or without.
fn row(second: i64, has_fix: bool) -> String {
    let fix = if has_fix { "103.9,30.6" } else { "," };
    format!("{},person-1,{},20,30,60,{fix}\n", time(second), 10 + second)
}

async fn with_camera(profile: &Value) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", profile).await.expect(201);
    (folder, server)
}

async fn import(server: &TestServer, path: &str, content_type: &str, body: String) -> Value {
    server.send("POST", path, &[("content-type", content_type)], body).await.expect(200).json()
}

async fn csv(server: &TestServer, rows: impl IntoIterator<Item = String>) -> Value {
    let body = std::iter::once(HEADER.to_owned()).chain(rows).collect();
    import(server, SAMPLES, "text/csv", body).await
}

async fn export(server: &TestServer, path: &str, media_type: &str) -> String {
    server.send("GET", path, &[("accept", media_type)], "").await.expect(200).text()
}

async fn counts(server: &TestServer) -> (u64, u64) {
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    let count = server.get(&format!("{SAMPLES}/count")).await.expect(200).json();
    assert_eq!(
        (&camera["samples"], &camera["samples_without_fix"]),
        (&count["count"], &count["without_fix"])
    );
    (count["count"].as_u64().expect("a number"), count["without_fix"].as_u64().expect("a number"))
}

#[tokio::test]
async fn rows_without_a_fix_are_stored_and_come_back_in_every_format() {
    let (_folder, server) = with_camera(&json!({"id": "c"})).await;
    server.post("/v1/cameras", &json!({"id": "copy"})).await.expect(201);
    let half = format!("{},person-1,1,2,3,4,103.9,\n", time(50));
    let report = csv(&server, (0..10).map(|second| row(second, second % 2 == 0)).chain([half])).await;
    assert_eq!(
        (&report["accepted"], &report["accepted_without_fix"], &report["rejected"]),
        (&json!(10), &json!(5), &json!(1)),
        "{report}"
    );
    let rejected = &report["rejected_rows"][0];
    assert_eq!((&rejected["line"], &rejected["field"]), (&json!(12), &json!("latitude")), "{report}");
    let single = json!([{
        "time": "2026-01-01T00:00:00Z", "target_id": "b",
        "bounding_box": {"left_px": 1.0, "top_px": 2.0, "width_px": 3.0, "height_px": 4.0},
    }]);
    let report = server.post(SAMPLES, &single).await.expect(200).json();
    assert_eq!(report["accepted_without_fix"], 1, "{report}");
    assert_eq!(counts(&server).await, (11, 6));

    let copy = "/v1/cameras/copy/samples";
    let items = server.get(SAMPLES).await.expect(200).json()["items"].clone();
    assert_eq!((items[0]["fix"].is_object(), items[1].get("fix")), (true, None), "{items}");
    for (media_type, body) in [
        ("text/csv", export(&server, SAMPLES, "text/csv").await),
        ("application/x-ndjson", export(&server, SAMPLES, "application/x-ndjson").await),
        ("application/json", items.to_string()),
    ] {
        let report = import(&server, copy, media_type, body).await;
        assert_eq!(
            (&report["accepted"], &report["accepted_without_fix"]),
            (&json!(11), &json!(6)),
            "{report}"
        );
        assert_eq!(server.get(copy).await.expect(200).json()["items"], items, "{media_type}");
        let all = format!("{copy}?from=2000-01-01T00:00:00Z");
        let deleted = server.send("DELETE", &all, &[], "").await.expect(200).json();
        assert_eq!(deleted["deleted"], 11);
    }
    let map: Value =
        serde_json::from_str(&export(&server, SAMPLES, "application/geo+json").await).expect("JSON");
    assert_eq!(map["features"][1]["geometry"], Value::Null, "a feature without a position");

    for (query, expected) in [("?has_fix=true", 5), ("?has_fix=false", 6), ("?has_fix=false&limit=4", 4)] {
        let items = server.get(&format!("{SAMPLES}{query}")).await.expect(200).json()["items"].clone();
        let items = items.as_array().expect("items");
        let has_fix = query.contains("true");
        assert!(
            items.len() == expected && items.iter().all(|it| it["fix"].is_object() == has_fix),
            "{items:?}"
        );
    }
    let refused = server.get(&format!("{SAMPLES}?has_fix=1")).await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "has_fix");
    let deleted =
        server.send("DELETE", &format!("{SAMPLES}?has_fix=false"), &[], "").await.expect(200).json();
    assert_eq!((&deleted["deleted"], counts(&server).await), (&json!(6), (5, 0)));
}

#[tokio::test]
async fn a_fix_that_comes_later_takes_the_place_of_none() {
    let (folder, server) = with_camera(&json!({"id": "c"})).await;
    csv(&server, (0..3_000).map(|second| row(second, false))).await;
    assert_eq!(counts(&server).await, (3_000, 3_000));
    let report = csv(&server, (1_000..2_000).map(|second| row(second, true))).await;
    assert_eq!((&report["accepted"], &report["duplicate"]), (&json!(1_000), &json!(0)), "{report}");
    assert_eq!(counts(&server).await, (3_000, 2_000));
    let report = csv(&server, (0..3_000).map(|second| row(second, false))).await;
    assert_eq!((&report["accepted"], &report["duplicate"]), (&json!(0), &json!(3_000)), "{report}");
    assert_eq!(counts(&server).await, (3_000, 2_000));
    // The counts survive a restart, and go with the camera.
    assert!(server.terminate());
    let server = TestServer::start(folder.path());
    assert_eq!(counts(&server).await, (3_000, 2_000));
    server.send("DELETE", "/v1/cameras/c", &[("if-match", "*")], "").await.expect(204);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    assert_eq!(counts(&server).await, (0, 0));
}

#[tokio::test]
async fn the_limit_of_a_camera_counts_samples_without_a_fix() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA", "10")]);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    csv(&server, (0..6).map(|second| row(second, false))).await;
    let five: String =
        std::iter::once(HEADER.to_owned()).chain((6..11).map(|second| row(second, true))).collect();
    let refused =
        server.send("POST", SAMPLES, &[("content-type", "text/csv")], five).await.expect(507).json();
    assert!(
        refused["detail"].as_str().expect("text").contains("limits.samples_per_camera is 10"),
        "{refused}"
    );
    csv(&server, (6..10).map(|second| row(second, true))).await;
    assert_eq!(counts(&server).await, (10, 6));
}

#[tokio::test]
async fn both_transports_store_list_count_and_reject_alike() {
    let (_folder, server) = with_camera(&json!({"id": "c"})).await;
    server.post("/v1/cameras", &json!({"id": "g"})).await.expect(201);
    let mut client = SampleServiceClient::new(server.channel().await);
    let sample = |second: i64, fix| proto::Sample {
        time: Some(prost_types::Timestamp { seconds: time(second).as_second(), nanos: 0 }),
        target_id: "person-1".to_owned(),
        bounding_box: Some(proto::BoundingBox {
            left_px: Some((10 + second) as f64),
            top_px: Some(20.0),
            width_px: Some(30.0),
            height_px: Some(60.0),
        }),
        fix,
        ..Default::default()
    };
    let place =
        |latitude_deg| Some(Box::new(proto::Fix { longitude_deg: Some(103.9), latitude_deg, sigma_m: None }));
    let samples =
        vec![sample(0, place(Some(30.6))), sample(1, None), sample(2, place(None)), sample(1, None)];
    let message = proto::ImportSamplesRequest { camera_id: "g".to_owned(), samples, ..Default::default() };
    let by_grpc = client.import_samples(stream::iter([message])).await.expect("taken").into_inner();

    let body = |second: i64, fix: Option<Value>| {
        let bounding_box = json!({"left_px": 10 + second, "top_px": 20, "width_px": 30, "height_px": 60});
        let mut row = json!({
            "time": time(second).to_string(), "target_id": "person-1", "bounding_box": bounding_box,
        });
        if let Some(fix) = fix {
            row["fix"] = fix;
        }
        row
    };
    let rows = json!([
        body(0, Some(json!({"longitude_deg": 103.9, "latitude_deg": 30.6}))),
        body(1, None),
        body(2, Some(json!({"longitude_deg": 103.9}))),
        body(1, None),
    ]);
    let by_rest = server.post(SAMPLES, &rows).await.expect(200).json();
    for (rest, grpc) in [
        ("accepted", by_grpc.accepted),
        ("accepted_without_fix", by_grpc.accepted_without_fix),
        ("duplicate", by_grpc.duplicate),
        ("rejected", by_grpc.rejected),
    ] {
        assert_eq!(by_rest[rest], grpc, "{rest}: {by_rest} {by_grpc:?}");
    }
    assert_eq!((by_grpc.accepted, by_grpc.accepted_without_fix, by_grpc.rejected), (2, 1, 1), "{by_grpc:?}");
    let (rest, grpc) = (&by_rest["rejected_rows"][0], &by_grpc.rejected_rows[0]);
    assert_eq!((&rest["line"], &rest["field"]), (&json!(grpc.line), &json!(grpc.field)));
    assert_eq!((grpc.line, grpc.field.as_str()), (3, "fix.latitude_deg"));

    for has_fix in [None, Some(true), Some(false)] {
        let filter = Some(proto::SampleFilter { has_fix, ..Default::default() });
        let request = proto::ListSamplesRequest {
            camera_id: "c".to_owned(),
            filter: filter.clone(),
            ..Default::default()
        };
        let listed = client.list_samples(request).await.expect("a page").into_inner().samples;
        let count = proto::CountSamplesRequest { camera_id: "c".to_owned(), filter };
        let count = client.count_samples(count).await.expect("a number").into_inner();
        let query = has_fix.map(|has_fix| format!("?has_fix={has_fix}")).unwrap_or_default();
        let items = server.get(&format!("{SAMPLES}{query}")).await.expect(200).json()["items"].clone();
        let by_rest: Vec<bool> =
            items.as_array().expect("items").iter().map(|it| it["fix"].is_object()).collect();
        let by_grpc: Vec<bool> = listed.iter().map(|sample| sample.fix.is_some()).collect();
        assert_eq!(by_rest, by_grpc);
        let rest = server.get(&format!("{SAMPLES}/count{query}")).await.expect(200).json();
        assert_eq!(rest, json!({"count": count.count, "without_fix": count.without_fix}));
        assert_eq!(count.count, by_grpc.len() as u64);
    }
    let request = proto::GetCameraRequest { camera_id: "c".to_owned() };
    let camera = CameraServiceClient::new(server.channel().await).get_camera(request).await.expect("known");
    let camera = camera.into_inner().camera.expect("set");
    assert_eq!((camera.samples, camera.samples_without_fix), (2, 1));
}

/// A folder with detections of `a` every second and of `b`, and fixes of `a` at every third.
fn recording(folder: &Path) -> [String; 2] {
    let mut detections = "time,target_id,left,top,width,height\n".to_owned();
    let mut fixes = "time,receiver_id,longitude,latitude\n".to_owned();
    for second in 0..30 {
        writeln!(detections, "{},a,{},20,30,60", time(second), 10 + second).expect("memory");
        writeln!(detections, "{},b,{},20,30,60", time(second), 50 + second).expect("memory");
        if second % 3 == 0 {
            writeln!(fixes, "{},a,103.9,30.6", time(second)).expect("memory");
        }
    }
    [("detections.csv", detections), ("fixes.csv", fixes)].map(|(name, text)| {
        let path = folder.join(name);
        std::fs::write(&path, text).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    })
}

#[tokio::test]
async fn boxes_that_find_no_fix_are_kept_on_request() {
    let folder = data_folder();
    let [detections, fixes] = recording(folder.path());
    let out = folder.path().join("paired.csv").to_str().expect("UTF-8").to_owned();
    let arguments = ["pair", "--detections", &detections, "--fixes", &fixes, "--out", &out, "--overwrite"];
    run(&arguments);
    assert_eq!(std::fs::read_to_string(&out).expect("written").lines().count(), 1 + 10);
    let printed = run(&[&arguments[..], &["--keep-unpaired"]].concat());
    assert!(printed.contains("boxes kept without a fix 50"), "{printed}");
    let csv = std::fs::read_to_string(&out).expect("written");
    assert_eq!((csv.lines().count(), csv.matches(",60,,,").count()), (1 + 60, 50), "{csv}");

    let data = folder.path().join("data").to_str().expect("UTF-8").to_owned();
    let printed = run(&["import", &out, "--camera", "c", "--create", "--data", &data]);
    assert!(printed.contains("accepted 60 (without a fix 50), duplicate 0, rejected 0"), "{printed}");

    let server = TestServer::start(Path::new(&data));
    assert_eq!(counts(&server).await, (60, 50));
    server.send("DELETE", "/v1/cameras/c", &[("if-match", "*")], "").await.expect(204);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let boundary = "a-boundary-of-its-own";
    let part = |name: &str, path: &str| {
        let text = std::fs::read_to_string(path).expect("readable");
        format!(
            "--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"f.csv\"\r\n\r\n{text}\r\n"
        )
    };
    let body = format!("{}{}--{boundary}--\r\n", part("detections", &detections), part("fixes", &fixes));
    let content_type = format!("multipart/form-data; boundary={boundary}");
    for (query, accepted, without_fix, all) in [
        ("", 10, 0, (10, 0)),
        ("?keep_unpaired=true", 50, 50, (60, 50)),
        ("?keep_unpaired=true", 0, 0, (60, 50)),
    ] {
        let path = format!("{SAMPLES}/pairings{query}");
        let report = import(&server, &path, &content_type, body.clone()).await;
        assert_eq!(
            (&report["accepted"], &report["accepted_without_fix"]),
            (&json!(accepted), &json!(without_fix)),
            "{query}: {report}"
        );
        assert_eq!(report["pairing"]["unpaired_detections"]["no_fix_of_target"], 30, "{report}");
        assert_eq!(counts(&server).await, all);
    }
    assert_eq!(export(&server, SAMPLES, "text/csv").await, csv, "both ways store the same");
}

/// The simulated rows; those of the second target without their fixes.
fn csv_with_one_receiver() -> (String, usize) {
    let csv = simulated_csv();
    let target_of = |line: &str| line.split(',').nth(1).expect("a target").to_owned();
    let first = target_of(csv.lines().nth(1).expect("a row"));
    let mut without_fix = 0;
    let mut out = String::new();
    for (number, line) in csv.lines().enumerate() {
        if number == 0 || target_of(line) == first {
            writeln!(out, "{line}").expect("memory");
            continue;
        }
        let mut cells: Vec<&str> = line.split(',').collect();
        (cells[6], cells[7]) = ("", "");
        without_fix += 1;
        writeln!(out, "{}", cells.join(",")).expect("memory");
    }
    (out, without_fix)
}

#[tokio::test]
async fn training_uses_boxes_without_a_fix_up_to_a_limit() {
    let (csv, without_fix) = csv_with_one_receiver();
    let camera = json!({"id": "c", "image_size": {"width_px": 1280, "height_px": 720}});
    let mut fingerprints = Vec::new();
    for (limit, used) in [("20000", without_fix), ("100", 100), ("100", 100)] {
        let folder = data_folder();
        let server =
            TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__BOXES_WITHOUT_FIX_PER_RUN", limit)]);
        server.post("/v1/cameras", &camera).await.expect(201);
        let report = import(&server, SAMPLES, "text/csv", csv.clone()).await;
        assert_eq!(report["accepted_without_fix"], without_fix, "{report}");
        let run = server.train("c", &json!({"recipe": "gaussian_process"})).await;
        assert_eq!(run["state"], "succeeded", "{run}");
        let metadata = server.get("/v1/cameras/c/models/1").await.expect(200).json()["metadata"].clone();
        let found = metadata["parameters"]["boxes_without_fix"].as_f64().expect("a number");
        println!(
            "limit {limit}: {found} of {without_fix} boxes without a fix, {} samples",
            metadata["samples"]
        );
        // At most one of each stride is taken.
        let least = used.min(without_fix.div_ceil(without_fix.div_ceil(used)) - 1);
        assert!((least as f64..=used as f64).contains(&found), "{found} of {used}");
        fingerprints.push((metadata["training_rows_sha256"].clone(), metadata["parameters"].clone()));
    }
    assert_ne!(fingerprints[0].0, fingerprints[1].0, "other boxes are other training rows");
    assert_eq!(fingerprints[1], fingerprints[2], "the same boxes are taken each time");
}

#[tokio::test]
async fn the_common_bias_of_the_fixes_is_part_of_the_profile_and_of_the_stated_error() {
    let profile = json!({
        "id": "c", "image_size": {"width_px": 1280, "height_px": 720}, "gnss_bias_sigma_m": 8.0,
    });
    let (_folder, server) = with_camera(&profile).await;
    let patch = async |change: Value| {
        let headers = [("content-type", "application/json"), ("if-match", "*")];
        server.send("PATCH", "/v1/cameras/c", &headers, change.to_string()).await
    };
    import(&server, SAMPLES, "text/csv", simulated_csv()).await;
    let row: Vec<String> =
        simulated_csv().lines().nth(200).expect("a row").split(',').map(str::to_owned).collect();
    let number = |at: usize| row[at].parse::<f64>().expect("a number");
    let observation = json!({"time": "2026-01-01T00:00:00Z", "bounding_box": {
        "left_px": number(2), "top_px": number(3), "width_px": number(4), "height_px": number(5),
    }});
    let mut radii_m = Vec::new();
    for (change, shown) in
        [(json!({}), json!(8.0)), (json!({"gnss_bias_sigma_m": null}), Value::Null), (json!({}), Value::Null)]
    {
        let camera = patch(change).await.expect(200).json();
        assert_eq!(camera["gnss_bias_sigma_m"], shown, "{camera}");
        let run = server.train("c", &json!({"recipe": "gaussian_process"})).await;
        assert_eq!(run["state"], "succeeded", "{run}");
        let number = run["model_version"].clone();
        let activate = json!({ "number": number }).to_string();
        let headers = [("content-type", "application/json")];
        server.send("PUT", "/v1/cameras/c/active-model", &headers, activate).await.expect(200);
        let answer = server.post("/v1/cameras/c/fusions", &observation).await.expect(200).json();
        radii_m.push(answer["items"][0]["r95_m"].as_f64().expect("a radius"));
    }
    println!(
        "95 % radius with a common bias of 8 m per axis {:.2} m, without {:.2} m",
        radii_m[0], radii_m[1]
    );
    assert!(radii_m[0] > 8.0 * 2.4 && radii_m[1] < 10.0 && radii_m[1] == radii_m[2], "{radii_m:?}");
}

#[tokio::test]
async fn a_common_bias_out_of_range_is_refused_alike() {
    let (_folder, server) = with_camera(&json!({"id": "c"})).await;
    let mut client = CameraServiceClient::new(server.channel().await);
    for sigma_m in [0.0, -1.0, 100.5, 1e300] {
        let rest = server.post("/v1/cameras", &json!({"id": "new", "gnss_bias_sigma_m": sigma_m})).await;
        let rest = rest.expect(422).json();
        let profile = proto::CameraProfile { gnss_bias_sigma_m: Some(sigma_m), ..Default::default() };
        let request = proto::CreateCameraRequest { id: "new".to_owned(), profile: Some(profile) };
        let grpc = client.create_camera(request).await.expect_err("out of range");
        let detail = rest["detail"].as_str().expect("text");
        assert_eq!(rest["violations"][0]["field"], "gnss_bias_sigma_m", "{rest}");
        assert_eq!(
            (grpc.code(), grpc.message()),
            (tonic::Code::InvalidArgument, &*format!("profile.{detail}"))
        );
        let output = sightfix()
            .args([
                "import",
                "none.csv",
                "--camera",
                "new",
                "--create",
                &format!("--gnss-bias-sigma-m={sigma_m}"),
            ])
            .output()
            .expect("the binary runs");
        assert!(!output.status.success() && String::from_utf8_lossy(&output.stderr).contains("100 metres"));
    }
    let profile = proto::CameraProfile { gnss_bias_sigma_m: Some(100.0), ..Default::default() };
    let request = proto::CreateCameraRequest { id: "new".to_owned(), profile: Some(profile) };
    client.create_camera(request).await.expect("in range");
    let camera = server.get("/v1/cameras/new").await.expect(200).json();
    assert_eq!(camera["gnss_bias_sigma_m"], 100.0, "{camera}");
    let mask = prost_types::FieldMask { paths: vec!["gnss_bias_sigma_m".to_owned()] };
    let request = proto::UpdateCameraRequest {
        camera_id: "new".to_owned(),
        profile: Some(proto::CameraProfile::default()),
        update_mask: Some(mask),
        expected_revision: None,
    };
    let changed = client.update_camera(request).await.expect("forgotten").into_inner().camera.expect("set");
    assert_eq!(changed.profile.expect("set").gnss_bias_sigma_m, None);
}
