//! Pairing of separate detections and fixes, by the command line and over REST.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::harness::{Answer, TestServer, data_folder, run, shared, sightfix};

/// A sample as numbers, whatever the columns' order and the clock's zone.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    time: jiff::Timestamp,
    target_id: String,
    numbers: [f64; 6],
}

const SIDES: [&str; 4] = ["left", "top", "width", "height"];

fn rows(csv: &str) -> Vec<Row> {
    let mut reader = csv::Reader::from_reader(csv.as_bytes());
    let header = reader.headers().expect("a header").clone();
    let column = |name: &str| header.iter().position(|given| given == name).expect("the column");
    let (time, target) = (column("time"), column("target_id"));
    let numbers = [SIDES[0], SIDES[1], SIDES[2], SIDES[3], "longitude", "latitude"].map(column);
    let row = |record: csv::StringRecord| Row {
        time: record[time].parse().expect("a time"),
        target_id: record[target].to_owned(),
        numbers: numbers.map(|at| record[at].parse().expect("a number")),
    };
    reader.records().map(|record| row(record.expect("a row"))).collect()
}

/// A recording in a folder: samples, and the same as separate detections and fixes.
struct Recording {
    folder: TempDir,
    samples: Vec<Row>,
    detections: String,
    /// `time,receiver_id,longitude,latitude`; the receiver of `target` is `receiver-of-target`.
    fixes: String,
}

impl Recording {
    /// The output of `sightfix simulate`, split into two files.
    fn simulated(targets: &str, samples: &str) -> Self {
        let folder = data_folder();
        let path = folder.path().join("simulated.csv");
        let out = path.to_str().expect("UTF-8");
        run(&["simulate", "square", "--out", out, "--samples", samples, "--targets", targets]);
        let samples = rows(&std::fs::read_to_string(&path).expect("written"));
        let mut detections = "target_id,time,left,top,width,height\n".to_owned();
        let mut fixes = "time,receiver_id,longitude,latitude\n".to_owned();
        for Row { time, target_id, numbers: [left, top, width, height, longitude, latitude] } in &samples {
            writeln!(detections, "{target_id},{time},{left},{top},{width},{height}").expect("memory");
            writeln!(fixes, "{time},receiver-of-{target_id},{longitude},{latitude}").expect("memory");
        }
        assert!(samples.len() > 100);
        Self { folder, samples, detections, fixes }
    }

    fn targets(&self) -> Vec<String> {
        let mut targets: Vec<String> = self.samples.iter().map(|row| row.target_id.clone()).collect();
        targets.sort();
        targets.dedup();
        targets
    }

    /// Fixes without a receiver, by a clock that is late.
    fn anonymous_fixes(&self, late_s: f64) -> Vec<(jiff::Timestamp, f64, f64)> {
        let late = jiff::SignedDuration::from_secs_f64(late_s);
        self.samples.iter().map(|row| (row.time + late, row.numbers[4], row.numbers[5])).collect()
    }

    fn write(&self, name: &str, text: impl AsRef<[u8]>) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, text).expect("written");
        path
    }

    /// Runs `sightfix pair`; returns what it prints and the rows that it writes.
    fn pair(&self, fixes: &Path, flags: &[&str]) -> (String, Vec<Row>) {
        let detections = self.write("detections.csv", &self.detections);
        pair(&detections, fixes, &self.folder.path().join("paired.csv"), flags)
    }
}

fn pair(detections: &Path, fixes: &Path, out: &Path, flags: &[&str]) -> (String, Vec<Row>) {
    let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let files = [text(detections), text(fixes), text(out)];
    let mut arguments =
        vec!["pair", "--detections", &files[0], "--fixes", &files[1], "--out", &files[2], "--overwrite"];
    arguments.extend_from_slice(flags);
    let printed = run(&arguments);
    (printed, rows(&std::fs::read_to_string(out).expect("written")))
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_files_are_paired_to_the_paired_file() {
    let [detections, fixes, paired] =
        ["square/detections.csv", "square/gnss.csv", "square/training.csv"].map(shared);
    let folder = data_folder();
    let out = folder.path().join("paired.csv");
    let (printed, found) = pair(&detections, &fixes, &out, &["--estimate-offset"]);
    assert!(found == rows(&std::fs::read_to_string(paired).expect("readable")), "{printed}");
    for part in [
        "fixes that name no receiver are those of person-1",
        "clock offset of person-1",
        "paired 10078 of 10425 detections and 11270 fixes",
        "no fix near in time 347,",
        "no box to take it 1192,",
    ] {
        assert!(printed.contains(part), "{part} is missing in: {printed}");
    }
    // The import accepts the paired samples.
    let data = folder.path().join("data");
    let (data, out) = (data.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let printed = run(&["import", out, "--camera", "square", "--create", "--data", data]);
    assert!(printed.contains("accepted 10078 (without a fix 0), duplicate 0, rejected 0"), "{printed}");
}

#[test]
fn simulated_files_are_paired_to_the_file_they_come_from() {
    let recording = Recording::simulated("3", "1500");
    let fixes = recording.write("fixes.csv", &recording.fixes);
    let bindings: Vec<String> =
        recording.targets().iter().map(|target| format!("receiver-of-{target}={target}")).collect();
    assert_eq!(bindings.len(), 3);
    let flags: Vec<&str> = bindings.iter().flat_map(|binding| ["--receiver", binding]).collect();
    for method in ["nearest", "interpolate"] {
        let (printed, found) = recording.pair(&fixes, &[&flags[..], &["--method", method]].concat());
        assert!(found == recording.samples, "{method}: {printed}");
    }
    // Without the bindings no target carries the receivers.
    let detections = recording.folder.path().join("detections.csv");
    let out = recording.folder.path().join("none.csv");
    let output = sightfix()
        .args(["pair", "--detections"])
        .arg(detections)
        .arg("--fixes")
        .arg(fixes)
        .arg("--out")
        .arg(&out)
        .output();
    let output = output.expect("the binary runs");
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(!output.status.success() && !out.exists(), "{printed}");
    assert!(printed.contains(&format!("no fix of the target {},", recording.samples.len())), "{printed}");
}

/// `ddmm.mmmmmmm` and its hemisphere.
fn nmea_degrees(degrees: f64, width: usize, hemispheres: [char; 2]) -> String {
    let (whole, minutes) = (degrees.abs().floor(), degrees.abs().fract() * 60.0);
    let hemisphere = hemispheres[usize::from(degrees < 0.0)];
    format!("{whole:0width$.0}{minutes:010.7},{hemisphere}")
}

fn nmea(fixes: &[(jiff::Timestamp, f64, f64)]) -> String {
    let mut log = String::new();
    let mut say = |body: String| {
        let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        writeln!(log, "${body}*{sum:02X}\r").expect("memory");
    };
    for (time, longitude, latitude) in fixes {
        let place =
            format!("{},{}", nmea_degrees(*latitude, 2, ['N', 'S']), nmea_degrees(*longitude, 3, ['E', 'W']));
        let (clock, date) = (time.strftime("%H%M%S.00"), time.strftime("%d%m%y"));
        say(format!("GPGGA,{clock},{place},1,08,1.0,500.0,M,0.0,M,,"));
        say(format!("GPRMC,{clock},A,{place},0.0,0.0,{date},,,A"));
    }
    log
}

fn gpx(fixes: &[(jiff::Timestamp, f64, f64)]) -> String {
    let mut text =
        "<?xml version=\"1.0\"?>\n<gpx version=\"1.1\" creator=\"test\"><trk><trkseg>\n".to_owned();
    for (time, longitude, latitude) in fixes {
        let tag = format!("<trkpt lat=\"{latitude}\" lon=\"{longitude}\"><time>{time}</time></trkpt>");
        writeln!(text, "{tag}").expect("memory");
    }
    text + "</trkseg></trk></gpx>\n"
}

fn gpsd(fixes: &[(jiff::Timestamp, f64, f64)]) -> String {
    let report = |(time, longitude, latitude): &(jiff::Timestamp, f64, f64)| {
        json!({
            "class": "TPV", "device": "/dev/ttyUSB0", "mode": 3, "time": time.to_string(), "lat": latitude,
            "lon": longitude, "eph": 3.1,
        })
    };
    let mut log = "{\"class\":\"VERSION\",\"release\":\"3.25\"}\n".to_owned();
    for fix in fixes {
        writeln!(log, "{}", report(fix)).expect("memory");
    }
    log
}

/// An activity with one definition and a record per fix.
fn fit(fixes: &[(jiff::Timestamp, f64, f64)]) -> Vec<u8> {
    let mut messages = vec![0x40, 0, 0, 20, 0, 3, 253, 4, 0x86, 0, 4, 0x85, 1, 4, 0x85];
    for (time, longitude, latitude) in fixes {
        let second = u32::try_from(time.as_second() - 631_065_600).expect("after 1989");
        let semicircles =
            [latitude, longitude].map(|degrees| (degrees / 180.0 * 2_147_483_648.0).round() as i32);
        messages.push(0);
        messages.extend(
            second.to_le_bytes().into_iter().chain(semicircles.into_iter().flat_map(i32::to_le_bytes)),
        );
    }
    let mut file = vec![12, 0x10, 0, 0];
    file.extend(
        u32::try_from(messages.len()).expect("short").to_le_bytes().iter().chain(b".FIT").chain(&messages),
    );
    let checksum = file.iter().fold(0_u16, |sum, byte| {
        (0..8).fold(sum ^ u16::from(*byte), |sum, _| if sum & 1 == 1 { sum >> 1 ^ 0xA001 } else { sum >> 1 })
    });
    file.extend(checksum.to_le_bytes());
    file
}

fn gnss_logger(fixes: &[(jiff::Timestamp, f64, f64)]) -> String {
    let mut log =
        "# Header Description:\n# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,\
        AccuracyMeters,BearingDegrees,UnixTimeMillis\n"
            .to_owned();
    for (time, longitude, latitude) in fixes {
        let millisecond = time.as_millisecond();
        writeln!(log, "Fix,GPS,{latitude},{longitude},500.0,1.1,3.8,20.0,{millisecond}").expect("memory");
        writeln!(log, "Fix,NLP,{latitude},{longitude},,,400.0,,{millisecond}").expect("memory");
    }
    log
}

#[test]
fn every_format_of_fixes_gives_the_same_samples() {
    let recording = Recording::simulated("1", "400");
    let fixes = recording.anonymous_fixes(0.0);
    for (name, text, flags) in [
        ("fixes.nmea", nmea(&fixes).into_bytes(), &[][..]),
        ("fixes.gpx", gpx(&fixes).into_bytes(), &[]),
        ("fixes.json", gpsd(&fixes).into_bytes(), &[]),
        ("fixes.dat", gpsd(&fixes).into_bytes(), &["--fixes-format", "gpsd"]),
        ("fixes.fit", fit(&fixes), &[]),
        ("gnss_log.txt", gnss_logger(&fixes).into_bytes(), &[]),
    ] {
        let (printed, found) = recording.pair(&recording.write(name, &text), flags);
        assert_eq!(found.len(), recording.samples.len(), "{name}: {printed}");
        for (found, expected) in found.iter().zip(&recording.samples) {
            assert_eq!((found.time, &found.target_id), (expected.time, &expected.target_id), "{name}");
            for (one, other) in found.numbers.iter().zip(expected.numbers) {
                // Half of the unit of FIT is 4.2e-8 degrees.
                assert!((one - other).abs() < 5e-8, "{name}: {found:?} is not {expected:?}");
            }
        }
    }
}

#[test]
fn an_estimated_offset_is_printed_and_applied_only_on_request() {
    let recording = Recording::simulated("1", "3000");
    let fixes = recording.write("fixes.gpx", &gpx(&recording.anonymous_fixes(4.0)));
    let offset_s = |printed: &str| -> f64 {
        let line = printed.lines().find(|line| line.starts_with("clock offset of")).expect("an estimate");
        let seconds = line.split(": ").nth(1).and_then(|rest| rest.split(" s").next()).expect("a number");
        seconds.parse().unwrap_or_else(|_| panic!("{line}"))
    };
    let (printed, unshifted) = recording.pair(&fixes, &["--estimate-offset"]);
    assert!((offset_s(&printed) + 4.0).abs() < 0.5, "{printed}");
    assert!(unshifted != recording.samples, "printed, not applied");
    let (printed, applied) = recording.pair(&fixes, &["--estimate-offset", "--apply-offset"]);
    assert!(applied == recording.samples, "{printed}");
    // The same by hand: anonymous fixes are those of the only target.
    let given = format!("{}=-4", recording.targets()[0]);
    let (printed, given) = recording.pair(&fixes, &["--clock-offset", &given]);
    assert!(given == recording.samples, "{printed}");
}

#[test]
fn invalid_flags_and_files_are_reported() {
    let recording = Recording::simulated("2", "300");
    let detections = recording.write("detections.csv", &recording.detections);
    let bad = recording.write("bad.csv", "time,longitude\n");
    let fixes = recording.write("fixes.csv", &recording.fixes);
    let dat = recording.write("fixes.dat", "");
    for (fixes, flags, reason) in [
        (&bad, &[][..], "fixes"),
        (&dat, &[], "--fixes-format"),
        (&fixes, &["--window-s", "0"], "window_s"),
        (&fixes, &["--method", "best"], "nearest"),
        (&fixes, &["--receiver", "a"], "RECEIVER=TARGET"),
        (&fixes, &["--clock-offset", "a=1e9"], "clock_offset_s"),
        (&fixes, &["--receiver", "a=b", "--receiver", "a=c"], "duplicate"),
        (&fixes, &["--apply-offset"], "--estimate-offset"),
    ] {
        let out = recording.folder.path().join("out.csv");
        let mut command = sightfix();
        command.arg("pair").arg("--detections").arg(&detections).arg("--fixes").arg(fixes);
        let output = command.arg("--out").arg(&out).args(flags).output().expect("the binary runs");
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && printed.contains(reason), "{flags:?}: {printed}");
    }
}

const BOUNDARY: &str = "a-boundary-of-its-own";

/// Parts of a form: name, file name, content type and content.
fn form(parts: &[(&str, &str, &str, &str)]) -> String {
    let mut body = "an ignored preamble\r\n".to_owned();
    for (name, file, content_type, content) in parts {
        write!(body, "--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"{name}\"").expect("memory");
        if !file.is_empty() {
            write!(body, "; filename=\"{file}\"").expect("memory");
        }
        if !content_type.is_empty() {
            write!(body, "\r\ncontent-type: {content_type}").expect("memory");
        }
        write!(body, "\r\n\r\n{content}\r\n").expect("memory");
    }
    body + &format!("--{BOUNDARY}--\r\n")
}

async fn post(server: &TestServer, query: &str, body: String) -> Answer {
    let content_type = format!("multipart/form-data; boundary={BOUNDARY}");
    let path = format!("/v1/cameras/c/samples/pairings{query}");
    server.send("POST", &path, &[("content-type", &content_type)], body).await
}

async fn stored(server: &TestServer) -> Vec<Row> {
    let exported = server.send("GET", "/v1/cameras/c/samples", &[("accept", "text/csv")], "").await;
    rows(&exported.expect(200).text())
}

/// A folder of labels per frame, of which the third has no box, as a tracker of Ultralytics leaves it.
#[test]
fn labels_of_yolo_are_paired_by_the_number_in_their_names() {
    let folder = data_folder();
    let labels = folder.path().join("labels");
    std::fs::create_dir(&labels).expect("a folder");
    for (name, lines) in [
        ("gate_1.txt", "0 0.5 0.5 0.1 0.2 7\n"),
        ("gate_2.txt", "0 0.25 0.5 0.1 0.2 7\n0 0.5 0.5 0.1 0.2\n"),
        ("gate_10.txt", "0 0.75 0.5 0.1 0.2 7\n"),
        ("notes.md", ""),
    ] {
        std::fs::write(labels.join(name), lines).expect("a file can be written");
    }
    let fixes = folder.path().join("fixes.csv");
    let times = ["00", "01", "09"].map(|second| format!("2025-06-01T12:00:{second}Z,phone,103.98,30.62"));
    std::fs::write(&fixes, format!("time,receiver_id,longitude,latitude\n{}\n", times.join("\n")))
        .expect("written");
    let flags = ["--detections-format", "yolo", "--frame-rate", "1", "--start-time", "2025-06-01T12:00:00Z"];
    let flags = [&flags[..], &["--image-size", "1000x500", "--receiver", "phone=7"]].concat();
    let (printed, rows) = pair(&labels, &fixes, &folder.path().join("out.csv"), &flags);
    let lefts: Vec<f64> = rows.iter().map(|row| row.numbers[0].round()).collect();
    assert_eq!(lefts, [450.0, 200.0, 700.0], "{printed}");
    assert!(printed.contains("rejected rows 1"), "{printed}");
}

#[tokio::test]
async fn two_parts_are_paired_by_the_receivers_of_the_profile() {
    let recording = Recording::simulated("3", "1500");
    let receivers: Vec<Value> = recording
        .targets()
        .iter()
        .map(|target| {
            json!({"receiver_id": format!("receiver-of-{target}"), "target_id": target, "clock_offset_s": -2.25})
        })
        .collect();
    // All clocks are late; spooled in memory and on disk.
    let late = jiff::SignedDuration::from_millis(2_250);
    let mut fixes = "time,receiver_id,longitude,latitude\nnever,x,1,2\n".to_owned();
    for row in &recording.samples {
        let [.., longitude, latitude] = row.numbers;
        writeln!(fixes, "{},receiver-of-{},{longitude},{latitude}", row.time + late, row.target_id)
            .expect("memory");
    }
    for memory_bytes in ["10000", "10000000"] {
        let folder = data_folder();
        let server =
            TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__IMPORT_MEMORY_BYTES", memory_bytes)]);
        server.post("/v1/cameras", &json!({"id": "c", "receivers": receivers})).await.expect(201);
        let octets = "application/octet-stream";
        let body = form(&[
            ("fixes", "F.csv", octets, &fixes),
            ("detections", "", "text/csv", &recording.detections),
        ]);
        let report = post(&server, "", body.clone()).await.expect(200).json();
        let count = recording.samples.len();
        assert_eq!(report["accepted"], count, "{report}");
        assert_eq!(
            (&report["pairing"]["paired"], &report["rejected"]),
            (&json!(count), &json!(1)),
            "{report}"
        );
        let row = &report["rejected_rows"][0];
        assert_eq!((&row["part"], &row["line"], &row["field"]), (&json!("fixes"), &json!(2), &json!("time")));
        assert!(stored(&server).await == recording.samples);
        let again = post(&server, "", body).await.expect(200).json();
        assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(count)), "{again}");
    }
}

#[tokio::test]
async fn two_parts_without_receivers_are_paired_by_the_parameters() {
    let recording = Recording::simulated("1", "3000");
    let target = &recording.targets()[0];
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let fixes = gpx(&recording.anonymous_fixes(4.0));
    let body = form(&[
        ("detections", "D.csv", "", &recording.detections),
        ("fixes", "F.xml", "application/gpx+xml", &fixes),
    ]);
    let query = "?estimate_offset=true&window_s=0.2&receiver_id=phone";
    let report = post(&server, query, body.clone()).await.expect(200).json();
    assert_eq!(report["pairing"]["paired"], 0, "phone is nobody's: {report}");
    assert_eq!(report["unnamed_fixes_of"]["target_id"], "phone", "{report}");
    assert_eq!(report["clock_offsets"][0]["clock_offset_s"], Value::Null, "{report}");
    let nobody = report["pairing"]["unpaired_detections"]["no_fix_of_target"].as_u64();
    assert_eq!(nobody, Some(recording.samples.len() as u64), "{report}");

    let report = post(&server, "?estimate_offset=true", body.clone()).await.expect(200).json();
    let offset_s = report["clock_offsets"][0]["clock_offset_s"].as_f64().expect("an estimate");
    assert!((offset_s + 4.0).abs() < 0.5, "{report}");
    server.send("DELETE", &format!("/v1/cameras/c/samples?target_id={target}"), &[], "").await.expect(200);

    let receivers =
        json!([{"receiver_id": "phone", "target_id": target, "clock_offset_s": offset_s.round()}]);
    let change = json!({ "receivers": receivers }).to_string();
    let headers = [("content-type", "application/json"), ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/c", &headers, change).await.expect(200);
    let report = post(&server, "", body).await.expect(200).json();
    assert_eq!(report["accepted"], recording.samples.len(), "{report}");
    assert!(stored(&server).await == recording.samples);
}

#[tokio::test]
#[ignore = "needs ../shared/data"]
async fn shared_files_are_paired_over_rest() {
    let [detections, fixes, paired] =
        ["square/detections.csv", "square/gnss.csv", "square/training.csv"].map(shared);
    let read = |path: PathBuf| std::fs::read_to_string(path).expect("readable");
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let body =
        form(&[("detections", "D.csv", "", &read(detections)), ("fixes", "F.csv", "text/csv", &read(fixes))]);
    let report = post(&server, "", body).await.expect(200).json();
    assert_eq!((&report["accepted"], &report["rejected"]), (&json!(10_078), &json!(0)), "{report}");
    assert_eq!(report["pairing"]["unpaired_detections"]["no_fix_near"], 347, "{report}");
    assert_eq!(report["pairing"]["unused_fixes"]["no_box_near"], 1_192, "{report}");
    assert!(stored(&server).await == rows(&read(paired)));
}

#[tokio::test]
async fn invalid_parts_are_refused_by_name_and_store_nothing() {
    let folder = data_folder();
    let limits = [("SIGHTFIX_LIMITS__PAIRING_ROWS", "10"), ("SIGHTFIX_LIMITS__IMPORT_BYTES", "2000000")];
    let server = TestServer::start_with(folder.path(), &limits);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let box_row = "2026-01-01T00:00:00Z,a,1,2,3,4\n";
    let detections = format!("time,target_id,left,top,width,height\n{box_row}");
    let fix_header = "time,longitude,latitude\n";
    let fixes = format!("{fix_header}2026-01-01T00:00:00Z,8,47\n");
    let many = format!("{fix_header}{}", "2026-01-01T00:00:00Z,8,47\n".repeat(11));
    let (d, f) = (("detections", "D.csv", "", &*detections), ("fixes", "F.csv", "", &*fixes));
    let long_head = format!("--{BOUNDARY}\r\nx-long: {}\r\n\r\n", "x".repeat(1_500_000));
    for (query, body, status, kind, field) in [
        ("", form(&[d]), 422, "invalid-argument", "fixes"),
        ("", form(&[d, f, d]), 422, "invalid-argument", "detections"),
        ("", form(&[d, ("boxes", "", "", "")]), 422, "invalid-argument", "boxes"),
        ("", form(&[d, ("fixes", "F.doc", "", "")]), 415, "unsupported-media-type", "fixes"),
        ("", form(&[d, ("fixes", "", "", "")]), 415, "unsupported-media-type", "fixes"),
        ("", form(&[("detections", "D.geojson", "", "{}"), f]), 415, "unsupported-media-type", "detections"),
        ("", form(&[d, ("fixes", "F.csv", "", "time,longitude\n")]), 400, "malformed-body", "fixes.latitude"),
        ("", form(&[d, ("fixes", "F.gpx", "", "<kml/>")]), 400, "malformed-body", ""),
        ("", form(&[d, ("fixes", "F.csv", "", &many)]), 413, "too-large", "fixes"),
        ("", form(&[d, f]).replace(&format!("--{BOUNDARY}--"), ""), 400, "malformed-body", ""),
        ("", "no form at all".to_owned(), 400, "malformed-body", ""),
        ("", long_head, 400, "malformed-body", ""),
        ("", form(&[d, ("fixes", "F.csv", "", &" ".repeat(2_000_000))]), 413, "too-large", ""),
        ("?method=best", form(&[d, f]), 422, "invalid-argument", "method"),
        ("?window_s=-1", form(&[d, f]), 422, "invalid-argument", "window_s"),
        ("?longest_gap_s=x", form(&[d, f]), 422, "invalid-argument", "longest_gap_s"),
        ("?estimate_offset=1", form(&[d, f]), 422, "invalid-argument", "estimate_offset"),
        ("?receiver_id=", form(&[d, f]), 422, "invalid-argument", "receiver_id"),
        ("?window=1", form(&[d, f]), 422, "invalid-argument", "window"),
    ] {
        let request = format!("{query} {body:.400}");
        let answer = post(&server, query, body).await;
        assert_eq!(answer.status.as_u16(), status, "{request}: {}", answer.text());
        let problem = answer.json();
        assert!(problem["type"].as_str().is_some_and(|name| name.ends_with(kind)), "{request}: {problem}");
        let named = problem["violations"][0]["field"].as_str().unwrap_or_default();
        assert_eq!(named, field, "{request}: {problem}");
    }
    let csv = server.send(
        "POST",
        "/v1/cameras/c/samples/pairings",
        &[("content-type", "text/csv")],
        detections.clone(),
    );
    csv.await.expect(415);
    let count = server.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 0, "refused parts stored samples");
    let report = post(&server, "", form(&[d, f])).await.expect(200).json();
    assert_eq!(
        (&report["accepted"], &report["unnamed_fixes_of"]["target_id"]),
        (&json!(1), &json!("a")),
        "{report}"
    );
    let body = form(&[d, f]);
    let content_type = format!("multipart/form-data; boundary={BOUNDARY}");
    let headers = [("content-type", &*content_type)];
    server.send("POST", "/v1/cameras/none/samples/pairings", &headers, body).await.expect(404);
}
