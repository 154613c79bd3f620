//! Messages of connections: reading each format of a source, and writing each of a sink, compared with the bare parser or
//! writer of the same bytes.

use std::hint::black_box;
use std::time::Instant;

use jiff::Timestamp;
use serde_json::{Value, json};
use sightfix::domain::{CameraId, TargetId, TimeBounds};
use sightfix::exchange::{
    MessageContext, MessageFormat, OutgoingPosition, TrackFile, TrackFileFormat, cot_event, decoder,
    position_json,
};
use sightfix::geo::{PlaneCovariance, Position};

use crate::ratio::{self, in_turn};

/// Messages of a round.
const MESSAGES: usize = 20_000;
/// Points of a file of tracks.
const POINTS: usize = 5_000;

pub(crate) fn run() {
    ratio::head("Messages of sources, compared with the bare parser of the same bytes", "items/s");
    for (case, format, message, parse) in cases() {
        decode_in_turn(case, format, &message, parse);
    }
    ratio::head("Messages of sinks, compared with the bare writer of the same document", "items/s");
    encode();
}

type Parse = fn(&[u8]);

fn parse_json(message: &[u8]) {
    black_box(serde_json::from_slice::<Value>(message).expect("JSON"));
}

fn parse_xml(message: &[u8]) {
    let mut reader = quick_xml::Reader::from_reader(message);
    while !matches!(black_box(reader.read_event().expect("XML")), quick_xml::events::Event::Eof) {}
}

/// The checksum alone, for which every byte is read.
fn sum(message: &[u8]) {
    black_box(message.iter().fold(0, |sum, byte| sum ^ byte));
}

fn sentence(start: char, body: &str) -> String {
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("{start}{body}*{checksum:02X}\r\n")
}

/// A message of each format, as the tests have it from the other system's documentation.
fn cases() -> Vec<(&'static str, MessageFormat, String, Parse)> {
    let frigate = json!({"type": "update", "before": {}, "after": {
        "id": "1607123955.475377-mxklsc", "camera": "front_door", "frame_time": 1_607_123_962.082_975,
        "label": "person", "top_score": 0.958_984_375, "false_positive": false, "score": 0.878_906_25,
        "box": [432, 496, 544, 854], "area": 40096, "region": [218, 440, 693, 915], "stationary": false}});
    let objects: Vec<String> =
        (0..8).map(|id| format!("{id}|{}.6|510|{}.4|562.5|Person", 100 + 40 * id, 130 + 40 * id)).collect();
    let minimal = json!({"version": "4.0", "id": 418, "@timestamp": "2020-06-13T06:59:42.757Z",
        "sensorId": "cam0", "objects": objects});
    let full = json!({"messageid": "ff7cc527-d019-4348-8b25-6df69c5b6dcc", "mdsversion": "1.0",
        "@timestamp": "2021-03-31T20:11:07.742Z", "sensor": {"id": "cam0", "type": "Camera"},
        "object": {"id": "12", "speed": 0.0, "vehicle": {"type": "sedan", "confidence": 0.9},
            "bbox": {"topleftx": 597, "toplefty": 481, "bottomrightx": 711, "bottomrighty": 569},
            "location": {"lat": 0.0, "lon": 0.0, "alt": 0.0}}, "event": {"type": "moving"}, "videoPath": ""});
    let onvif = r#"<?xml version="1.0" encoding="UTF-8"?><tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema">
        <tt:VideoAnalytics><tt:Frame UtcTime="2020-09-25T11:28:17.432Z"><tt:Transformation><tt:Translate x="-1.0" y="1.0"/>
        <tt:Scale x="0.0002" y="-0.0002"/></tt:Transformation><tt:Object ObjectId="12"><tt:Appearance><tt:Shape>
        <tt:BoundingBox left="375" top="3112" right="1875" bottom="7445"/><tt:CenterOfGravity x="60.0" y="50.0"/></tt:Shape>
        <tt:Class><tt:Type Likelihood="0.9">Human</tt:Type></tt:Class></tt:Appearance></tt:Object></tt:Frame>
        </tt:VideoAnalytics></tt:MetadataStream>"#;
    let gpsd = json!({"class": "TPV", "device": "/dev/ttyUSB0", "mode": 3, "time": "2026-06-01T11:59:59.000Z",
        "lat": 30.628_013_5, "lon": 103.986_78});
    let traccar = json!({"position": {"id": 7, "deviceId": 3, "protocol": "osmand", "fixTime": "2026-06-01T11:59:59Z",
        "outdated": false, "valid": true, "latitude": 59.4371, "longitude": 24.7453, "accuracy": 4.0, "attributes": {}},
        "device": {"id": 3, "name": "van", "uniqueId": "862531"}});
    let rmc = sentence('$', "GPRMC,115959.00,A,3037.6808,N,10359.2068,E,0.5,054.7,010626,020.3,E");
    let gga = sentence('$', "GPGGA,115959.00,3037.6808,N,10359.2068,E,1,08,0.9,545.4,M,46.9,M,,");
    let ais = "!AIVDM,1,1,,B,177KQJ5000G?tO`K>RA1wUbN0TKH,0*5C\r\n".to_owned();
    vec![
        ("Frigate", MessageFormat::Frigate, frigate.to_string(), parse_json),
        ("DeepStream, minimal, 8 objects", MessageFormat::Deepstream, minimal.to_string(), parse_json),
        ("DeepStream, full", MessageFormat::Deepstream, full.to_string(), parse_json),
        ("ONVIF", MessageFormat::Onvif, onvif.to_owned(), parse_xml),
        ("NMEA, RMC and GGA", MessageFormat::Nmea, rmc + &gga, sum),
        ("AIS, type 1", MessageFormat::Nmea, ais, sum),
        ("gpsd", MessageFormat::Gpsd, gpsd.to_string(), parse_json),
        ("Traccar", MessageFormat::Traccar, traccar.to_string(), parse_json),
    ]
}

fn decode_in_turn(case: &str, format: MessageFormat, message: &str, parse: Parse) {
    let received_at: Timestamp = "2026-06-01T12:00:20.5Z".parse().expect("a time");
    let context =
        MessageContext { subject: "", received_at, time_bounds: TimeBounds::live_at(received_at, 5) };
    let mut decoder = decoder(format);
    let items = decoder.decode(message.as_bytes(), &context).expect("a message").items.len();
    assert!(items > 0, "{case} brings something");
    let rate = |began: Instant| (items * MESSAGES) as f64 / began.elapsed().as_secs_f64();
    let ours = || {
        let began = Instant::now();
        for _ in 0..MESSAGES {
            black_box(decoder.decode(black_box(message.as_bytes()), &context).expect("a message"));
        }
        rate(began)
    };
    let peer = || {
        let began = Instant::now();
        for _ in 0..MESSAGES {
            parse(black_box(message.as_bytes()));
        }
        rate(began)
    };
    ratio::row(case, &in_turn(ours, peer));
}

/// Writes that many messages; items per second.
fn timed(count: usize, mut write: impl FnMut()) -> f64 {
    let began = Instant::now();
    for _ in 0..count {
        write();
    }
    count as f64 / began.elapsed().as_secs_f64()
}

fn encode() {
    let (camera, target) = (CameraId::new("gate").expect("a slug"), TargetId::new("van").expect("a name"));
    let position = OutgoingPosition {
        message_id: "0197f0b2-7c3e-7d2a-9d55-2b9c1f1c2a10",
        camera_id: &camera,
        receiver_match: None,
        target_id: &target,
        time: "2026-06-01T12:00:20.5Z".parse().expect("a time"),
        position: Position::new(103.986_78, 30.628).expect("a place"),
        covariance: PlaneCovariance::isotropic(2.25),
        r95_m: 3.67,
        velocity_m_s: [1.2, -0.4],
    };
    let written = position_json(&position);
    let document: Value = serde_json::from_slice(&written).expect("JSON");
    let bare = || {
        timed(MESSAGES, || {
            black_box(serde_json::to_vec(black_box(&document)).expect("JSON"));
        })
    };
    let as_json = || {
        timed(MESSAGES, || {
            black_box(position_json(black_box(&position)));
        })
    };
    ratio::row("JSON, compared with serde_json of a document", &in_turn(as_json, bare));
    let as_cot = || {
        timed(MESSAGES, || {
            black_box(cot_event(black_box(&position), "a-f-G-U-C", 30.0));
        })
    };
    ratio::row("Cursor on Target, compared with serde_json of a document", &in_turn(as_cot, bare));
    for (name, format) in [("GPX", TrackFileFormat::Gpx), ("KML", TrackFileFormat::Kml)] {
        let as_file = || {
            let began = Instant::now();
            let mut file = TrackFile::new(format);
            for _ in 0..POINTS {
                file.push(black_box(&written)).expect("a position");
            }
            black_box(file.to_text());
            POINTS as f64 / began.elapsed().as_secs_f64()
        };
        let bare = || timed(POINTS, || parse_json(black_box(&written)));
        let case = format!("{name}, a file of {POINTS} points, compared with parsing their JSON");
        ratio::row(&case, &in_turn(as_file, bare));
    }
}
