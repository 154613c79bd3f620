//! Frames of ONVIF's metadata streams of several makers.

use super::messages::{context, read};
use crate::{DetectedBox, MessageFormat, MessageItem, NamedDetection, Reading, decoder};

fn frame(time: &str, content: &str) -> Reading {
    let stream = format!(
        r#"<tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema"><tt:VideoAnalytics><tt:Frame UtcTime="{time}">{content}
        </tt:Frame></tt:VideoAnalytics></tt:MetadataStream>"#
    );
    read(MessageFormat::Onvif, &stream)
}

fn object(attributes: &str, transformation: &str, edges: &str) -> String {
    format!(
        r#"<tt:Object {attributes}><tt:Appearance>{transformation}<tt:Shape><tt:BoundingBox {edges}/></tt:Shape></tt:Appearance></tt:Object>"#
    )
}

fn transformation(translate: [f64; 2], scale: [f64; 2]) -> String {
    format!(
        r#"<tt:Transformation><tt:Translate x="{}" y="{}"/><tt:Scale x="{}" y="{}"/></tt:Transformation>"#,
        translate[0], translate[1], scale[0], scale[1]
    )
}

fn only(reading: &Reading) -> &NamedDetection {
    match &reading.items[..] {
        [MessageItem::Detection(detection)] => detection,
        other => panic!("{other:?} {:?}", reading.skipped),
    }
}

fn assert_edges(reading: &Reading, expected: [f64; 4]) {
    let DetectedBox::Fractions(edges) = only(reading).detected_box else { panic!("{reading:?}") };
    for (edge, expected) in edges.into_iter().zip(expected) {
        assert!((edge - expected).abs() < 1e-9, "{edges:?}, not {expected:?}");
    }
}

const TIME: &str = "2026-06-01T12:00:18.5Z";
const EDGES: &str = r#"left="100" top="50" right="300" bottom="250""#;

#[test]
fn a_part_of_another_object_is_no_target() {
    let of_frame = transformation([-1.0, 1.0], [0.002, -0.004]);
    let whole = object(r#"ObjectId="12""#, "", EDGES);
    let face = object(r#"ObjectId="13" Parent="12""#, "", EDGES);
    let reading = frame(TIME, &(of_frame + &whole + &face));
    assert_eq!(only(&reading).target_id.as_str(), "12");
    assert_edges(&reading, [0.1, 0.1, 0.3, 0.5]);
    assert_eq!(reading.skipped, ["object 13 is a part of object 12"]);
    let alone = object(r#"ObjectId="12" Parent="0""#, "", r#"left="0" top="0" right="1" bottom="-1""#);
    assert_eq!(only(&frame(TIME, &alone)).target_id.as_str(), "12");
}

#[test]
fn the_transformation_of_an_object_is_applied_before_that_of_its_frame() {
    let own = transformation([-1.0, 1.0], [0.002, -0.004]);
    let half = transformation([0.5, -0.5], [0.5, 0.5]);
    let moved = frame(TIME, &(half + &object(r#"ObjectId="12""#, &own, EDGES)));
    assert_edges(&moved, [0.55, 0.55, 0.65, 0.75]);
    let alone = frame(TIME, &object(r#"ObjectId="12""#, &own, EDGES));
    assert_edges(&alone, [0.1, 0.1, 0.3, 0.5]);
    // It holds for its object alone.
    let two = object(r#"ObjectId="12""#, &own, EDGES)
        + &object(r#"ObjectId="13""#, "", r#"left="0" top="0" right="1" bottom="-1""#);
    let reading = frame(TIME, &two);
    let MessageItem::Detection(second) = &reading.items[1] else { panic!("{reading:?}") };
    assert_eq!(second.detected_box, DetectedBox::Fractions([0.5, 0.5, 1.0, 1.0]));
}

#[test]
fn edges_beyond_1_without_a_transformation_are_counted_to_8191() {
    let edges = r#"left="0" top="4095.5" right="819.1" bottom="8191""#;
    assert_edges(&frame(TIME, &object(r#"ObjectId="12""#, "", edges)), [0.0, 0.5, 0.1, 1.0]);
}

#[test]
fn times_have_offsets_of_either_sign_or_none() {
    let object = object(r#"ObjectId="12""#, "", r#"left="-0.5" top="0.5" right="0" bottom="-1""#);
    for time in [
        "2026-06-01T12:00:18.5Z",
        "2026-06-01T12:00:18.5",
        "2026-06-01T20:00:18.5+08:00",
        "2026-06-01T07:00:18.5-05:00",
    ] {
        assert_eq!(only(&frame(time, &object)).time.to_string(), TIME, "{time}");
    }
}

/// The example of the Analytics Service Specification (chapter "ONVIF Metadata in JSON over MQTT"), with a class of what the
/// person carries beside it.
#[test]
fn frames_in_json_are_read_as_those_in_xml() {
    let stream = r##"{"Frame": [{"@UtcTime": "2021-10-05T15:13:27.321", "@Source": "MyClassifier",
        "@context": {"acme": "http://www.acme.com/schema"},
        "Transformation": {"Translate": {"@x": -1.0, "@y": -1.0}, "Scale": {"@x": 0.003125, "@y": 0.00416667}},
        "Object": [{"@ObjectId": 15, "Appearance": {
            "BarcodeInfo": {"Type": "QRCode"},
            "Shape": {"BoundingBox": {"@left": 20.0, "@top": 80.0, "@right": 100.0, "@bottom": 30.0},
                "CenterOfGravity": {"@x": 60.0, "@y": 50.0}},
            "Class": {"Type": [{"@Likelihood": 0.8, "#text": "Human"}]}}}]}]}"##;
    let reading = read(MessageFormat::Onvif, stream);
    let detection = only(&reading);
    assert_eq!((detection.camera.as_str(), detection.target_id.as_str()), ("MyClassifier", "15"));
    assert_eq!(detection.time.to_string(), "2021-10-05T15:13:27.321Z");
    assert_eq!(detection.class.as_ref().map(|class| class.as_str()), Some("Human"));
    assert_eq!(detection.score.map(|score| score.value()), Some(0.8));
    // 640 x 480 px with y up.
    let DetectedBox::Fractions(edges) = detection.detected_box else { panic!("{detection:?}") };
    for (edge, expected) in edges.into_iter().zip([20.0 / 640.0, 400.0 / 480.0, 100.0 / 640.0, 450.0 / 480.0])
    {
        assert!((edge - expected).abs() < 1e-6, "{edges:?}");
    }
    assert!(decoder(MessageFormat::Onvif).decode(b"{\"Frame\": [", &context()).is_err());
    let without_edge = stream.replace("\"@left\": 20.0", "\"@left\": null");
    let refused = decoder(MessageFormat::Onvif).decode(without_edge.as_bytes(), &context());
    assert!(refused.is_err_and(|reason| reason.contains("attribute left")));
}
