//! Boxes with only a tracker's ids against a running server: matched live, and in an import.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::json;
use sightfix::grpc::proto;

use super::crowd::{Crowd, Recorded};
use crate::harness::{TestServer, data_folder};
use crate::live_client::{Client, channel, open, time, yard};

/// Walkers of whom two carry phones.
const LIVE: Crowd =
    Crowd { seed: 4, walkers: 5, phones: 2, seconds: 200, lifetime_s: f64::INFINITY, swap_s: f64::INFINITY };
/// Recorded time that is sent before the matches are looked at, s.
const SENT_FIRST_S: f64 = 100.0;

/// A row of a recording: a box with its walker, or a fix.
struct Row {
    time: Timestamp,
    id: String,
    walker: Option<usize>,
    numbers: Vec<f64>,
}

/// Boxes and fixes in the order of their times.
fn rows(recorded: &Recorded) -> Vec<Row> {
    let row = |line: &str, walker: Option<usize>| {
        let cells: Vec<&str> = line.split(',').collect();
        let numbers = cells[2..].iter().filter_map(|cell| cell.parse().ok()).collect();
        Row { time: cells[0].parse().expect("a time"), id: cells[1].to_owned(), walker, numbers }
    };
    let boxes = recorded.detections.lines().skip(1).zip(&recorded.walkers);
    let mut rows: Vec<Row> = boxes.map(|(line, walker)| row(line, Some(*walker))).collect();
    rows.extend(recorded.fixes.lines().skip(1).map(|line| row(line, None)));
    rows.sort_by_key(|row| row.time);
    rows
}

/// Samples of the same square in which everybody carries a phone and the carriers are known.
fn training_csv() -> String {
    let recorded = Crowd { phones: LIVE.walkers, seconds: 300, ..LIVE }.recorded();
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    let mut boxes: BTreeMap<usize, Row> = BTreeMap::new();
    for row in rows(&recorded) {
        match row.walker {
            Some(walker) => drop(boxes.insert(walker, row)),
            None => {
                let walker: usize = row.id.trim_start_matches("phone-").parse().expect("a number");
                // A fix comes 0.2 s after a frame.
                let Some(seen) = boxes.get(&walker) else { continue };
                if row.time.duration_since(seen.time) < SignedDuration::from_millis(400) {
                    let [left, top, width, height] = seen.numbers[..] else { panic!("a box") };
                    let [longitude, latitude] = row.numbers[..] else { panic!("a fix") };
                    writeln!(
                        csv,
                        "{},w{walker},{left},{top},{width},{height},{longitude},{latitude}",
                        seen.time
                    )
                    .expect("memory");
                }
            }
        }
    }
    csv
}

async fn trained_yard(folder: &std::path::Path) -> TestServer {
    let server = yard(folder, &[], json!({}), false).await;
    let kind = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/yard/samples", &kind, training_csv()).await.expect(200);
    let run = server.train("yard", &json!({"recipe": "gaussian_process"})).await;
    assert_eq!(run["state"], "succeeded", "{run}");
    server
}

fn item(row: &Row, shift: SignedDuration) -> proto::StreamItem {
    let time = time(row.time + shift);
    match (row.walker, &row.numbers[..]) {
        (Some(_), &[left_px, top_px, width_px, height_px]) => proto::StreamItem {
            time,
            tracker_id: Some(row.id.clone()),
            bounding_box: Some(proto::BoundingBox { left_px, top_px, width_px, height_px }),
            ..Default::default()
        },
        (None, &[longitude_deg, latitude_deg]) => proto::StreamItem {
            time,
            receiver_id: Some(row.id.clone()),
            fix: Some(proto::Fix {
                longitude_deg: Some(longitude_deg),
                latitude_deg: Some(latitude_deg),
                sigma_m: None,
            }),
            ..Default::default()
        },
        (_, numbers) => panic!("{numbers:?}"),
    }
}

/// Sends a row and returns the answer to it.
async fn sent(client: &mut Client, row: &Row, shift: SignedDuration) -> proto::StreamAnswer {
    let seq = client.item(item(row, shift)).await;
    let answer = client.answer().await;
    assert_eq!(answer.seq, seq);
    answer
}

#[tokio::test]
async fn boxes_of_a_stream_are_matched_with_the_receivers_beside_them() {
    let folder = data_folder();
    let server = trained_yard(folder.path()).await;
    let mut client = open(&channel(&server).await, "edge", true).await;
    let rows = rows(&LIVE.recorded());
    let (first, last) = (rows[0].time, rows.last().expect("rows").time);
    let shift = Timestamp::now().duration_since(last);
    let (mut matched, mut wrong, mut unmatched_carriers) = (0, 0, 0);
    let mut second = 0;
    for row in &rows {
        let sent_s = row.time.duration_since(first).as_secs_f64();
        // Matching goes on beside the stream, at most once a second.
        if sent_s > SENT_FIRST_S && sent_s as i64 > second {
            second = sent_s as i64;
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        let answer = sent(&mut client, row, shift).await;
        let Some(walker) = row.walker else {
            assert!(answer.receiver_match.is_none(), "{answer:?}");
            continue;
        };
        let target = answer.track.as_ref().map(|track| track.target_id.as_str());
        match &answer.receiver_match {
            Some(found) => {
                assert!(found.probability >= 0.6 && target == Some(&found.receiver_id), "{answer:?}");
                matched += 1;
                wrong += usize::from(found.receiver_id != format!("phone-{walker}"));
            }
            None => {
                assert_eq!(target, Some(row.id.as_str()), "{answer:?}");
                unmatched_carriers += usize::from(walker < LIVE.phones && sent_s > SENT_FIRST_S + 20.0);
            }
        }
    }
    println!("{matched} boxes matched, {wrong} wrong, {unmatched_carriers} of carriers not matched");
    assert!(matched > 100 && wrong * 20 <= matched, "{matched} matched, {wrong} wrong");
    let (acknowledgement, _, ended) = client.finish_with_counts().await;
    assert!(ended.is_none(), "{ended:?}");
    let acknowledgement = acknowledgement.expect("the stream stores samples");
    let reason = i32::from(proto::not_stored::Reason::Unmatched);
    let unmatched = acknowledgement.not_stored.iter().find(|own| own.reason == reason);
    assert!(unmatched.is_some_and(|own| own.count > 100), "{acknowledgement:?}");
    assert!(acknowledgement.stored > 50, "{acknowledgement:?}");
    // Only sure boxes are stored, under the receiver's id.
    let stored =
        server.send("GET", "/v1/cameras/yard/samples?limit=1000", &[("accept", "text/csv")], "").await;
    let stored = stored.expect(200).text();
    let live = stored.lines().skip(1).filter(|line| !line.contains(",w"));
    assert!(live.clone().count() > 20 && live.clone().all(|line| line.contains(",phone-")), "{stored}");
}

#[tokio::test]
async fn a_tracker_id_beside_a_target_is_refused() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let bounding_box = json!({"left_px": 10.0, "top_px": 10.0, "width_px": 30.0, "height_px": 80.0});
    let time = Timestamp::now();
    let both = json!({"time": time, "target_id": "a", "tracker_id": "7", "bounding_box": bounding_box});
    let problem = server.post("/v1/cameras/yard/tracks", &both).await.expect(422).json();
    assert!(problem.to_string().contains("tracker_id"), "{problem}");
    // Without a model nothing can be matched; the box is taken.
    let anonymous = json!({"time": time, "tracker_id": "7", "bounding_box": bounding_box});
    let taken = server.post("/v1/cameras/yard/tracks", &anonymous).await.expect(200).json();
    assert!(taken["items"][0]["receiver_match"].is_null(), "{taken}");
}

fn multipart(recorded: &Recorded) -> (String, String) {
    const BOUNDARY: &str = "a-boundary";
    let mut body = String::new();
    for (name, content) in [("detections", &recorded.detections), ("fixes", &recorded.fixes)] {
        write!(
            body,
            "--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"{name}.csv\"\r\n\
             content-type: text/csv\r\n\r\n{content}\r\n"
        )
        .expect("memory");
    }
    (format!("multipart/form-data; boundary={BOUNDARY}"), body + &format!("--{BOUNDARY}--\r\n"))
}

#[tokio::test]
async fn an_import_matches_trackers_ids_with_receivers() {
    const PATH: &str = "/v1/cameras/yard/samples/pairings?match=true&method=interpolate";
    let folder = data_folder();
    let server = trained_yard(folder.path()).await;
    let recorded = LIVE.recorded();
    let (content_type, body) = multipart(&recorded);
    let kind = [("content-type", content_type.as_str())];
    let before = server.get("/v1/cameras/yard").await.expect(200).json();
    let report = server.send("POST", PATH, &kind, body.clone()).await.expect(200).json();
    let exported =
        server.send("GET", "/v1/cameras/yard/samples?limit=1000", &[("accept", "text/csv")], "").await;
    let exported = exported.expect(200).text();
    let walkers: BTreeMap<Timestamp, Vec<(String, usize)>> = rows(&recorded)
        .into_iter()
        .filter_map(|row| Some((row.time, (format!("{:.2}", row.numbers[0]), row.walker?))))
        .fold(BTreeMap::new(), |mut all, (time, own)| {
            all.entry(time).or_insert_with(Vec::new).push(own);
            all
        });
    let mut reader = csv::Reader::from_reader(exported.as_bytes());
    let header = reader.headers().expect("a header").clone();
    let column = |name: &str| header.iter().position(|given| given == name).expect("the column");
    let columns = ["time", "target_id", "left"].map(column);
    let (mut right, mut all) = (0, 0);
    for row in reader.records() {
        let row = row.expect("a row");
        let [time, target, left] = columns.map(|at| &row[at]);
        if !target.starts_with("phone-") {
            continue;
        }
        let left: f64 = left.parse().expect("a number");
        let boxes = &walkers[&time.parse::<Timestamp>().expect("a time")];
        let walker = boxes.iter().find(|own| own.0 == format!("{left:.2}")).expect("its box").1;
        all += 1;
        right += usize::from(target == format!("phone-{walker}"));
    }
    println!("{right} of {all} samples right: {report}");
    assert!(all > 100 && right * 20 >= all * 19, "{right} of {all}: {report}");
    // The same again stores nothing new; a recording that tells nothing stores nothing at all.
    let again = server.send("POST", PATH, &kind, body).await.expect(200).json();
    assert!(again["samples"]["duplicates"].as_u64().is_none_or(|count| count > 0), "{again} {before}");
}

#[tokio::test]
async fn an_import_that_tells_nothing_is_refused_and_stores_nothing() {
    const PATH: &str = "/v1/cameras/yard/samples/pairings?match=true";
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let (content_type, body) = multipart(&Crowd { seconds: 20, ..LIVE }.recorded());
    let kind = [("content-type", content_type.as_str())];
    let problem = server.send("POST", PATH, &kind, body).await.expect(422).json();
    assert!(problem["type"].as_str().is_some_and(|own| own.contains("not-identifiable")), "{problem}");
    let stored = server.get("/v1/cameras/yard/samples").await.expect(200).json();
    assert_eq!(stored["items"].as_array().map(Vec::len), Some(0), "{stored}");
}
