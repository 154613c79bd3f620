//! Boxes with only a tracker's ids against a running server: matched live, and in an import.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use sightfix::grpc::proto;

use super::crowd::{Crowd, Recorded};
use crate::harness::{TestServer, data_folder, now};
use crate::live_client::{Client, channel, open, time, yard};

/// Walkers of whom two carry phones.
const LIVE: Crowd =
    Crowd { seed: 4, walkers: 5, phones: 2, seconds: 200, lifetime_s: f64::INFINITY, swap_s: f64::INFINITY };
/// Recorded time that is sent before the matches are looked at, s.
const SENT_FIRST_S: f64 = 100.0;

/// A row of a recording: a box with its walker, or a fix.
pub(super) struct Row {
    pub(super) time: Timestamp,
    pub(super) id: String,
    pub(super) walker: Option<usize>,
    pub(super) numbers: Vec<f64>,
}

/// Boxes and fixes in the order of their times.
pub(super) fn rows(recorded: &Recorded) -> Vec<Row> {
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

/// The same as a camera of the site `square`.
async fn trained_yard_of_site(folder: &std::path::Path) -> TestServer {
    let server = trained_yard(folder).await;
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    let headers = [("content-type", "application/json"), ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/yard", &headers, r#"{"site": "square"}"#).await.expect(200);
    server
}

fn item(row: &Row, shift: SignedDuration) -> proto::StreamItem {
    let time = time(row.time + shift);
    match (row.walker, &row.numbers[..]) {
        (Some(_), &[left_px, top_px, width_px, height_px]) => proto::StreamItem {
            time,
            tracker_id: Some(row.id.clone()),
            bounding_box: Some(proto::BoundingBox {
                left_px: Some(left_px),
                top_px: Some(top_px),
                width_px: Some(width_px),
                height_px: Some(height_px),
            }),
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

/// Sends an item and returns the answer to it.
async fn sent(client: &mut Client, item: proto::StreamItem) -> proto::StreamAnswer {
    let seq = client.item(item).await;
    let answer = client.answer().await;
    assert_eq!(answer.seq, seq);
    answer
}

/// Sends the latest box of a walker again, each time 1 ms later, until it is matched: rounds of matching go on beside
/// the stream.
async fn wait_for_match(client: &mut Client, row: &Row, shift: SignedDuration) {
    for attempt in 1..=300 {
        let later = shift + SignedDuration::from_millis(attempt);
        if sent(client, item(row, later)).await.receiver_match.is_some() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    panic!("a carrier in view for {SENT_FIRST_S} s is not matched");
}

/// Boxes by what their answers say.
#[derive(Debug, Default)]
struct Answered {
    right: usize,
    wrong: usize,
    unmatched: usize,
}

impl Answered {
    fn add(&mut self, row: &Row, answer: &proto::StreamAnswer) {
        let target = answer.track.as_ref().map(|track| track.target_id.as_str());
        if row.walker.is_some() {
            // Whatever it carries, the target is the tracker's.
            assert_eq!(target, Some(format!("tracker:{}", row.id).as_str()), "{answer:?}");
        }
        match (&answer.receiver_match, row.walker) {
            (Some(found), Some(walker)) => {
                let of_track = answer.track.as_ref().and_then(|track| track.receiver_match.as_ref());
                assert!(found.probability >= 0.6 && of_track == Some(found), "{answer:?}");
                let is_right = found.receiver_id == format!("phone-{walker}");
                *if is_right { &mut self.right } else { &mut self.wrong } += 1;
            }
            (None, Some(_)) => self.unmatched += 1,
            (found, None) => assert!(found.is_none(), "{answer:?}"),
        }
    }
}

#[tokio::test]
async fn boxes_of_a_stream_are_matched_with_the_receivers_beside_them() {
    let folder = data_folder();
    let server = trained_yard(folder.path()).await;
    let mut client = open(&channel(&server).await, "edge", true).await;
    let rows = rows(&LIVE.recorded());
    let (first, last) = (rows[0].time, rows.last().expect("rows").time);
    let shift = now().duration_since(last);
    let (before, after): (Vec<&Row>, Vec<&Row>) =
        rows.iter().partition(|row| row.time.duration_since(first).as_secs_f64() <= SENT_FIRST_S);
    for row in &before {
        sent(&mut client, item(row, shift)).await;
    }
    for carrier in 0..LIVE.phones {
        let latest = before.iter().rev().find(|row| row.walker == Some(carrier)).expect("a box");
        wait_for_match(&mut client, latest, shift).await;
    }
    let mut answered = Answered::default();
    for row in &after {
        answered.add(row, &sent(&mut client, item(row, shift)).await);
    }
    println!("{answered:?}");
    assert!(answered.right > 100 && answered.wrong * 20 <= answered.right, "{answered:?}");
    assert!(answered.unmatched > 100, "{answered:?}");
    let (acknowledgement, _, ended) = client.finish_with_counts().await;
    assert!(ended.is_none(), "{ended:?}");
    let acknowledgement = acknowledgement.expect("the stream stores samples");
    let reason = i32::from(proto::not_stored::Reason::Unmatched);
    let unmatched = acknowledgement.not_stored.iter().find(|own| own.reason == reason);
    assert!(unmatched.is_some_and(|own| own.count > 100), "{acknowledgement:?}");
    assert!(acknowledgement.stored > 50, "{acknowledgement:?}");
    // Only sure boxes are stored, under the receiver's id.
    let stored = exported_csv(&server).await;
    let live = stored.lines().skip(1).filter(|line| !line.contains(",w"));
    assert!(live.clone().count() > 20 && live.clone().all(|line| line.contains(",phone-")), "{stored}");
}

/// In a site world tracks are matched: a carrier's track has its receiver as an attribute, and the id that it had before.
#[tokio::test]
async fn a_world_track_keeps_its_id_when_its_receiver_is_found() {
    let folder = data_folder();
    let server = trained_yard_of_site(folder.path()).await;
    let mut client = open(&channel(&server).await, "edge", false).await;
    let rows = rows(&LIVE.recorded());
    let (first, last) = (rows[0].time, rows.last().expect("rows").time);
    let shift = now().duration_since(last);
    let before = rows.iter().take_while(|row| row.time.duration_since(first).as_secs_f64() <= SENT_FIRST_S);
    let mut named: BTreeMap<usize, String> = BTreeMap::new();
    for row in before.clone() {
        let answer = sent(&mut client, item(row, shift)).await;
        named.extend(row.walker.zip(answer.world_track_id));
    }
    for carrier in 0..LIVE.phones {
        let latest = before.clone().filter(|row| row.walker == Some(carrier)).last().expect("a box");
        wait_for_match(&mut client, latest, shift).await;
        let tracks = server.get("/v1/sites/square/tracks").await.expect(200).json();
        let phone = format!("phone-{carrier}");
        let of_phone = |track: &&serde_json::Value| track["receiver_match"]["receiver_id"] == phone.as_str();
        let carried: Vec<_> = tracks["items"].as_array().expect("tracks").iter().filter(of_phone).collect();
        assert_eq!(carried.len(), 1, "{tracks}");
        assert_eq!(carried[0]["id"], named[&carrier], "{tracks}");
        assert_eq!(carried[0]["target_id"], phone, "{tracks}");
        assert!(carried[0]["receiver_match"]["probability"].as_f64() >= Some(0.6), "{tracks}");
    }
}

/// The camera's clock is early by 1.5 s: the fixes of all receivers seem late by that.
#[tokio::test]
async fn receivers_that_are_all_late_show_that_the_clocks_of_the_cameras_are_early() {
    const LATE: SignedDuration = SignedDuration::from_millis(1_500);
    let folder = data_folder();
    let server = trained_yard_of_site(folder.path()).await;
    let mut client = open(&channel(&server).await, "edge", false).await;
    let mut rows = rows(&Crowd { phones: LIVE.walkers, ..LIVE }.recorded());
    rows.iter_mut().filter(|row| row.walker.is_none()).for_each(|row| row.time += LATE);
    rows.sort_by_key(|row| row.time);
    let shift = now().duration_since(rows.last().expect("rows").time);
    for row in &rows {
        sent(&mut client, item(row, shift)).await;
    }
    // Rounds of matching go on beside the stream.
    let latest = rows.iter().rfind(|row| row.walker.is_some()).expect("a box");
    let mut answer = Value::Null;
    for attempt in 1..=150 {
        sent(&mut client, item(latest, shift + LATE + SignedDuration::from_millis(attempt))).await;
        answer = server.get("/v1/sites/square/tracks").await.expect(200).json();
        if answer["common_receiver_clock"]["is_wrong"] == true {
            break;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    let late = |clock: &Value| {
        let figure = |name: &str| clock[name].as_f64().expect("a figure");
        (figure("offset_s") - LATE.as_secs_f64()).abs() <= 4.0 * figure("sigma_s")
    };
    assert!(answer["common_receiver_clock"]["is_wrong"] == true, "{answer}");
    assert!(late(&answer["common_receiver_clock"]), "{answer}");
    let single = answer["receiver_clocks"].as_array().expect("clocks");
    assert!(single.len() >= 3 && single.iter().all(late), "{answer}");
}

/// All samples of the camera.
async fn exported_csv(server: &TestServer) -> String {
    const ALL: &str = "/v1/cameras/yard/samples";
    server.send("GET", ALL, &[("accept", "text/csv")], "").await.expect(200).text()
}

#[tokio::test]
async fn a_tracker_id_beside_a_target_is_refused() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let bounding_box = json!({"left_px": 10.0, "top_px": 10.0, "width_px": 30.0, "height_px": 80.0});
    let time = now();
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
    let report = server.send("POST", PATH, &kind, body.clone()).await.expect(200).json();
    let exported = exported_csv(&server).await;
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
    assert_eq!(report["accepted"], all, "{report}");
    let pairs = report["matching"]["pairs"].as_array().expect("pairs");
    assert!(pairs.iter().all(|pair| pair["probability"].as_f64() >= Some(0.9)), "{report}");
    // The same again stores nothing new.
    let again = server.send("POST", PATH, &kind, body).await.expect(200).json();
    assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(all)), "{again}");
}

/// Somebody walks beside a walker, half a box to the right.
fn with_companion(recorded: &Recorded, walker: usize) -> Recorded {
    let mut lines = recorded.detections.lines();
    let mut detections = format!("{}\n", lines.next().expect("a header"));
    let mut walkers = Vec::new();
    for (line, own) in lines.zip(&recorded.walkers) {
        writeln!(detections, "{line}").expect("memory");
        walkers.push(*own);
        if *own == walker {
            let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
            let number = |cell: &String| cell.parse::<f64>().expect("a number");
            cells[1] = format!("beside-{}", cells[1]);
            cells[2] = format!("{:.2}", number(&cells[2]) + 0.5 * number(&cells[4]));
            writeln!(detections, "{}", cells.join(",")).expect("memory");
            walkers.push(LIVE.walkers);
        }
    }
    Recorded { detections, fixes: recorded.fixes.clone(), walkers }
}

#[tokio::test]
async fn a_receiver_within_a_group_is_given_to_the_group() {
    const PATH: &str = "/v1/cameras/yard/samples/pairings?match=true";
    let folder = data_folder();
    let server = trained_yard(folder.path()).await;
    let recorded = with_companion(&LIVE.recorded(), 0);
    let (content_type, body) = multipart(&recorded);
    let kind = [("content-type", content_type.as_str())];
    let report = server.send("POST", PATH, &kind, body).await.expect(200).json();
    let matching = &report["matching"];
    let text = |of: &Value, name: &str| of[name].as_str().expect("text").to_owned();
    let pairs = matching["pairs"].as_array().expect("pairs");
    assert!(!pairs.is_empty() && pairs.iter().all(|pair| text(pair, "receiver_id") == "phone-1"), "{report}");
    let groups = matching["groups"].as_array().expect("groups");
    let shared: Vec<&Value> = groups.iter().filter(|own| text(own, "receiver_id") == "phone-0").collect();
    let mut mean_boxes = 0;
    for group in shared {
        let members = group["members"].as_array().expect("members");
        let ids: Vec<String> = members.iter().map(|own| text(own, "tracker_id")).collect();
        let beside = ids.iter().find(|id| id.starts_with("beside-")).expect("the companion");
        assert!(ids.contains(&beside.trim_start_matches("beside-").to_owned()), "{group}");
        let share = |own: &Value| own["probability"].as_f64().expect("a number");
        let sum: f64 = members.iter().map(share).sum();
        assert!(sum >= 0.9 && members.iter().all(|own| share(own) < 0.9), "{group}");
        assert!((share(group) - sum).abs() < 1e-9, "{group}");
        mean_boxes += group["detections"].as_u64().expect("a number");
    }
    // Samples are of the means of the members' boxes, which no detector saw.
    let seen: BTreeSet<&str> =
        recorded.detections.lines().filter_map(|line| line.split(',').nth(2)).collect();
    let exported = exported_csv(&server).await;
    let cells = |line: &str| line.split(',').map(str::to_owned).collect::<Vec<String>>();
    let columns = ["target_id", "left"].map(|name| {
        exported.lines().next().and_then(|header| cells(header).iter().position(|own| own == name))
    });
    let [Some(target), Some(left)] = columns else { panic!("{exported}") };
    let of_group =
        |line: &&str| cells(line)[target] == "phone-0" && !seen.contains(cells(line)[left].as_str());
    let stored = exported.lines().filter(of_group).count();
    // One for each fix.
    assert!(stored > 150 && stored as u64 <= mean_boxes, "{stored} of {mean_boxes}: {report}");
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
