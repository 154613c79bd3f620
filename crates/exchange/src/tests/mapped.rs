//! JSON by a mapping, and what a source takes of its detections.

use serde_json::{Value, json};

use super::messages::{context, fixes, sigmas_mm};
use crate::domain::{Error, Score, TargetClass};
use crate::{ConnectionSettings, DetectedBox, MessageItem, NamedDetection, Reading, Secrets, source_decoder};

fn settings(rest: &Value) -> ConnectionSettings {
    let mut source = json!({"address": "push:", "format": "json", "camera_ids": ["gate"]});
    source.as_object_mut().expect("an object").extend(rest.as_object().expect("an object").clone());
    serde_json::from_value(json!({"source": source})).expect("settings")
}

fn read(rest: &Value, message: &str) -> Result<Reading, String> {
    let settings = settings(rest);
    settings.check(&Secrets::default()).expect("they can work");
    source_decoder(&settings.source.expect("a source")).decode(message.as_bytes(), &context())
}

fn detections(reading: &Reading) -> Vec<&NamedDetection> {
    let items = reading.items.iter();
    let detections = items.map(|item| match item {
        MessageItem::Detection(detection) => detection,
        other => panic!("{other:?}"),
    });
    detections.collect()
}

/// The example of Axis' Message Broker before AXIS OS 12.8, topic com.axis.analytics_scene_description.v0.beta, without its
/// images.
const AXIS: &str = r#"{"frame": {"timestamp": "2023-03-08T09:00:19.320111Z", "observations": [
    {"track_id": "1", "bounding_box": {"bottom": 0.89332, "left": 0.13332, "right": 0.80004, "top": 0.59942},
     "class": {"type": "Human", "score": 0.6, "upper_clothing_colors": [{"name": "White", "score": 0.78}]}},
    {"track_id": "2", "bounding_box": {"bottom": 0.49932, "left": 0.23135, "right": 0.55192, "top": 0.19399},
     "class": {"type": "Bus", "score": 0.7, "colors": [{"name": "Yellow", "score": 0.78}]}},
    {"track_id": "3", "bounding_box": {"bottom": 0.5, "left": 0.2, "right": 0.5, "top": 0.1}}]}}"#;

fn axis() -> Value {
    json!({
        "items": "/frame/observations", "time": "/frame/timestamp", "target": "/track_id", "class": "/class/type",
        "score": "/class/score", "bounding_box": {"unit": "share", "form": "corners",
            "sides": ["/bounding_box/left", "/bounding_box/top", "/bounding_box/right", "/bounding_box/bottom"]},
    })
}

#[test]
fn frames_of_axis_are_read_by_a_mapping() {
    let reading = read(&json!({"mapping": axis()}), AXIS).expect("a frame");
    let seen = detections(&reading);
    assert_eq!(seen.iter().map(|it| it.target_id.as_str()).collect::<Vec<_>>(), ["1", "2", "3"]);
    assert_eq!(seen[0].time.to_string(), "2023-03-08T09:00:19.320111Z");
    let DetectedBox::Fractions(edges) = seen[0].detected_box else { panic!("{:?}", seen[0]) };
    for (edge, expected) in edges.into_iter().zip([0.13332, 0.59942, 0.80004, 0.89332]) {
        assert!((edge - expected).abs() < 1e-12, "{edges:?}");
    }
    assert_eq!(seen[1].class.as_ref().map(TargetClass::as_str), Some("Bus"));
    assert_eq!(seen[1].score.map(Score::value), Some(0.7));
    assert_eq!((&seen[2].class, seen[2].score), (&None, None));
}

/// A frame of axis.scene.frame_v1, by its documentation and by what a camera with AXIS OS 12.11 was seen to send.
#[test]
fn frames_of_axis_since_12_8_are_read_by_a_mapping() {
    let mut mapping = axis();
    for (field, pointer) in [("items", "/detections"), ("time", "/timestamp"), ("target", "/object_track_id")]
    {
        mapping[field] = json!(pointer);
    }
    let mapping = json!({"mapping": mapping});
    let frame = r#"{"channel_id": 1, "timestamp": "2026-05-29T11:55:30.369150Z", "detections": [
        {"object_track_id": "8e653185-8e54-4dca-8af1-9f7202aca120",
         "bounding_box": {"left": 0.4499, "top": 0.2365, "right": 0.7473, "bottom": 0.9853},
         "class": {"type": "Human", "score": 0.7, "upper_clothing_colors": []}}],
        "track_events": [{"type": "TrackEnded", "object_track_id": "0"}]}"#;
    let reading = read(&mapping, frame).expect("a frame");
    let [seen] = detections(&reading)[..] else { panic!("{reading:?}") };
    assert_eq!(seen.target_id.as_str(), "8e653185-8e54-4dca-8af1-9f7202aca120");
    assert_eq!(seen.time.to_string(), "2026-05-29T11:55:30.36915Z");
    assert_eq!(seen.class.as_ref().map(TargetClass::as_str), Some("Human"));
    let empty =
        read(&mapping, r#"{"channel_id": 1, "timestamp": "2026-05-29T11:55:32.4Z"}"#).expect("a frame");
    assert_eq!(empty, Reading { items: Vec::new(), skipped: vec!["has nothing at /detections".to_owned()] });
}

#[test]
fn a_source_takes_some_classes_and_scores() {
    let taken = |rest: Value| {
        let mut source = json!({"mapping": axis()});
        source.as_object_mut().expect("an object").extend(rest.as_object().expect("an object").clone());
        let reading = read(&source, AXIS).expect("a frame");
        let targets = detections(&reading).iter().map(|it| it.target_id.to_string()).collect::<Vec<_>>();
        (targets.join(" "), reading.skipped)
    };
    let (targets, skipped) = taken(json!({"classes": ["human", "bicycle"]}));
    assert_eq!((targets.as_str(), skipped.len()), ("1 3", 1), "what has no class is taken");
    assert!(skipped[0].contains("class Bus"), "{skipped:?}");
    let (targets, skipped) = taken(json!({"least_score": 0.65}));
    assert_eq!((targets.as_str(), skipped.len()), ("2 3", 1), "what has no score is taken");
    assert!(skipped[0].contains("0.6"), "{skipped:?}");
}

#[test]
fn numbers_of_a_message_may_be_of_the_whole_message_and_of_any_form() {
    let mapping = json!({"mapping": {
        "items": "/objects", "time": "/ts", "camera": "/cam", "target": "/id",
        "bounding_box": {"form": "centre", "sides": ["/box/0", "/box/1", "/box/2", "/box/3"]},
    }});
    let message = r#"{"ts": 1698501145514000000, "cam": 7, "objects": [{"id": 12, "box": [100, 50, "20", 10]}, {"id": 13},
        {"id": 14, "box": [1, 2, 3, "wide"]}, 15]}"#;
    let reading = read(&mapping, message).expect("a frame");
    let [seen] = detections(&reading)[..] else { panic!("{reading:?}") };
    assert_eq!((seen.camera.as_str(), seen.target_id.as_str()), ("7", "12"));
    assert_eq!(seen.time.to_string(), "2023-10-28T13:52:25.514Z", "nanoseconds");
    assert_eq!(seen.detected_box, DetectedBox::Pixels([90.0, 45.0, 110.0, 55.0]));
    assert_eq!(
        reading.skipped,
        [
            "an item has no bounding_box at /box/0",
            "has at /box/3 `\"wide\"`, which is not of that kind",
            "an item has no target at /id",
        ]
    );
    for (wrong, reason) in [("[]", "nothing at /objects"), (r#"{"objects": 1}"#, "no array"), ("{", "JSON")] {
        let refused = read(&mapping, wrong).expect_err("no such message");
        assert!(refused.contains(reason), "{refused}");
    }
}

#[test]
fn a_mapping_reads_fixes_too() {
    let mapping = |error: &str| json!({"mapping": {"receiver": "/name", "longitude_deg": "/pos/lng", "latitude_deg": "/pos/lat", error: "/pos/error"}});
    let message = r#"{"name": "tractor", "pos": {"lng": 103.98678, "lat": 30.628, "error": 4}}"#;
    let reading = read(&mapping("sigma_m"), message).expect("a fix");
    let time = "2026-06-01T12:00:20.5Z".to_owned();
    assert_eq!(fixes(&reading), [(Some("tractor"), 103.98678, 30.628, time)], "of the time at which it came");
    assert_eq!(sigmas_mm(&reading), [Some(4_000)]);
    assert_eq!(sigmas_mm(&read(&mapping("radius_68_m"), message).expect("a fix")), [Some(2_650)]);
}

#[test]
fn a_mapping_that_cannot_work_is_refused_with_its_field() {
    let sides = json!({"form": "corners", "sides": ["/a", "/b", "/c", "/d"]});
    for (rest, field) in [
        (json!({}), "source.mapping"),
        (
            json!({"format": "phone", "mapping": {"longitude_deg": "/a", "latitude_deg": "/b"}}),
            "source.mapping",
        ),
        (json!({"mapping": {}}), "source.mapping.bounding_box"),
        (json!({"mapping": {"longitude_deg": "/a"}}), "source.mapping.bounding_box"),
        (json!({"mapping": {"bounding_box": sides}}), "source.mapping.target"),
        (
            json!({"mapping": {"bounding_box": sides, "target": "/id", "longitude_deg": "/a"}}),
            "source.mapping.bounding_box",
        ),
        (json!({"mapping": {"longitude_deg": "a", "latitude_deg": "/b"}}), "source.mapping.longitude_deg"),
        (json!({"mapping": axis(), "least_score": 2}), "source.least_score"),
        (json!({"mapping": axis(), "classes": [""]}), "source.classes"),
        (json!({"mapping": axis(), "receiver_from": "talker"}), "source.receiver_from"),
    ] {
        let refused = settings(&rest).check(&Secrets::default()).expect_err("they cannot work");
        let Error::Refused(refusal) = &refused else { panic!("{refused}") };
        assert_eq!(refusal.violations[0].field, field, "{rest}: {refused}");
    }
}
