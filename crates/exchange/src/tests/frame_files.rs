//! Files of boxes by the number of their frame.

use super::rules;
use crate::domain::ImageSize;
use crate::{FrameClock, FrameFileFormat, RowRules, frame_number, read_frame_file};

/// Ten frames per second from noon on.
fn clock() -> FrameClock {
    FrameClock::new("2025-06-01T12:00:00Z".parse().expect("a time"), 10.0).expect("a clock")
}

fn shown(text: &str, format: FrameFileFormat) -> Vec<String> {
    shown_with(text, format, clock(), rules())
}

fn shown_with(text: &str, format: FrameFileFormat, clock: FrameClock, rules: RowRules) -> Vec<String> {
    read_frame_file(text.as_bytes(), format, clock, rules)
        .map(|row| match row.expect("it goes on") {
            Ok(it) => {
                let class = it.class.as_ref().map_or("-", |class| class.as_str());
                let score = it.score.map_or("-".to_owned(), |score| score.value().to_string());
                format!("{} {} {:?} {class} {score}", it.time, it.target_id, it.bounding_box.sides_px())
            }
            Err(fault) => format!("line {}: {}: {}", fault.line, fault.field, fault.reason),
        })
        .collect()
}

const UNTRACKED: &str = "line N: target_id: is missing: no tracker has followed the box";

/// Lines in the form of the MOT challenge's results, and wrong ones.
#[test]
fn motchallenge_counts_frames_and_pixels_from_1() {
    let text = "1, 3, 794.27, 247.59, 71.245, 174.88, -1, -1, -1, -1\n11,6,1648.1,119.61,66.504,163.24,0.9,-1,-1,-1\n\n\
        2,-1,1,1,10,20,1\n0,1,1,1,10,20,1\n3,1,left,1,10,20,1\n4,1,1,1,-10,20,1\n";
    let rows = shown(text, FrameFileFormat::Mot);
    assert_eq!(rows[0], "2025-06-01T12:00:00Z 3 [793.27, 246.59, 71.245, 174.88] - -");
    assert_eq!(rows[1], "2025-06-01T12:00:01Z 6 [1647.1, 118.61, 66.504, 163.24] - 0.9");
    assert_eq!(rows[2], UNTRACKED.replace("N", "4"));
    assert_eq!(rows[3], "line 5: frame: must be at least 1");
    assert_eq!(rows[4], "line 6: bounding_box: `left` is not such a number");
    assert!(rows[5].starts_with("line 7: bounding_box.width_px"), "{}", rows[5]);
}

/// Lines in the form of KITTI's tracking labels.
#[test]
fn kitti_counts_frames_and_pixels_from_0() {
    let text = "0 -1 DontCare -1 -1 -10.000000 219.310000 188.490000 245.500000 218.560000 -1000 -1000 -1000 -10 -1 -1 -1\n\
        0 0 Van 0 0 -1.793451 296.744956 161.752147 455.226042 292.372804 2.000000 1.823255 4.433886 -4.552284 1.858523 13.410495 -2.115488\n\
        5 1 Cyclist 0 0 -1.936993 737 161 931 374 1.739063 0.824591 1.785241 1.640400 1.675660 5.776261 -1.675458 0.75\n";
    let rows = shown(text, FrameFileFormat::Kitti);
    assert_eq!(rows[0], UNTRACKED.replace("N", "1"));
    assert!(rows[1].starts_with("2025-06-01T12:00:00Z 0 [296.744956, 161.752147, 158.48"), "{}", rows[1]);
    assert!(rows[1].ends_with("Van -"));
    assert_eq!(rows[2], "2025-06-01T12:00:00.5Z 1 [737.0, 161.0, 194.0, 213.0] Cyclist 0.75");
    for rate in [0.0, -1.0, f64::NAN, 1e9] {
        assert!(FrameClock::new("2025-06-01T12:00:00Z".parse().expect("a time"), rate).is_err(), "{rate}");
    }
}

/// Lines as Ultralytics writes them with `save_txt`, with and without `save_conf`, and by a detector without a tracker.
#[test]
fn yolo_states_shares_of_the_image_of_one_frame() {
    let sized = RowRules { image_size: Some(ImageSize::new(1920, 1080).expect("a size")), ..rules() };
    let text = "0 0.5 0.5 0.1 0.2 7\n2 0.25 0.5 0.1 0.2 0.875 8\n0 0.5 0.5 0.1 0.2 0.875\n0 0.5 0.5 0.1 0.2\n0 half 0.5 0.1 0.2 7\n";
    let later = clock().after(25).expect("a time");
    let rows = shown_with(text, FrameFileFormat::Yolo, later, sized);
    assert_eq!(rows[0], "2025-06-01T12:00:02.5Z 7 [864.0, 432.0, 192.0, 216.0] 0 -");
    assert_eq!(rows[1], "2025-06-01T12:00:02.5Z 8 [384.0, 432.0, 192.0, 216.0] 2 0.875");
    assert_eq!(rows[2..4], [UNTRACKED.replace("N", "3"), UNTRACKED.replace("N", "4")]);
    assert_eq!(rows[4], "line 5: bounding_box: `half` is not such a number");
    let unsized_rules = RowRules { image_size: None, ..rules() };
    let rows = shown_with("0 0.5 0.5 0.1 0.2 7", FrameFileFormat::Yolo, clock(), unsized_rules);
    assert_eq!(rows, ["line 1: image_size: is required: the boxes are shares of the image"]);
    assert_eq!(["gate_000012", "7", "gate", "v2_x"].map(frame_number), [Some(12), Some(7), None, None]);
}

/// Annotations in the forms of COCO-VID (`instance_id`), of TAO (`track_id`) and of CVAT's export (`attributes`).
#[test]
fn coco_has_tracks_in_three_places_and_frames_in_two() {
    let document = r#"{"images": [{"id": 5, "file_name": "gate/frame_000101.jpg", "width": 1920, "height": 1080},
        {"id": 6, "file_name": "gate/frame_000100.jpg"}, {"id": 7, "file_name": "x.jpg", "frame_id": 110}, {"id": 8}],
        "categories": [{"id": 1, "name": "person", "supercategory": ""}],
        "annotations": [{"id": 1, "image_id": 5, "category_id": 1, "bbox": [10, 20, 30.5, 40], "track_id": 3, "iscrowd": 0},
        {"id": 2, "image_id": 6, "category_id": 2, "bbox": [10, 20, 30, 40], "instance_id": "a", "score": 0.75},
        {"id": 3, "image_id": 7, "category_id": 1, "bbox": [10, 20, 30, 40], "attributes": {"occluded": false, "track_id": 4}},
        {"id": 4, "image_id": 7, "bbox": [10, 20, 30, 40]}, {"id": 5, "image_id": 8, "bbox": [10, 20, 30, 40], "track_id": 5},
        {"id": 6, "image_id": 5, "bbox": [], "track_id": 5}]}"#;
    let rows = shown(document, FrameFileFormat::Coco);
    assert_eq!(rows[0], "2025-06-01T12:00:00.1Z 3 [10.0, 20.0, 30.5, 40.0] person -");
    assert_eq!(rows[1], "2025-06-01T12:00:00Z a [10.0, 20.0, 30.0, 40.0] - 0.75");
    assert_eq!(rows[2], "2025-06-01T12:00:01Z 4 [10.0, 20.0, 30.0, 40.0] person -");
    assert_eq!(rows[3], UNTRACKED.replace("N", "4"));
    assert_eq!(rows[4], "line 5: image_id: 8: no image of this id has the number of a frame");
    assert_eq!(rows[5], "line 6: bbox: must be left, top, width and height");
    let two_videos = r#"{"images": [{"id": 1, "video_id": 1}, {"id": 2, "video_id": 2}], "annotations": []}"#;
    for (document, part) in [(two_videos, "several videos"), ("[]", "not COCO"), ("{", "not COCO")] {
        let mut rows = read_frame_file(document.as_bytes(), FrameFileFormat::Coco, clock(), rules());
        let refused = rows.next().expect("an error").expect_err("refused");
        assert!(refused.to_string().contains(part), "{refused}");
    }
}

/// An export of CVAT for video 1.1, by its documentation.
#[test]
fn cvat_for_video_has_a_box_per_track_and_frame() {
    let document = r#"<?xml version="1.0" encoding="utf-8"?>
<annotations><version>1.1</version><meta><task><name>gate</name></task></meta>
<track id="0" label="person" source="manual">
<box frame="0" keyframe="1" outside="0" occluded="0" xtl="10.5" ytl="20.0" xbr="40.5" ybr="80.0" z_order="0"><attribute name="a">b</attribute></box>
<box frame="5" keyframe="1" outside="1" occluded="0" xtl="10.5" ytl="20.0" xbr="40.5" ybr="80.0" z_order="0"/></track>
<track id="1" label="car"><box frame="7" outside="0" xtl="left" ytl="20" xbr="40" ybr="80"/><box frame="-1" outside="0" xtl="1" ytl="2" xbr="4" ybr="8"/>
<box frame="20" outside="0" xtl="100" ytl="200" xbr="400" ybr="800"/></track></annotations>"#;
    let rows = shown(document, FrameFileFormat::Cvat);
    assert_eq!(rows[0], "2025-06-01T12:00:00Z 0 [10.5, 20.0, 30.0, 60.0] person -");
    assert_eq!(rows[1], "line 6: bounding_box: the attribute xtl is `left`, which is not a number");
    assert_eq!(rows[2], "line 6: frame: must be a whole number from 0");
    assert_eq!(rows[3], "2025-06-01T12:00:02Z 1 [100.0, 200.0, 300.0, 600.0] car -");
    assert_eq!(rows.len(), 4);
    let endless = format!("<annotations><track id=\"{}\"", "1".repeat(100_000));
    for (document, part) in
        [("<annotations><image id=\"0\"/>", "for images"), ("<a></b>", "not XML"), (&endless, "64 KiB")]
    {
        let mut rows = read_frame_file(document.as_bytes(), FrameFileFormat::Cvat, clock(), rules());
        let refused = rows.next().expect("an error").expect_err("refused");
        assert!(refused.to_string().contains(part) && rows.next().is_none(), "{refused}");
    }
}
