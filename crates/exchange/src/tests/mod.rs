//! Readers and writers through their public interface.

mod addresses;
mod fixes;
mod frame_files;
mod mapped;
mod messages;
mod onvif;
mod phones;
mod receivers;

use std::fs::File;
use std::path::PathBuf;

use jiff::Timestamp;
use proptest::prelude::*;

use super::*;
use crate::domain::{
    BoundingBox, Confidences, ErrorKind, Fix, Flag, FusedFix, ImageSize, Score, SigmaM, StoredSample,
    TargetClass, TargetId, TimeBounds,
};
use crate::geo::{PlaneCovariance, Position};

fn rules() -> RowRules {
    let now: Timestamp = "2026-01-01T00:00:00Z".parse().expect("an instant");
    RowRules { time_bounds: TimeBounds::at(now), image_size: None }
}

type Rows = Vec<Result<StoredSample, RowError>>;

fn read(text: &[u8], format: Format) -> crate::domain::Result<Rows> {
    read_samples(text, format, &rules())?.collect()
}

fn rows(text: &str, format: Format) -> Rows {
    read(text.as_bytes(), format).expect("a file that can be read")
}

fn row_error(text: &str, format: Format) -> RowError {
    let mut faults = rows(text, format).into_iter().filter_map(Result::err);
    let fault = faults.next().expect("a row at fault");
    assert_eq!(faults.next(), None);
    fault
}

const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude";
const GOOD: &str = "2020-12-14T14:41:48+08:00,person-1,475,11,28,77,103.98678000,30.62801350";
const GOOD_JSON: &str = r#"{"time":"2020-12-14T14:41:48+08:00","target_id":"person-1","bounding_box":{"left_px":475,"top_px":11,"width_px":28,"height_px":77},"fix":{"longitude_deg":103.98678,"latitude_deg":30.6280135}}"#;

/// Degrees to 1e-8, as a file has them.
fn degrees(limit: i64) -> impl Strategy<Value = f64> {
    (-limit * 100_000_000..=limit * 100_000_000).prop_map(|units| {
        format!(
            "{}{}.{:08}",
            if units < 0 { "-" } else { "" },
            units.abs() / 100_000_000,
            units.abs() % 100_000_000
        )
        .parse()
        .expect("a number")
    })
}

fn position() -> impl Strategy<Value = Position> {
    (degrees(179), degrees(89))
        .prop_map(|(longitude, latitude)| Position::new(longitude, latitude).expect("within range"))
}

fn pixels(range: std::ops::Range<i32>) -> impl Strategy<Value = f64> {
    range.prop_map(|tenths| f64::from(tenths) / 8.0)
}

prop_compose! {
    fn sample()(
        microsecond in 400_000_000_000_000_i64..1_700_000_000_000_000,
        target in "[a-zé,\"][a-z \",]{0,6}[a-z\",]",
        (left, top) in (pixels(-100..9000), pixels(-100..9000)),
        (width, height) in (pixels(1..9000), pixels(1..9000)),
        place in prop::option::of(position()),
        sigma in prop::option::of(0.001..10_000.0),
        class in prop::option::of("[a-z]{1,9}"),
        score in prop::option::of(0.0..=1.0),
        truth in prop::option::of(position()),
    ) -> StoredSample {
        StoredSample {
            time: Timestamp::from_microsecond(microsecond).expect("within range"),
            target_id: TargetId::new(&target).expect("a name"),
            bounding_box: BoundingBox::new(left, top, width, height).expect("a box"),
            fix: place.map(|position| Fix {
                position,
                sigma_m: sigma.map(|s| SigmaM::new(decimal(s)).expect("a sigma")),
            }),
            class: class.map(|name| TargetClass::new(&name).expect("a name")),
            score: score.map(|score| Score::new(decimal(score)).expect("a score")),
            truth,
        }
    }
}

/// The same to 6 decimals, so that every reader of decimals agrees on its bits.
fn decimal(value: f64) -> f64 {
    format!("{value:.6}").parse().expect("a number")
}

proptest! {
    #[test]
    fn written_samples_are_read(samples in prop::collection::vec(sample(), 0..20)) {
        for format in [Format::Csv, Format::Ndjson, Format::Json] {
            let file = write_samples(Vec::new(), format, &samples).expect("memory");
            let back = read(&file, format).expect("own writing");
            let back: Result<Vec<StoredSample>, RowError> = back.into_iter().collect();
            prop_assert_eq!(back.as_ref(), Ok(&samples), "{:?}", format);
        }
    }

    #[test]
    fn geojson_has_longitude_first(samples in prop::collection::vec(sample(), 0..5)) {
        let file = write_samples(Vec::new(), Format::GeoJson, &samples).expect("memory");
        let text = String::from_utf8(file).expect("UTF-8");
        let collection: geojson::FeatureCollection = text.parse::<geojson::GeoJson>().expect("GeoJSON")
            .try_into().expect("a collection");
        prop_assert_eq!(collection.features.len(), samples.len());
        for (feature, sample) in collection.features.iter().zip(&samples) {
            prop_assert_eq!(feature.property("target_id").and_then(|id| id.as_str()), Some(sample.target_id.as_str()));
            let Some(fix) = sample.fix else {
                prop_assert!(feature.geometry.is_none());
                continue;
            };
            let geometry = feature.geometry.as_ref().expect("a geometry");
            let geojson::GeometryValue::Point { coordinates: place } = &geometry.value else { panic!("{geometry:?}") };
            let at = fix.position;
            prop_assert!((place[0] - at.longitude_deg()).abs() < 1e-9);
            prop_assert!((place[1] - at.latitude_deg()).abs() < 1e-9);
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        for format in Format::ALL {
            for begin in ["", HEADER, "[", "{\"samples\":["] {
                let text = [begin.as_bytes(), b"\n", &bytes].concat();
                let _ = read(&text, format);
                if let Ok(rows) = read_observations(&text[..], format, &rules()) {
                    rows.for_each(drop);
                }
            }
        }
        for format in [FixFormat::Csv, FixFormat::Nmea] {
            for begin in ["", "$GPGGA,", "longitude,latitude\n"] {
                let text = [begin.as_bytes(), &bytes].concat();
                if let Ok(rows) = read_fixes(&text[..], format, rules().time_bounds) {
                    rows.for_each(drop);
                }
            }
        }
    }

    #[test]
    fn an_invalid_row_does_not_affect_the_others(bad in "[^\n\r,]{1,80}", before in 0..4_usize, after in 0..4_usize) {
        // A byte order mark alone is no more than a blank line.
        prop_assume!(!bad.trim_matches(|it: char| it.is_whitespace() || it == '\u{feff}').is_empty());
        let expect = |rows: Rows| {
            assert_eq!(rows.len(), before + 1 + after, "{rows:?}");
            assert_eq!(rows.iter().filter(|row| row.is_err()).count(), 1);
            assert!(rows[before].is_err());
        };
        let lines = |good: &str| [vec![good; before], vec![bad.as_str()], vec![good; after]].concat().join("\n");
        expect(rows(&format!("{HEADER}\n{}", lines(GOOD)), Format::Csv));
        expect(rows(&lines(GOOD_JSON), Format::Ndjson));
        let shut = bad.replace(['"', '{', '}', '[', ']'], "");
        let elements = [vec![GOOD_JSON; before], vec![shut.as_str()], vec![GOOD_JSON; after]].concat().join(",");
        if !shut.trim().is_empty() {
            expect(rows(&format!("[{elements}]"), Format::Json));
        }
    }
}

#[test]
fn invalid_fields_are_named() {
    for (row, line, field) in [
        ("2020-12-14T14:41:48+08:00,person-1,475,11,28,77,181,30.6", 2, "longitude"),
        ("2020-12-14T14:41:48+08:00,person-1,475,11,28,77,103,91", 2, "latitude"),
        ("2020-12-14T14:41:48+08:00,person-1,475,11,0,77,103,30", 2, "width"),
        ("2020-12-14T14:41:48+08:00,person-1,1e39,11,28,77,103,30", 2, "left"),
        ("2020-12-14T14:41:48+08:00,person-1,NaN,11,28,77,103,30", 2, "left"),
        ("2020-12-14T14:41:48+08:00,person-1,475,inf,28,77,103,30", 2, "top"),
        ("2020-12-14T14:41:48+08:00,person-1,475,eleven,28,77,103,30", 2, "top"),
        ("2020-12-14T14:41:48,person-1,475,11,28,77,103,30", 2, "time"),
        ("2099-12-14T14:41:48Z,person-1,475,11,28,77,103,30", 2, "time"),
        ("2020-12-14T14:41:48Z,,475,11,28,77,103,30", 2, "target_id"),
        ("2020-12-14T14:41:48Z,person-1,475,,28,77,103,30", 2, "top"),
        ("2020-12-14T14:41:48Z,person-1,,,,,103,30", 2, "left"),
        ("2020-12-14T14:41:48Z,person-1,475,11,28,77,103,", 2, "latitude"),
        ("2020-12-14T14:41:48Z,person-1,475,11,28,77,,30", 2, "longitude"),
        ("2020-12-14T14:41:48Z,person-1,475,11,28,77,103", 2, ""),
        ("2020-12-14T14:41:48Z,person-1,475,11,28,77,103,30,5", 2, ""),
    ] {
        let error = row_error(&format!("{HEADER}\n{row}\n{GOOD}\n"), Format::Csv);
        assert_eq!((error.line, error.field.as_str()), (line, field), "{row}: {error:?}");
    }
    for (from, to, field) in [
        ("103.98678", "181", "fix.longitude_deg"),
        ("\"fix\":{\"longitude_deg\":103.98678", "\"fix\":{\"longitude_deg\":\"x\"", "fix.longitude_deg"),
        ("28", "1e999", "bounding_box.width_px"),
        ("\"top_px\":11,", "", "bounding_box.top_px"),
        ("\"top_px\":11,", "\"top_px\":11,\"roll\":1,", "bounding_box.roll"),
        ("\"target_id\"", "\"target\"", "target"),
        ("\"target_id\":\"person-1\",", "", "target_id"),
        ("\"person-1\"", "7", "target_id"),
        ("\"longitude_deg\":103.98678,", "", "fix.longitude_deg"),
        ("\"longitude_deg\":103.98678,\"latitude_deg\":30.6280135", "", "fix.longitude_deg"),
        ("2020-12-14T14:41:48+08:00", "2020-12-14T14:41:48", "time"),
    ] {
        let bad = GOOD_JSON.replace(from, to);
        for (text, format) in [
            (format!("{GOOD_JSON}\n{bad}\n"), Format::Ndjson),
            (format!("[{GOOD_JSON},\n{bad}]"), Format::Json),
            (format!("{{\"samples\":[{GOOD_JSON},{bad}]}}"), Format::Json),
        ] {
            let error = row_error(&text, format);
            assert_eq!((error.line, error.field.as_str()), (2, field), "{bad}: {error:?}");
        }
    }
}

#[test]
fn a_row_without_longitude_and_latitude_is_a_sample_without_a_fix() {
    let (before, after) = ("2020-12-14T14:41:48+08:00,person-1,475,11,28,77", "\n");
    let bare = GOOD_JSON.replace(",\"fix\":{\"longitude_deg\":103.98678,\"latitude_deg\":30.6280135}", "");
    let null = bare.replace("\"bounding_box\"", "\"fix\":null,\"bounding_box\"");
    let documents = [
        (format!("{HEADER}\n{before},,{after}"), Format::Csv),
        (format!("{HEADER},sigma_m\n{before},,,2.5{after}"), Format::Csv),
        (format!("time,target_id,left,top,width,height\n{before}{after}"), Format::Csv),
        (bare.clone(), Format::Ndjson),
        (format!("[{null}]"), Format::Json),
    ];
    let with_fix = rows(GOOD_JSON, Format::Ndjson).remove(0).expect("a sample");
    for (text, format) in documents {
        let read = rows(&text, format);
        assert_eq!(read, [Ok(StoredSample { fix: None, ..with_fix.clone() })], "{text}");
    }
}

#[test]
fn an_unreadable_file_is_refused_as_a_whole() {
    for (text, format, reason) in [
        ("", Format::Csv, "empty"),
        ("time,target_id,left,top,width,height,longitude\n", Format::Csv, "latitude"),
        ("time,target_id,left,top,width,height,longitude,latitude,sigma\n", Format::Csv, "`sigma`"),
        ("time;target_id;left\n", Format::Csv, "commas"),
        ("time,time,target_id\n", Format::Csv, "duplicate"),
        ("left,left_px,target_id\n", Format::Csv, "duplicate"),
        ("7", Format::Json, "array"),
        ("{\"rows\":[]}", Format::Json, "samples"),
        ("[", Format::Json, "ends within"),
        ("[]]", Format::Json, "after"),
        ("{\"samples\":[],\"more\":1}", Format::Json, "only the rows"),
        ("{}", Format::GeoJson, "GeoJSON"),
    ] {
        let error = read(text.as_bytes(), format).expect_err(text);
        assert!(matches!(error.kind(), ErrorKind::MalformedBody | ErrorKind::UnsupportedMediaType));
        assert!(error.to_string().contains(reason), "{text}: {error}");
    }
    let utf16: Vec<u8> = format!("\u{feff}{HEADER}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert!(read(&utf16, Format::Csv).expect_err("UTF-16").to_string().contains("UTF-8"));
    let cut = format!("[{GOOD_JSON},{}", &GOOD_JSON[..50]);
    assert!(read(cut.as_bytes(), Format::Json).is_err());
}

#[test]
fn columns_are_accepted_in_any_order_and_with_units() {
    let text = "\u{feff}latitude_deg,longitude_deg,score,class,height_px,width_px,top_px,left_px,target_id,time,\
                sigma_m,truth_latitude,truth_longitude\r\n\
                30.6280135,103.98678,0.9,person,77,28,11,475,\"a, \"\"b\"\"\",2020-12-14T14:41:48+08:00,2.5,,\r\n\r\n\
                30.6280135,103.98678,,,77,28,11,475,c,2020-12-14T06:41:48Z,,30.6,103.9";
    let samples: Vec<StoredSample> =
        rows(text, Format::Csv).into_iter().map(|row| row.expect("a sample")).collect();
    assert_eq!(samples.len(), 2);
    assert_eq!(samples[0].target_id.as_str(), "a, \"b\"");
    assert_eq!(samples[0].fix.expect("a fix").sigma_m, Some(SigmaM::new(2.5).expect("a sigma")));
    assert_eq!(samples[0].truth, None);
    assert_eq!(samples[1].truth, Some(Position::new(103.9, 30.6).expect("a position")));
    assert_eq!(samples[1].class, None);
    assert_eq!(samples[0].time, samples[1].time);
    assert_eq!(samples[0].bounding_box, samples[1].bounding_box);
}

#[test]
fn a_row_beyond_the_limit_is_skipped_and_reported() {
    let long = "x".repeat(3 * MAX_ROW_BYTES);
    let text = format!("{HEADER}\n{GOOD}\n{long}\n{GOOD}\n");
    let too_long = row_error(&text, Format::Csv);
    assert_eq!((too_long.line, rows(&text, Format::Csv).len()), (3, 3));
    let text = format!("[{GOOD_JSON},\"{long}\",{GOOD_JSON}]");
    assert_eq!((row_error(&text, Format::Json).line, rows(&text, Format::Json).len()), (2, 3));
}

#[test]
fn a_box_outside_of_the_image_is_reported() {
    let mut rules = rules();
    rules.image_size = Some(ImageSize::new(320, 240).expect("a size"));
    let text = format!("{HEADER}\n{GOOD}\n");
    let rows: Vec<_> = read_samples(text.as_bytes(), Format::Csv, &rules)
        .expect("a file")
        .map(|row| row.expect("a line"))
        .collect();
    assert_eq!(rows[0].as_ref().expect_err("outside").field, "left");
}

#[test]
fn observations_may_lack_box_or_fix_but_not_both() {
    let text = "time,target_id,left,top,width,height,longitude,latitude,truth_longitude,truth_latitude,class\n\
                2020-12-14T14:41:48Z,,475,11,28,77,,,103,30,person\n\
                2020-12-14T14:41:48Z,,,,,,103,30,,,\n\
                2020-12-14T14:41:48Z,,,,,,,,103,30,\n";
    let rows: Vec<_> = read_observations(text.as_bytes(), Format::Csv, &rules())
        .expect("a file")
        .map(|row| row.expect("a line"))
        .collect();
    let boxed = rows[0].as_ref().expect("a box");
    assert!(boxed.observation.bounding_box().is_some() && boxed.observation.fix().is_none());
    assert!(boxed.truth.is_some() && boxed.class.is_some());
    assert!(rows[1].as_ref().expect("a fix").observation.fix().is_some());
    assert_eq!(rows[2].as_ref().expect_err("nothing").line, 4);
}

#[test]
fn nmea_positions_without_a_valid_fix_are_row_errors() {
    let text = "$GPGGA,033745.0,5650.82344,N,03548.9778,E,1,07,1.8,101.2,M,14.7,M,,*60\r\n\
                $GPGSV,3,1,11,10,63,137,17,07,61,098,15,05,59,290,20,08,54,157,30*70\r\n\
                \r\n\
                $GPGGA,033745.0,5650.82344,N,03548.9778,E,0,07,1.8,101.2,M,14.7,M,,*61\r\n\
                $GPGGA,033745.0,5650.82344,N,03548.9778,W,1,07,1.8,101.2,M,14.7,M,,*60\r\n\
                hello\n";
    let rows: Vec<_> = read_fixes(text.as_bytes(), FixFormat::Nmea, rules().time_bounds)
        .expect("a file")
        .map(|row| row.expect("a line"))
        .collect();
    let fix = rows[0].as_ref().expect("a fix").fix.position;
    assert!((fix.latitude_deg() - 56.847_057_3).abs() < 1e-6, "{fix:?}");
    assert!((fix.longitude_deg() - 35.816_296_7).abs() < 1e-6, "{fix:?}");
    let faults: Vec<(u64, &str)> = rows[1..]
        .iter()
        .map(|row| row.as_ref().expect_err("a fault"))
        .map(|f| (f.line, f.reason.as_str()))
        .collect();
    assert_eq!(faults.len(), 3, "{faults:?}");
    assert!(faults[0].0 == 4 && faults[0].1.contains("quality 0"), "{faults:?}");
    assert!(faults[1].0 == 5 && faults[1].1.contains("checksum"), "{faults:?}");
    assert!(faults[2].0 == 6 && faults[2].1.contains("NMEA"), "{faults:?}");
}

#[test]
fn fused_positions_are_written_in_every_format() {
    let place = Position::new(103.98678, 30.6280135).expect("a position");
    let fused = FusedFix {
        time: "2020-12-14T06:41:48Z".parse().expect("an instant"),
        target_id: None,
        fused: place,
        regressed: Some(place),
        gnss: None,
        confidences: Confidences { regression: 1.0, gnss: 0.0 },
        e_regression_m2: Some(0.25),
        e_gnss_m2: None,
        r95_m: 1.5,
        covariance: PlaneCovariance::isotropic(0.4),
        regressed_covariance: None,
        reconstruction_error: Some(0.5),
        model_version: Some(3),
        flags: vec![Flag::GnssDenied, Flag::BoxAtBorder],
    };
    let written = |format| {
        String::from_utf8(write_fused(Vec::new(), format, [&fused]).expect("memory")).expect("UTF-8")
    };
    let csv = written(Format::Csv);
    let row = csv.lines().nth(1).expect("a row");
    assert_eq!(
        row,
        "2020-12-14T06:41:48Z,,103.98678000,30.62801350,1.5,103.98678000,30.62801350,,,,1,0,0.25,,0.5,3,\
         gnss_denied box_at_border"
    );
    assert_eq!(csv.lines().next().expect("a header").split(',').count(), row.split(',').count());
    let line: serde_json::Value = serde_json::from_str(&written(Format::Ndjson)).expect("JSON");
    assert_eq!(line["flags"], serde_json::json!(["gnss_denied", "box_at_border"]));
    assert_eq!(line.get("gnss"), None);
    let document: serde_json::Value = serde_json::from_str(&written(Format::Json)).expect("JSON");
    assert_eq!(document["items"][0], line);
    let map: serde_json::Value = serde_json::from_str(&written(Format::GeoJson)).expect("JSON");
    assert_eq!(map["features"][0]["properties"], line);
}

fn shared_file(name: &str) -> File {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/square").join(name);
    File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_samples_are_read_and_written() {
    let file = shared_file("training.csv");
    let samples: Result<Vec<StoredSample>, RowError> =
        read_samples(file, Format::Csv, &rules()).expect("a file").map(|row| row.expect("a line")).collect();
    let samples = samples.expect("only valid rows");
    assert_eq!(samples.len(), 10_078);
    for format in [Format::Csv, Format::Ndjson, Format::Json] {
        let written = write_samples(Vec::new(), format, &samples).expect("memory");
        let back: Result<Vec<StoredSample>, RowError> =
            read(&written, format).expect("own writing").into_iter().collect();
        assert!(back.as_ref() == Ok(&samples), "{format:?}");
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_fixes_are_read() {
    let file = shared_file("gnss.csv");
    let fixes = read_fixes(file, FixFormat::Csv, rules().time_bounds).expect("a file");
    assert_eq!(fixes.filter(|row| row.as_ref().expect("a line").is_ok()).count(), 11_270);
}
