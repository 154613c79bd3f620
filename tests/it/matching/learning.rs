//! From a detector's tracker and a phone, each with ids of its own, to a model and live positions, over a real mosquitto, and
//! from a camera's metadata over GStreamer's RTSP server.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};

use super::ONE_AMONG_TEN;
use super::crowd::{Crowd, Recorded};
use super::live::{Row, rows};
use crate::harness::{TestServer, data_folder, now};
use crate::outside::peers::{Broker, RtspCamera, connection_when};

/// Recorded time after which a camera must have its model, s: what is found in ten worlds, and what one of them may need.
const LEARNT_FROM_S: f64 = 600.0;
const LEARNT_BY_S: f64 = 1_200.0;
/// Time for which positions are looked at, s.
const LIVE_S: f64 = 120.0;
/// Positions that are looked at, of all eleven targets and of the fixes.
const RECEIVED: u32 = 900;
/// Time of messages that are published at once, s.
const SLICE_S: f64 = 20.0;
/// Image size of the square's camera, px.
const SIZE_PX: [f64; 2] = [1920.0, 1080.0];

/// An event of Frigate with the state after a change.
fn frigate_event(camera: &str, row: &Row, shift: SignedDuration) -> String {
    let [left, top, width, height] = row.numbers[..] else { panic!("a box") };
    json!({"type": "update", "before": {}, "after": {
        "id": format!("1607123955.475377-{}", row.id), "camera": camera, "label": "person", "false_positive": false,
        "frame_time": (row.time + shift).as_microsecond() as f64 * 1e-6, "score": 0.88,
        "box": [left, top, left + width, top + height],
    }})
    .to_string()
}

/// A frame of ONVIF metadata with the boxes of one time, in the coordinates and with the elements that Hanwha's cameras have.
fn onvif_frame(boxes: &[&Row], shift: SignedDuration) -> String {
    let [x, y] = SIZE_PX.map(|side_px| 2.0 / side_px);
    let objects = boxes.iter().map(|row| {
        let [left, top, width, height] = row.numbers[..] else { panic!("a box") };
        format!(
            r#"<tt:Object ObjectId="{}" Parent="0"><tt:Appearance><tt:Shape><tt:BoundingBox left="{left}" top="{top}" right="{}" bottom="{}"/></tt:Shape><tt:Class><tt:Type Likelihood="0.88">Human</tt:Type></tt:Class></tt:Appearance></tt:Object>"#,
            row.id,
            left + width,
            top + height,
        )
    });
    format!(
        r#"<tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema"><tt:VideoAnalytics><tt:Frame UtcTime="{}"><tt:Transformation><tt:Translate x="-1.0" y="1.0"/><tt:Scale x="{x}" y="{}"/></tt:Transformation>{}</tt:Frame></tt:VideoAnalytics></tt:MetadataStream>"#,
        boxes[0].time + shift,
        -y,
        objects.collect::<String>(),
    )
}

/// A position as Traccar forwards it.
fn traccar_position(row: &Row, shift: SignedDuration) -> String {
    let [longitude, latitude] = row.numbers[..] else { panic!("a fix") };
    json!({
        "position": {"deviceId": 1, "fixTime": (row.time + shift).to_string(), "valid": true,
            "longitude": longitude, "latitude": latitude, "accuracy": 4.0},
        "device": {"uniqueId": row.id},
    })
    .to_string()
}

/// Where a square's boxes come from.
enum Detector {
    /// Frigate, by the broker.
    Frigate,
    /// A camera, by its own stream.
    Onvif(RefCell<RtspCamera>),
}

impl Detector {
    fn source(&self, broker: &Broker, camera: &str) -> Value {
        match self {
            Self::Frigate => json!({
                "address": broker.address(), "format": "frigate", "topics": [format!("{camera}/events")],
                "cameras": {"front_door": {"camera_id": camera}}, "store_samples": true,
            }),
            Self::Onvif(stream) => json!({
                "address": stream.borrow().address(), "format": "onvif",
                "cameras": {"*": {"camera_id": camera}}, "store_samples": true,
            }),
        }
    }

    fn publish(&self, boxes: &[&Row], square: &Square<'_>) {
        match self {
            Self::Frigate => {
                let events = boxes.iter().map(|row| frigate_event("front_door", row, square.shift));
                square.broker.publish_lines(&format!("{}/events", square.camera), events);
            }
            Self::Onvif(stream) => {
                let mut stream = stream.borrow_mut();
                let frames = boxes.chunk_by(|one, next| one.time == next.time);
                frames.for_each(|boxes| stream.send(&onvif_frame(boxes, square.shift)));
            }
        }
    }
}

/// A square of a broker: its camera, the detector's and the phone's connection.
struct Square<'a> {
    server: &'a TestServer,
    broker: &'a Broker,
    detector: Detector,
    camera: String,
    recorded: Recorded,
    rows: Vec<Row>,
    /// From the times of the recording to those of the messages.
    shift: SignedDuration,
}

impl<'a> Square<'a> {
    async fn new(server: &'a TestServer, broker: &'a Broker, detector: Detector, crowd: Crowd) -> Self {
        let camera = format!("square-{}", crowd.seed);
        let [width_px, height_px] = SIZE_PX;
        let draft =
            json!({"id": camera, "image_size": {"width_px": width_px as u32, "height_px": height_px as u32}});
        server.post("/v1/cameras", &draft).await.expect(201);
        let boxes = json!({"id": format!("boxes-{camera}"), "source": detector.source(broker, &camera)});
        let phone = json!({"id": format!("phones-{camera}"), "source": {
            "address": broker.address(), "format": "traccar", "topics": [format!("{camera}/positions")],
            "camera_ids": [camera], "store_samples": true,
        }});
        for draft in [&boxes, &phone] {
            server.post("/v1/connections", draft).await.expect(201);
            let id = draft["id"].as_str().expect("text");
            connection_when(server, id, |status| status["state"] == "running").await;
        }
        let recorded = crowd.recorded();
        let rows = rows(&recorded);
        let shift = now().duration_since(rows.last().expect("rows").time);
        Self { server, broker, detector, camera, recorded, rows, shift }
    }

    fn since_start_s(&self, row: &Row) -> f64 {
        row.time.duration_since(self.rows[0].time).as_secs_f64()
    }

    /// Publishes what was recorded from a time up to another, s, boxes and fixes under topics of their own.
    fn publish(&self, from_s: f64, until_s: f64) {
        let is_within = |row: &&Row| (from_s..until_s).contains(&self.since_start_s(row));
        let (boxes, fixes): (Vec<&Row>, Vec<&Row>) =
            self.rows.iter().filter(is_within).partition(|row| row.walker.is_some());
        self.detector.publish(&boxes, self);
        let positions = fixes.iter().map(|row| traccar_position(row, self.shift));
        self.broker.publish_lines(&format!("{}/positions", self.camera), positions);
    }

    /// The same in slices, with a pause after each.
    async fn publish_slices(&self, from_s: f64, until_s: f64, slice_s: f64, pause: Duration) {
        let mut at_s = from_s;
        while at_s < until_s {
            self.publish(at_s, until_s.min(at_s + slice_s));
            tokio::time::sleep(pause).await;
            at_s += slice_s;
        }
    }

    /// True if all that was published up to a time, s, is recorded.
    fn is_recorded(&self, learning: &Value, until_s: f64) -> bool {
        let published = self.rows.iter().filter(|row| self.since_start_s(row) < until_s);
        let (boxes, fixes): (Vec<&Row>, Vec<&Row>) = published.partition(|row| row.walker.is_some());
        learning["boxes"] == boxes.len() && learning["fixes"] == fixes.len()
    }

    /// Publishes from a time on, s, until the camera has its model, and returns the time of the last message, s. An attempt that
    /// finds nothing is followed by one with more.
    async fn publish_until_learnt(&self, from_s: f64) -> f64 {
        let mut until_s = from_s;
        loop {
            let learning = self.learning().await;
            let needs_more = learning["recorded_s"].as_u64() < learning["needed_s"].as_u64();
            if learning["state"] == "learned" {
                return until_s;
            } else if learning["state"] == "recording" && needs_more && self.is_recorded(&learning, until_s) {
                assert!(until_s < LEARNT_BY_S, "{learning}");
                self.publish(until_s, until_s + SLICE_S);
                until_s += SLICE_S;
            } else {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }

    async fn learning(&self) -> Value {
        self.server.get(&format!("/v1/cameras/{}/learning", self.camera)).await.expect(200).json()
    }

    /// Returns the camera's learning once it has succeeded or failed.
    async fn learnt(&self) -> Value {
        let mut learning = Value::Null;
        for _ in 0..3_000 {
            learning = self.learning().await;
            let has_tried = learning["state"] == "recording" && learning["last_attempt"].is_object();
            if has_tried || learning["state"] == "learned" {
                return learning;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
        panic!("the camera does not try to learn: {learning}")
    }

    /// Samples of phones: those of the boxes of their carriers, and all.
    async fn samples(&self) -> (usize, usize) {
        let path = format!("/v1/cameras/{}/samples", self.camera);
        let csv = self.server.send("GET", &path, &[("accept", "text/csv")], "").await.expect(200).text();
        let carriers = self.walkers();
        let mut reader = csv::Reader::from_reader(csv.as_bytes());
        let header = reader.headers().expect("a header").clone();
        let column = |name: &str| header.iter().position(|given| given == name).expect("the column");
        let columns = ["time", "target_id", "left"].map(column);
        let samples = reader.records().map(|row| row.expect("a row"));
        let of_phones: Vec<_> = samples.filter(|row| row[columns[1]].starts_with("phone-")).collect();
        let is_right = |row: &&csv::StringRecord| {
            let [time, target, left] = columns.map(|at| &row[at]);
            let left: f64 = left.parse().expect("px");
            let time: Timestamp = time.parse().expect("a time");
            let walker = carriers.get(&(time.as_millisecond(), (left * 100.0).round() as i64));
            walker.is_some_and(|walker| target == format!("phone-{walker}"))
        };
        (of_phones.iter().filter(is_right).count(), of_phones.len())
    }

    /// Walkers by the time of their box, ms, and its left edge, 0.01 px.
    fn walkers(&self) -> BTreeMap<(i64, i64), usize> {
        let boxes = self.rows.iter().filter_map(|row| Some((row, row.walker?)));
        boxes
            .map(|(row, walker)| {
                let time_ms = (row.time + self.shift).as_millisecond();
                ((time_ms, (row.numbers[0] * 100.0).round() as i64), walker)
            })
            .collect()
    }
}

#[tokio::test]
#[ignore = "needs mosquitto"]
async fn a_camera_of_a_broker_learns_by_itself_whose_phone_it_sees() {
    learns_by_itself_whose_phone_it_sees(Detector::Frigate).await;
}

#[tokio::test]
#[ignore = "needs mosquitto and GStreamer's RTSP server"]
async fn a_camera_of_rtsp_learns_by_itself_whose_phone_it_sees() {
    learns_by_itself_whose_phone_it_sees(Detector::Onvif(RefCell::new(RtspCamera::start()))).await;
}

/// The story of a detector and a phone that know nothing of each other: eleven people, of whom one carries the phone.
async fn learns_by_itself_whose_phone_it_sees(detector: Detector) {
    let broker = Broker::start();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let square = Square::new(&server, &broker, detector, Crowd { seconds: 1_320, ..ONE_AMONG_TEN }).await;
    assert_eq!(square.recorded.walkers.iter().max(), Some(&10));
    let learning = square.learning().await;
    assert_eq!(learning["state"], "recording", "{learning}");
    assert!(learning["message"].as_str().is_some_and(|text| text.contains("no box")), "{learning}");

    square.publish_slices(0.0, 240.0, SLICE_S, Duration::ZERO).await;
    let phones = format!("phones-{}", square.camera);
    connection_when(&server, &phones, |status| status["items"].as_u64() >= Some(230)).await;
    let learning = square.learning().await;
    let message = learning["message"].as_str().expect("text");
    assert!(message.contains("of about 8 minutes"), "{learning}");

    let learnt_s = square.publish_until_learnt(240.0).await;
    let (right, all) = square.samples().await;
    println!("after {learnt_s} s {right} of {all} samples right: {}", square.learning().await);
    assert!(all > 200 && right * 100 >= all * 95, "{right} of {all}");

    // From now on boxes are matched as they come, and positions go out.
    let topic = format!("sightfix/{}/+", square.camera);
    broker.subscribe(&topic);
    let sink = json!({"id": "positions", "sink": {
        "address": broker.address(), "camera_ids": [square.camera], "min_interval_s": 0,
    }});
    server.post("/v1/connections", &sink).await.expect(201);
    connection_when(&server, "positions", |status| status["state"] == "running").await;
    square.publish_slices(learnt_s, learnt_s + LIVE_S, 2.0, Duration::from_millis(300)).await;
    let received = broker.received(&topic, RECEIVED);
    let times: Vec<Timestamp> = received
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line.split_once(' ')?.1).ok())
        .filter(|message| {
            message["target_id"] == "phone-0" || message["receiver_match"]["receiver_id"] == "phone-0"
        })
        .map(|message| message["time"].as_str().expect("a time").parse().expect("a time"))
        .collect();
    // Fixes have times of their own, between the frames.
    let frames: Vec<i64> = square.walkers().into_keys().map(|(time_ms, _)| time_ms).collect();
    let of_boxes = times.iter().filter(|time| frames.binary_search(&time.as_millisecond()).is_ok()).count();
    println!("{of_boxes} of {} positions of the phone are of boxes", times.len());
    assert!(of_boxes * 3 > times.len(), "{received}");
    let (right, all_with_live) = square.samples().await;
    assert!(all_with_live > all && right * 100 >= all_with_live * 95, "{right} of {all_with_live}");
}

/// Ten worlds, each with a camera and connections of its own.
#[tokio::test]
#[ignore = "takes minutes: needs mosquitto, and is a mark of docs/explanation/association.md"]
async fn marks_of_cameras_that_learn_by_themselves() {
    let (broker, folder) = (Broker::start(), data_folder());
    let server = TestServer::start(folder.path());
    let (mut learnt, mut wrong) = (0, 0);
    for seed in 1..=10 {
        let square = Square::new(&server, &broker, Detector::Frigate, Crowd { seed, ..ONE_AMONG_TEN }).await;
        square.publish_slices(0.0, LEARNT_FROM_S, SLICE_S, Duration::ZERO).await;
        let learning = square.learnt().await;
        let (right, all) = square.samples().await;
        let is_right = right * 100 >= all * 95;
        let has_learnt = learning["state"] == "learned";
        learnt += usize::from(has_learnt && is_right);
        wrong += usize::from(!is_right);
        println!("world {seed}: {right} of {all} samples right; {}", learning["message"]);
    }
    println!("right in {learnt} of 10 worlds, wrong in {wrong}");
    assert!(learnt >= 9 && wrong == 0);
}
