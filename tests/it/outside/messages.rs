//! Messages as other systems send them; where each comes from is stated beside it.

use jiff::{SignedDuration, Timestamp};
use sightfix::domain::{ReceivedFix, ReceiverId, Score, TargetClass, TimeBounds};
use sightfix::exchange::{
    DetectedBox, FixFormat, MessageContext, MessageFormat, MessageItem, NamedDetection, Reading, decoder,
    read_received_fixes,
};

fn context() -> MessageContext<'static> {
    let received_at: Timestamp = "2026-06-01T12:00:20.5Z".parse().expect("a time");
    MessageContext { subject: "", received_at, time_bounds: TimeBounds::live_at(received_at, 5) }
}

fn read(format: MessageFormat, message: &str) -> Reading {
    decoder(format).decode(message.as_bytes(), &context()).unwrap_or_else(|reason| panic!("{reason}"))
}

fn only_detection(reading: &Reading) -> &NamedDetection {
    match &reading.items[..] {
        [MessageItem::Detection(detection)] => detection,
        other => panic!("{other:?} {:?}", reading.skipped),
    }
}

/// Receiver, longitude, latitude and time of each fix.
fn fixes(reading: &Reading) -> Vec<(Option<&str>, f64, f64, String)> {
    let mut fixes = Vec::new();
    for item in &reading.items {
        let MessageItem::Fix(ReceivedFix { time, receiver_id, fix }) = item else { panic!("{item:?}") };
        let receiver = receiver_id.as_ref().map(ReceiverId::as_str);
        fixes.push((receiver, fix.position.longitude_deg(), fix.position.latitude_deg(), time.to_string()));
    }
    fixes
}

/// The example in Frigate's documentation, docs/docs/integrations/mqtt.md.
const FRIGATE: &str = r#"{"type": "update",
    "before": {"id": "1607123955.475377-mxklsc", "camera": "front_door", "frame_time": 1607123961.837752,
        "label": "person", "top_score": 0.958984375, "false_positive": false, "score": 0.7890625,
        "box": [424, 500, 536, 712], "area": 23744, "region": [264, 450, 667, 853]},
    "after": {"id": "1607123955.475377-mxklsc", "camera": "front_door", "frame_time": 1607123962.082975,
        "snapshot_time": 1607123961.837752, "label": "person", "top_score": 0.958984375,
        "false_positive": false, "start_time": 1607123955.475377, "end_time": null, "score": 0.87890625,
        "box": [432, 496, 544, 854], "area": 40096, "region": [218, 440, 693, 915],
        "current_zones": ["yard", "driveway"], "stationary": false}}"#;

#[test]
fn frigate_states_corners_of_the_state_after_the_change() {
    let reading = read(MessageFormat::Frigate, FRIGATE);
    let detection = only_detection(&reading);
    assert_eq!(detection.camera, "front_door");
    assert_eq!(detection.target_id.as_str(), "1607123955.475377-mxklsc");
    assert_eq!(detection.time.to_string(), "2020-12-04T23:19:22.082975Z");
    assert_eq!(detection.detected_box, DetectedBox::Pixels([432.0, 496.0, 544.0, 854.0]));
    assert_eq!(detection.class.as_ref().map(TargetClass::as_str), Some("person"));
    assert_eq!(detection.score.map(Score::value), Some(0.87890625));
    let wrong = FRIGATE
        .replace("\"false_positive\": false, \"start_time\"", "\"false_positive\": true, \"start_time\"");
    let reading = read(MessageFormat::Frigate, &wrong);
    assert!(reading.items.is_empty() && reading.skipped[0].contains("false positive"), "{reading:?}");
    let update = r#"{"type": "description", "id": "1607123955.475377-mxklsc", "description": "a person"}"#;
    let reading = read(MessageFormat::Frigate, update);
    assert_eq!(reading.skipped, ["an update of the kind description has no box"]);
    for wrong in ["", "[]", "{", &FRIGATE.replace("1607123962.082975", "1e300"), &"[".repeat(10_000)] {
        assert!(decoder(MessageFormat::Frigate).decode(wrong.as_bytes(), &context()).is_err(), "{wrong:.40}");
    }
}

/// The output of NVIDIA's sample `deepstream-test5` on an edge device, as published in a walk-through of it, and an
/// object with attributes as the documentation of Gst-nvmsgconv has it.
#[test]
fn deepstreams_minimal_schema_has_many_objects_in_a_message() {
    let reading = read(
        MessageFormat::Deepstream,
        r#"{"version": "4.0", "id": 418, "@timestamp": "2020-06-13T06:59:42.757Z", "sensorId": "HWY_20_AND_LOCUST",
            "objects": ["345|441.6|510|470.4|562.5|Bicycle", "195|403.2|476.25|428.8|543.75|Person",
                "957|1834|150|1918|215|Vehicle|#|sedan|Bugatti|M|blue|CA 444|California|0.8",
                "18446744073709551615|1|2|3|4|Person", "7|a|2|3|4|Person"]}"#,
    );
    let boxes: Vec<_> = reading
        .items
        .iter()
        .map(|item| match item {
            MessageItem::Detection(it) => {
                (it.target_id.as_str(), it.detected_box, it.score.map(Score::value))
            }
            MessageItem::Fix(_) => panic!("a fix"),
        })
        .collect();
    assert_eq!(
        boxes,
        [
            ("345", DetectedBox::Pixels([441.6, 510.0, 470.4, 562.5]), None),
            ("195", DetectedBox::Pixels([403.2, 476.25, 428.8, 543.75]), None),
            ("957", DetectedBox::Pixels([1834.0, 150.0, 1918.0, 215.0]), Some(0.8)),
        ]
    );
    assert_eq!(reading.skipped.len(), 2, "{:?}", reading.skipped);
}

/// The output of NVIDIA's sample `deepstream-test4`, shortened, as published in a connector's documentation; there the
/// object has no tracker (id -1).
#[test]
fn deepstreams_full_schema_has_one_object_in_a_message() {
    let full = r#"{"messageid": "ff7cc527-d019-4348-8b25-6df69c5b6dcc", "mdsversion": "1.0",
        "@timestamp": "2021-03-31T20:11:07.742Z", "sensor": {"id": "CAMERA_ID", "type": "Camera"},
        "object": {"id": "ID", "speed": 0.0, "vehicle": {"type": "sedan", "confidence": -0.10000000149011612},
            "bbox": {"topleftx": 597, "toplefty": 481, "bottomrightx": 711, "bottomrighty": 569},
            "location": {"lat": 0.0, "lon": 0.0, "alt": 0.0}}, "event": {"type": "moving"}, "videoPath": ""}"#;
    let reading = read(MessageFormat::Deepstream, &full.replace("\"ID\"", "\"12\""));
    let detection = only_detection(&reading);
    assert_eq!((detection.camera.as_str(), detection.target_id.as_str()), ("CAMERA_ID", "12"));
    assert_eq!(detection.detected_box, DetectedBox::Pixels([597.0, 481.0, 711.0, 569.0]));
    assert_eq!(detection.class.as_ref().map(TargetClass::as_str), Some("vehicle"));
    assert_eq!(detection.score, None, "a score below 0 is none");
    let reading = read(MessageFormat::Deepstream, &full.replace("\"ID\"", "\"-1\""));
    assert!(reading.items.is_empty() && reading.skipped[0].contains("nvtracker"), "{reading:?}");
}

/// The example of the ONVIF Analytics Service Specification, with y up, and a frame that a camera with y down sent.
#[test]
fn onvif_boxes_are_transformed_whatever_the_sign_of_y() {
    let stream = |transformation: &str, object: &str| {
        format!(
            r#"<?xml version="1.0" encoding="UTF-8"?><tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema">
            <tt:VideoAnalytics><tt:Frame UtcTime="2020-09-25T11:28:17.432">{transformation}{object}</tt:Frame>
            </tt:VideoAnalytics></tt:MetadataStream>"#
        )
    };
    let object = |edges: &str| {
        format!(
            r#"<tt:Object ObjectId="12"><tt:Appearance><tt:Shape><tt:BoundingBox {edges}/><tt:CenterOfGravity x="60.0"
            y="50.0"/></tt:Shape><tt:Class><tt:Type Likelihood="0.9">Human</tt:Type></tt:Class></tt:Appearance></tt:Object>"#
        )
    };
    let transformation = |x: &str, y: &str, scale_x: &str, scale_y: &str| {
        format!(
            r#"<tt:Transformation><tt:Translate x="{x}" y="{y}"/><tt:Scale x="{scale_x}" y="{scale_y}"/></tt:Transformation>"#
        )
    };
    let cases = [
        (
            transformation("-1.0", "-1.0", "0.003125", "0.00416667"),
            object(r#"left="20.0" top="180.0" right="100.0" bottom="30.0""#),
            [0.03125, 0.625, 0.15625, 0.9375],
        ),
        (
            transformation("-1.0", "1.0", "0.0002", "-0.0002"),
            object(r#"left="375" top="3112" right="1875" bottom="7445""#),
            [0.0375, 0.3112, 0.1875, 0.7445],
        ),
        (String::new(), object(r#"left="-0.5" top="0.5" right="0" bottom="-1""#), [0.25, 0.25, 0.5, 1.0]),
    ];
    for (transformation, object, expected) in cases {
        let reading = read(MessageFormat::Onvif, &stream(&transformation, &object));
        let detection = only_detection(&reading);
        let DetectedBox::Fractions(edges) = detection.detected_box else { panic!("{detection:?}") };
        for (edge, expected) in edges.into_iter().zip(expected) {
            assert!((edge - expected).abs() < 1e-5, "{edges:?}, not {expected:?}");
        }
        assert_eq!(detection.target_id.as_str(), "12");
        assert_eq!(detection.class.as_ref().map(TargetClass::as_str), Some("Human"));
        assert_eq!(detection.time.to_string(), "2020-09-25T11:28:17.432Z");
    }
    let empty = stream(&transformation("0", "0", "0", "0"), "");
    assert_eq!(read(MessageFormat::Onvif, &empty), Reading::default(), "an empty frame says nothing");
    let collapsed =
        stream(&transformation("0", "0", "0", "0"), &object(r#"left="1" top="2" right="3" bottom="4""#));
    assert!(read(MessageFormat::Onvif, &collapsed).skipped[0].contains("scale of 0"));
    assert!(decoder(MessageFormat::Onvif).decode(b"<a><b></a>", &context()).is_err());
}

/// Sentences of gpsd's documentation of AIVDM and of libais: types 1, 18 and 19. That of type 19 is also cut in two.
#[test]
fn ais_positions_are_read_also_from_two_sentences() {
    let one = "!AIVDM,1,1,,B,177KQJ5000G?tO`K>RA1wUbN0TKH,0*5C";
    let reading = read(MessageFormat::Nmea, one);
    let [(Some("477553000"), longitude, latitude, time)] = &fixes(&reading)[..] else {
        panic!("{reading:?}")
    };
    assert!(
        (longitude + 122.345_833).abs() < 1e-5 && (latitude - 47.582_833).abs() < 1e-5,
        "{longitude} {latitude}"
    );
    assert_eq!(time, "2026-06-01T12:00:15Z", "the last second 15 before the server's time");

    let payload = "C5N3SRgPEnJGEBT>NhWAwwo862PaLELTBJ:V00000000S0D:R220";
    let sentence = |count, number, payload: &str| {
        let body = format!("AIVDM,{count},{number},3,B,{payload},0");
        let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("!{body}*{checksum:02X}")
    };
    let (first, second) = payload.split_at(30);
    let (first, second) = (sentence(2, 1, first), sentence(2, 2, second));
    let mut nmea = decoder(MessageFormat::Nmea);
    let waiting = nmea.decode(first.as_bytes(), &context()).expect("a sentence");
    assert_eq!(waiting, Reading::default());
    let reading = nmea.decode(second.as_bytes(), &context()).expect("a sentence");
    let [(Some("367059850"), longitude, latitude, _)] = &fixes(&reading)[..] else { panic!("{reading:?}") };
    assert!(
        (longitude + 88.810_394).abs() < 1e-5 && (latitude - 29.543_695).abs() < 1e-5,
        "{longitude} {latitude}"
    );
    // In the other order, after an incomplete message of the same id.
    nmea.decode(second.as_bytes(), &context()).expect("a sentence");
    nmea.decode(second.as_bytes(), &context()).expect("a sentence");
    assert_eq!(nmea.decode(first.as_bytes(), &context()).expect("a sentence").items.len(), 1);

    let tagged = format!("\\s:station,c:1748779199*00\\{one}");
    assert_eq!(fixes(&read(MessageFormat::Nmea, &tagged))[0].3, "2025-06-01T11:59:15Z");
    let reading = read(MessageFormat::Nmea, &one.replace("*5C", "*5D"));
    assert!(reading.items.is_empty() && reading.skipped[0].contains("checksum"), "{reading:?}");
}

/// Longitude 181 degrees and latitude 91 degrees: "not available".
#[test]
fn ais_sentinels_are_no_positions() {
    let mut bits = [0_u8; 168];
    let mut put = |from: usize, count: usize, value: i64| {
        for at in 0..count {
            bits[from + at] = (value >> (count - 1 - at) & 1) as u8;
        }
    };
    put(0, 6, 1);
    put(8, 30, 123_456_789);
    put(61, 28, 181 * 600_000);
    put(89, 27, 91 * 600_000);
    put(137, 6, 20);
    let payload: String = bits
        .chunks(6)
        .map(|six| six.iter().fold(0, |value, bit| value << 1 | bit))
        .map(|six| char::from(if six < 40 { six + 48 } else { six + 56 }))
        .collect();
    let body = format!("AIVDM,1,1,,A,{payload},0");
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    let reading = read(MessageFormat::Nmea, &format!("!{body}*{checksum:02X}"));
    assert!(reading.items.is_empty(), "{reading:?}");
    assert_eq!(reading.skipped, ["the ship states no position"]);
}

#[test]
fn a_receivers_time_of_day_gets_its_date_from_rmc_or_from_the_server() {
    let sentence = |body: &str| {
        let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${body}*{checksum:02X}\r\n")
    };
    let gga = sentence("GPGGA,115959.00,3037.6808,N,10359.2068,E,1,08,0.9,545.4,M,46.9,M,,");
    let reading = read(MessageFormat::Nmea, &gga);
    assert_eq!(fixes(&reading)[0].3, "2026-06-01T11:59:59Z");
    let rmc = sentence("GPRMC,115958.00,A,3037.6808,N,10359.2068,E,0.5,054.7,191120,020.3,E");
    let reading = read(MessageFormat::Nmea, &format!("{rmc}{gga}"));
    assert_eq!(fixes(&reading)[0].3, "2020-11-19T11:59:59Z");
    let lost = sentence("GPGGA,115959.00,,,,,0,00,99.9,,M,,M,,");
    assert!(read(MessageFormat::Nmea, &lost).skipped[0].contains("quality 0"));
}

#[test]
fn gpsd_reports_and_traccars_positions_are_fixes() {
    let reports = concat!(
        r#"{"class":"VERSION","release":"3.22","rev":"3.22","proto_major":3,"proto_minor":14}"#,
        "\n",
        r#"{"class":"TPV","device":"/dev/ttyUSB0","mode":3,"time":"2026-06-01T12:00:19.000Z","lat":30.6280135,"lon":103.98678}"#
    );
    let reading = read(MessageFormat::Gpsd, reports);
    let [(Some("/dev/ttyUSB0"), longitude, latitude, time)] = &fixes(&reading)[..] else {
        panic!("{reading:?}")
    };
    assert_eq!((*longitude, *latitude, time.as_str()), (103.98678, 30.6280135, "2026-06-01T12:00:19Z"));

    // As Traccar's PositionForwarderJson writes it.
    let forwarded = r#"{"position": {"id": 7, "deviceId": 3, "protocol": "osmand", "fixTime": "2026-06-01T12:00:18.000+00:00",
        "outdated": false, "valid": true, "latitude": 59.4371, "longitude": 24.7453, "accuracy": 4.0, "attributes": {}},
        "device": {"id": 3, "name": "van", "uniqueId": "862531"}}"#;
    let reading = read(MessageFormat::Traccar, forwarded);
    assert_eq!(fixes(&reading), [(Some("862531"), 24.7453, 59.4371, "2026-06-01T12:00:18Z".to_owned())]);
    let reading = read(MessageFormat::Traccar, &forwarded.replace("\"valid\": true", "\"valid\": false"));
    assert!(reading.items.is_empty() && !reading.skipped.is_empty());
}

#[test]
fn a_time_ahead_of_the_servers_clock_is_refused() {
    let ahead = context().received_at.saturating_add(SignedDuration::from_secs(60)).expect("a time");
    let message = FRIGATE.replace("1607123962.082975", &format!("{}", ahead.as_second()));
    let refused = decoder(MessageFormat::Frigate).decode(message.as_bytes(), &context()).expect_err("ahead");
    assert!(refused.contains("ahead of the server's clock"), "{refused}");
}

/// Standard deviation of each fix, mm, as messages state it.
fn live_sigmas_mm(format: MessageFormat, text: &str) -> Vec<Option<i64>> {
    let reading = read(format, text);
    let sigma_mm = |item: &MessageItem| match item {
        MessageItem::Fix(it) => it.fix.sigma_m.map(|sigma| (sigma.metres() * 1e3).round() as i64),
        MessageItem::Detection(it) => panic!("{it:?}"),
    };
    reading.items.iter().map(sigma_mm).collect()
}

/// The same as a file states it.
fn filed_sigmas_mm(format: FixFormat, text: &str) -> Vec<Option<i64>> {
    let rows = read_received_fixes(text.as_bytes(), format, context().time_bounds).expect("a file");
    let sigma_mm = |row: ReceivedFix| row.fix.sigma_m.map(|sigma| (sigma.metres() * 1e3).round() as i64);
    rows.map(|row| sigma_mm(row.expect("it goes on").expect("a fix"))).collect()
}

fn sentence(body: &str) -> String {
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    let start = if body.starts_with("AI") { '!' } else { '$' };
    format!("{start}{body}*{checksum:02X}\r\n")
}

#[test]
fn nmea_messages_and_files_state_the_same_quality() {
    let rmc = sentence("GPRMC,115950.00,A,3037.6808,N,10359.2068,E,0.5,054.7,010626,020.3,E");
    let gga = |second: u32, quality: u32, hdop: &str| {
        sentence(&format!(
            "GPGGA,1159{second}.00,3037.6808,N,10359.2068,E,{quality},08,{hdop},545.4,M,46.9,M,,"
        ))
    };
    let gst = |second: u32, axes: &str| sentence(&format!("GPGST,1159{second}.00,0.01,,,,{axes},0.03"));
    let log = [
        rmc,
        gga(51, 1, "0.9"),
        gga(52, 2, "1.0"),
        gga(53, 1, ""),
        gga(54, 4, "0.9"),
        gst(54, "0.014,0.010"),
        gga(55, 4, "0.9"),
        // The ambiguities are lost: what was stated for them holds no longer.
        gga(56, 1, "0.9"),
        gst(57, "2.0,1.0"),
        gga(57, 1, "0.9"),
        gst(57, ","),
        gga(58, 1, "0.9"),
    ]
    .concat();
    let expected = [3_182, 1_414, 5_303, 19, 12, 3_182, 1_581, 3_182].map(Some);
    assert_eq!(live_sigmas_mm(MessageFormat::Nmea, &log), expected);
    assert_eq!(filed_sigmas_mm(FixFormat::Nmea, &log), expected);
}

#[test]
fn gpsd_messages_and_files_state_the_same_quality() {
    let report = |second: u32, rest: &str| {
        format!(
            r#"{{"class":"TPV","device":"a","mode":3,"time":"2026-06-01T11:59:{second}Z","lat":30.6,"lon":103.9{rest}}}"#
        )
    };
    let log = [
        report(10, ""),
        report(11, r#","epx":1.96,"epy":1.96"#),
        report(12, r#","epx":1.96,"epy":1.96,"eph":10"#),
        report(13, r#","status":3,"epx":15,"epy":15,"eph":0.02"#),
        report(14, r#","status":1"#),
        r#"{"class":"GST","device":"a","time":"2026-06-01T11:59:14Z","lat":0.3,"lon":0.4}"#.to_owned(),
        report(15, r#","status":1,"eph":10"#),
        r#"{"class":"GST","device":"b","time":"2026-06-01T11:59:16Z","lat":0.01,"lon":0.01}"#.to_owned(),
        report(16, r#","status":1,"eph":10"#),
    ]
    .join("\n");
    let expected = [None, Some(1_000), Some(4_085), Some(13), Some(5_303), Some(354), Some(4_085)];
    assert_eq!(live_sigmas_mm(MessageFormat::Gpsd, &log), expected);
    assert_eq!(filed_sigmas_mm(FixFormat::Gpsd, &log), expected);
}

#[test]
fn traccar_ais_and_gpx_state_their_quality() {
    let forwarded = |quality: &str| {
        format!(
            r#"{{"position": {{"deviceId": 3, "fixTime": "2026-06-01T12:00:18.000+00:00", "valid": true,
            "latitude": 59.4371, "longitude": 24.7453, {quality}}}}}"#
        )
    };
    let of_traccar = |quality: &str| live_sigmas_mm(MessageFormat::Traccar, &forwarded(quality));
    assert_eq!(of_traccar(r#""accuracy": 4.0, "attributes": {"hdop": 9}"#), [Some(2_650)]);
    assert_eq!(of_traccar(r#""accuracy": 0.0, "attributes": {"hdop": 0.9}"#), [Some(3_182)]);
    assert_eq!(of_traccar(r#""accuracy": 0.0, "attributes": {}"#), [None]);

    let of_ais =
        |payload: &str| live_sigmas_mm(MessageFormat::Nmea, &sentence(&format!("AIVDM,1,1,,B,{payload},0")));
    assert_eq!(of_ais("177KQJ5000G?tO`K>RA1wUbN0TKH"), [Some(10_214)], "more than 10 m");
    assert_eq!(of_ais("177KQJ5000o?tO`K>RA1wUbN0TKH"), [Some(4_085)], "10 m or less");

    let point = |rest: &str| {
        format!(r#"<trkpt lat="30.6" lon="103.9"><time>2026-06-01T11:59:50Z</time>{rest}</trkpt>"#)
    };
    let points = ["", "<hdop>0.9</hdop>", "<fix>dgps</fix><hdop>1</hdop>", "<fix>3d</fix>"].map(point);
    let gpx = format!("<gpx><trk><trkseg>{}</trkseg></trk></gpx>", points.concat());
    assert_eq!(filed_sigmas_mm(FixFormat::Gpx, &gpx), [None, Some(3_182), Some(1_414), Some(5_303)]);
}
