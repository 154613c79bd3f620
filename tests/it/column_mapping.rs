//! Files of other columns: by REST and by the command line alike. The console's tests read the same cases.

use serde::Deserialize;
use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, run, sightfix};

const CSV: [(&str, &str); 1] = [("content-type", "text/csv")];
const SAMPLES: &str = "/v1/cameras/c/samples";

#[derive(Deserialize)]
struct Case {
    name: String,
    csv: String,
    box_form: Option<String>,
    box_unit: Option<String>,
    box_px: [f64; 4],
    fix_deg: [f64; 2],
    sigma_m: Option<f64>,
    time: String,
}

fn cases() -> Vec<Case> {
    serde_json::from_str(include_str!("../cases/column_mapping.json")).expect("the cases")
}

impl Case {
    #[track_caller]
    fn check(&self, sample: &Value) {
        let [left_px, top_px, width_px, height_px] = self.box_px;
        let sides =
            json!({"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px});
        assert_eq!(sample["bounding_box"], sides, "{}", self.name);
        let [longitude_deg, latitude_deg] = self.fix_deg;
        let fix = &sample["fix"];
        assert_eq!(fix["longitude_deg"], longitude_deg, "{}", self.name);
        assert_eq!(fix["latitude_deg"], latitude_deg, "{}", self.name);
        assert_eq!(fix["sigma_m"].as_f64(), self.sigma_m, "{}", self.name);
        assert_eq!(
            (&sample["time"], &sample["target_id"]),
            (&json!(self.time), &json!("a")),
            "{}",
            self.name
        );
    }
}

async fn with_camera() -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let camera = json!({"id": "c", "image_size": {"width_px": 1_000, "height_px": 500}});
    server.post("/v1/cameras", &camera).await.expect(201);
    (folder, server)
}

#[tokio::test]
async fn a_server_maps_the_columns_of_each_case() {
    let (_folder, server) = with_camera().await;
    for case in cases() {
        let mut path = format!("{SAMPLES}?columns=auto&on_conflict=replace");
        for (name, value) in [("box_form", &case.box_form), ("box_unit", &case.box_unit)] {
            if let Some(value) = value {
                path = format!("{path}&{name}={value}");
            }
        }
        let report = server.send("POST", &path, &CSV, case.csv.clone()).await.expect(200).json();
        assert_eq!(
            (&report["accepted"], &report["rejected"]),
            (&json!(1), &json!(0)),
            "{}: {report}",
            case.name
        );
        let stored = server.get(SAMPLES).await.expect(200).json();
        let of_case = stored["items"].as_array().into_iter().flatten().find(|item| item["time"] == case.time);
        case.check(of_case.unwrap_or_else(|| panic!("{}: {stored}", case.name)));
        server.send("DELETE", &format!("{SAMPLES}?target_id=a"), &[], "").await.expect(200);
    }
}

#[tokio::test]
async fn the_command_line_maps_them_alike() {
    for case in cases() {
        let (folder, files) = (data_folder(), data_folder());
        let path = files.path().join("samples.csv");
        std::fs::write(&path, &case.csv).expect("a file");
        let data = folder.path().to_str().expect("UTF-8");
        let file = path.to_str().expect("UTF-8");
        let mut arguments = vec!["import", file, "--camera", "c", "--create", "--image-size", "1000x500"];
        arguments.extend(["--data", data, "--columns", "auto"]);
        for (flag, value) in [("--box-form", &case.box_form), ("--box-unit", &case.box_unit)] {
            arguments.extend(value.as_ref().into_iter().flat_map(|value| [flag, value]));
        }
        assert!(run(&arguments).starts_with("accepted 1 "), "{}", case.name);
        let server = TestServer::start(folder.path());
        case.check(&server.get(SAMPLES).await.expect(200).json()["items"][0]);
    }
}

#[tokio::test]
async fn columns_are_named_and_the_documented_rule_stays_strict() {
    let (_folder, server) = with_camera().await;
    let csv = "When,Who,A,B,C,D,lon,lat\n2020-12-14T06:41:48Z,a,10,20,30,40,103,30\n";
    let named = "columns=time:when,target_id:Who,left:A,top:B,width:C,height:D";
    let report = server.send("POST", &format!("{SAMPLES}?{named}"), &CSV, csv).await.expect(200).json();
    assert_eq!((&report["accepted"], &report["accepted_without_fix"]), (&json!(1), &json!(1)), "{report}");
    // A file without a target gets the given one.
    let csv = "time,left,top,width,height\n2020-12-14T06:41:49Z,10,20,30,40\n";
    let report = server.send("POST", &format!("{SAMPLES}?target_id=b"), &CSV, csv).await.expect(200).json();
    assert_eq!(report["accepted"], 1, "{report}");
    for (query, csv, status, field) in [
        ("", "TIME,target_id,left,top,width,height\n", 400, "TIME"),
        ("?columns=all", "time\n", 422, "columns"),
        ("?columns=where:x", "time\n", 422, "columns"),
        ("?box_form=round", "time\n", 422, "box_form"),
        ("?box_unit=inch", "time\n", 422, "box_unit"),
        ("?columns=auto", "time,id,x,y\n", 400, "width"),
    ] {
        let problem =
            server.send("POST", &format!("{SAMPLES}{query}"), &CSV, csv).await.expect(status).json();
        assert_eq!(problem["violations"][0]["field"], field, "{query}: {problem}");
    }
    let json = [("content-type", "application/json")];
    let problem =
        server.send("POST", &format!("{SAMPLES}?columns=auto"), &json, "[]").await.expect(422).json();
    assert_eq!(problem["violations"][0]["field"], "columns");
    // Shares need the size of the image.
    server.post("/v1/cameras", &json!({"id": "d"})).await.expect(201);
    let csv = "time,id,x,y,w,h\n2020-12-14T06:41:48Z,a,0.1,0.1,0.1,0.1\n";
    let path = "/v1/cameras/d/samples?box_unit=share";
    let problem = server.send("POST", path, &CSV, csv).await.expect(422).json();
    assert_eq!(problem["violations"][0]["field"], "box_unit");
}

#[tokio::test]
async fn files_that_come_apart_are_mapped_too() {
    let (_folder, server) = with_camera().await;
    let detections = "T;ID;X1;Y1;X2;Y2\n1607928108;a;10;20;40;60\n1607928109;a;11;20;41;60\n";
    let fixes = "timestamp\tdevice\tlat\tlon\n1607928108\ta\t30\t103\n1607928109\ta\t30\t103,00001\n";
    let boundary = "----cut";
    let part = |name: &str, content: &str| {
        format!(
            "--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"{name}.csv\"\r\n\
             content-type: text/csv\r\n\r\n{content}\r\n"
        )
    };
    let body = format!("{}{}--{boundary}--\r\n", part("detections", detections), part("fixes", fixes));
    let content_type = format!("multipart/form-data; boundary={boundary}");
    let path = format!("{SAMPLES}/pairings?columns=auto");
    let report =
        server.send("POST", &path, &[("content-type", &content_type)], body).await.expect(200).json();
    assert_eq!((&report["accepted"], &report["rejected"]), (&json!(2), &json!(0)), "{report}");
    let stored = server.get(SAMPLES).await.expect(200).json();
    assert_eq!(stored["items"][0]["bounding_box"]["width_px"], 30.0);
    assert_eq!(stored["items"][1]["fix"]["longitude_deg"], 103.00001);

    // The command line pairs the same files.
    let files = data_folder();
    let path = |name: &str| files.path().join(name).to_str().expect("UTF-8").to_owned();
    std::fs::write(path("detections.csv"), detections).expect("a file");
    std::fs::write(path("fixes.csv"), fixes).expect("a file");
    let output = sightfix()
        .args(["pair", "--detections", &path("detections.csv"), "--fixes", &path("fixes.csv")])
        .args(["--columns", "auto", "--out", &path("samples.csv")])
        .output()
        .expect("the binary runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let written = std::fs::read_to_string(path("samples.csv")).expect("written");
    assert!(written.contains("2020-12-14T06:41:48Z,a,10,20,30,40,103.00000000,30.00000000"), "{written}");
}

/// A file whose lines are split into fields, or cannot be.
#[derive(Deserialize)]
struct LineCase {
    name: String,
    csv: String,
    /// Numbers of the lines that are read.
    accepted: Vec<u64>,
    rejected: Vec<RejectedLine>,
}

#[derive(Deserialize)]
struct RejectedLine {
    line: u64,
    reason: String,
}

#[tokio::test]
async fn a_server_splits_the_lines_of_each_case() {
    let (_folder, server) = with_camera().await;
    let cases: Vec<LineCase> =
        serde_json::from_str(include_str!("../cases/csv_lines.json")).expect("the cases");
    for case in cases {
        let path = format!("{SAMPLES}?on_conflict=replace");
        let report = server.send("POST", &path, &CSV, case.csv).await.expect(200).json();
        assert_eq!(report["accepted"], case.accepted.len(), "{}: {report}", case.name);
        let rejected = report["rejected_rows"].as_array().expect("rows").iter();
        let rejected: Vec<(u64, &str)> = rejected
            .map(|row| (row["line"].as_u64().expect("a number"), row["reason"].as_str().expect("text")))
            .collect();
        let expected: Vec<(u64, &str)> =
            case.rejected.iter().map(|row| (row.line, row.reason.as_str())).collect();
        assert_eq!(rejected, expected, "{}", case.name);
        server.send("DELETE", &format!("{SAMPLES}?target_id=a"), &[], "").await.expect(200);
    }
}

#[tokio::test]
async fn times_without_an_offset_are_local_times_of_the_zone_that_is_given() {
    let (_folder, server) = with_camera().await;
    let csv = "time,target_id,left,top,width,height,longitude,latitude\n\
               2026-07-01 10:00:00,a,1,2,30,40,11,48\n2026-10-25 02:30:00,a,1,2,30,40,11,48\n";
    let refused = server.send("POST", SAMPLES, &CSV, csv).await.expect(200).json();
    assert_eq!(refused["rejected"], 2, "{refused}");
    let path = format!("{SAMPLES}?timezone=Europe/Berlin");
    let report = server.send("POST", &path, &CSV, csv).await.expect(200).json();
    assert_eq!(
        (&report["accepted"], &report["rejected_rows"][0]["line"]),
        (&json!(1), &json!(3)),
        "{report}"
    );
    let reason = report["rejected_rows"][0]["reason"].as_str().expect("a reason");
    assert!(reason.contains("has it twice"), "{reason}");
    let stored = server.get(SAMPLES).await.expect(200).json();
    assert_eq!(stored["items"][0]["time"], "2026-07-01T08:00:00Z");
    let path = format!("{SAMPLES}?timezone=Mars");
    let problem = server.send("POST", &path, &CSV, csv).await.expect(422).json();
    assert_eq!(problem["violations"][0]["field"], "timezone");
}
