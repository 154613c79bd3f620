//! Files of boxes by the number of their frame.

use super::rules;
use crate::{FrameClock, FrameFileFormat, read_frame_file};

fn shown(text: &str, format: FrameFileFormat) -> Vec<String> {
    let clock = FrameClock::new("2025-06-01T12:00:00Z".parse().expect("a time"), 10.0).expect("a clock");
    read_frame_file(text.as_bytes(), format, clock, rules())
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

/// Lines in the form of the MOT challenge's results, and wrong ones.
#[test]
fn motchallenge_counts_frames_and_pixels_from_1() {
    let text = "1, 3, 794.27, 247.59, 71.245, 174.88, -1, -1, -1, -1\n11,6,1648.1,119.61,66.504,163.24,0.9,-1,-1,-1\n\n\
        2,-1,1,1,10,20,1\n0,1,1,1,10,20,1\n3,1,left,1,10,20,1\n4,1,1,1,-10,20,1\n";
    let rows = shown(text, FrameFileFormat::Mot);
    assert_eq!(rows[0], "2025-06-01T12:00:00Z 3 [793.27, 246.59, 71.245, 174.88] - -");
    assert_eq!(rows[1], "2025-06-01T12:00:01Z 6 [1647.1, 118.61, 66.504, 163.24] - 0.9");
    assert_eq!(rows[2], "line 4: target_id: is -1: no tracker has followed the box");
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
    assert_eq!(rows[0], "line 1: target_id: is -1: no tracker has followed the box");
    assert!(rows[1].starts_with("2025-06-01T12:00:00Z 0 [296.744956, 161.752147, 158.48"), "{}", rows[1]);
    assert!(rows[1].ends_with("Van -"));
    assert_eq!(rows[2], "2025-06-01T12:00:00.5Z 1 [737.0, 161.0, 194.0, 213.0] Cyclist 0.75");
    for rate in [0.0, -1.0, f64::NAN, 1e9] {
        assert!(FrameClock::new("2025-06-01T12:00:00Z".parse().expect("a time"), rate).is_err(), "{rate}");
    }
}
