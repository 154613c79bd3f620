//! Lists with known partners, streams against lists, and the square's own files.

use std::collections::BTreeMap;
use std::path::PathBuf;

use jiff::Timestamp;

use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::clock_offset::{OffsetSearch, estimate_clock_offset};
use crate::domain::{BoundingBox, ClockOffset, Fix, Receiver, ReceiverId, TargetId, parse_time};
use crate::geo::{LocalPlane, Position};
use crate::simulation::{Walk, at_s, standard_normal, stream};

fn target(name: &str) -> TargetId {
    TargetId::new(name).expect("a name")
}

fn receiver(name: &str) -> ReceiverId {
    ReceiverId::new(name).expect("a name")
}

fn detection(name: &str, seconds: f64) -> Detection {
    Detection {
        time: at_s(seconds),
        target_id: target(name),
        bounding_box: BoundingBox::new(10.0 + seconds, 20.0, 30.0, 40.0).expect("valid"),
        class: None,
        score: None,
    }
}

fn received(name: Option<&str>, seconds: f64, longitude_deg: f64) -> ReceivedFix {
    let position = Position::new(longitude_deg, 10.0).expect("valid");
    ReceivedFix { time: at_s(seconds), receiver_id: name.map(receiver), fix: Fix { position, sigma_m: None } }
}

fn columns(name: &str) -> Vec<Vec<String>> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/square").join(name);
    let mut reader = csv::Reader::from_path(path).expect("readable");
    reader.records().map(|row| row.expect("a row").iter().map(str::to_owned).collect()).collect()
}

fn number(row: &[String], column: usize) -> f64 {
    row[column].parse().expect("a number")
}

fn boxed(row: &[String]) -> Detection {
    Detection {
        time: parse_time(&row[0]).expect("a time"),
        target_id: target(&row[1]),
        bounding_box: BoundingBox::new(number(row, 2), number(row, 3), number(row, 4), number(row, 5))
            .expect("a box"),
        class: None,
        score: None,
    }
}

fn fixed(row: &[String], column: usize) -> Fix {
    let position = Position::new(number(row, column), number(row, column + 1)).expect("a position");
    Fix { position, sigma_m: None }
}

/// The square's boxes and fixes, unpaired.
fn square() -> (Vec<Detection>, Vec<ReceivedFix>) {
    let detections = columns("detections.csv").iter().map(|row| boxed(row)).collect();
    let fixes = columns("gnss.csv")
        .iter()
        .map(|row| ReceivedFix {
            time: parse_time(&row[0]).expect("a time"),
            receiver_id: Some(receiver("phone")),
            fix: fixed(row, 1),
        })
        .collect();
    (detections, fixes)
}

fn carried_by(name: &str, phone: &str, offset_s: f64) -> Receivers {
    let clock_offset = ClockOffset::from_seconds(offset_s).expect("within a day");
    Receivers::new([Receiver { target_id: target(name), clock_offset, ..Receiver::named(receiver(phone)) }])
        .expect("one receiver")
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_files_are_paired_to_the_paired_file() {
    let ((detections, fixes), paired) = (square(), columns("training.csv"));
    let expected: Vec<(Detection, Fix)> = paired.iter().map(|row| (boxed(row), fixed(row, 6))).collect();
    let (boxes, all_fixes) = (detections.len(), fixes.len());
    let receivers = carried_by("person-1", "phone", 0.0);
    let found = pair(detections, fixes, &receivers, &PairingSettings::default());
    assert_eq!(found.samples.len(), expected.len());
    for (sample, (detection, fix)) in found.samples.iter().zip(&expected) {
        assert_eq!((sample.time, &sample.target_id), (detection.time, &detection.target_id));
        assert_eq!((sample.bounding_box, sample.fix), (detection.bounding_box, *fix));
    }
    assert_eq!(found.unpaired.detections, (boxes - expected.len()) as u64);
    assert_eq!(found.unpaired.fixes, (all_fixes - expected.len()) as u64);
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_clocks_agree_and_a_shifted_one_is_found() {
    let (detections, fixes) = square();
    let plain: Vec<(Timestamp, Fix)> = fixes.iter().map(|it| (it.time, it.fix)).collect();
    let own = estimate_clock_offset(&detections, &plain, &OffsetSearch::default()).expect("he walks");
    println!("{own:?}");
    assert!(own.clock_offset.abs() < SignedDuration::from_millis(1_500), "{own:?}");
    for shift_ms in [-3_400, 2_750] {
        let shift = SignedDuration::from_millis(shift_ms);
        let shifted: Vec<(Timestamp, Fix)> = plain.iter().map(|(time, fix)| (*time + shift, *fix)).collect();
        let found = estimate_clock_offset(&detections, &shifted, &OffsetSearch::default()).expect("walks");
        let off = found.clock_offset - own.clock_offset + shift;
        assert!(off.abs() < SignedDuration::from_millis(150), "{found:?} after {shift_ms} ms");
    }
}

#[test]
fn a_known_offset_is_found_in_a_simulated_walk() {
    let plane = LocalPlane::new(Position::new(8.0, 47.0).expect("valid"));
    for (seed, shift_s) in [(1, 0.0), (2, -1.3), (3, 4.2), (4, 0.4)] {
        let walk = Walk { turn_interval_s: 12, ..Walk::pedestrian() }.simulate(seed, 900);
        let mut random = stream(seed, 0);
        let (mut detections, mut fixes) = (Vec::new(), Vec::new());
        for (second, positions) in walk.iter().enumerate() {
            let truth = positions.truth;
            // A camera 12 m above the ground, 150 m south of where the walk begins.
            let range_m = (truth.north_m + 150.0).max(20.0);
            let foot = [
                900.0 + 1_200.0 * truth.east_m / range_m + standard_normal(&mut random),
                300.0 + 14_400.0 / range_m + standard_normal(&mut random),
            ];
            let height_px = 2_000.0 / range_m;
            detections.push(Detection {
                bounding_box: BoundingBox::new(foot[0] - 5.0, foot[1] - height_px, 10.0, height_px)
                    .expect("valid"),
                ..detection("walker", second as f64)
            });
            let position = plane.to_position(positions.fix);
            fixes.push((at_s(second as f64 - shift_s), Fix { position, sigma_m: None }));
        }
        let found = estimate_clock_offset(&detections, &fixes, &OffsetSearch::default()).expect("walks");
        let off_s = found.clock_offset.as_secs_f64() - shift_s;
        println!("{shift_s}: {found:?}");
        assert!(off_s.abs() < 0.25 && off_s.abs() < 5.0 * found.sigma_s, "{shift_s}: {found:?}");
        assert!(found.explained >= found.explained_at_zero - 1e-3);
    }
}

#[test]
fn a_target_that_stands_tells_no_offset() {
    let detections: Vec<Detection> = (0..500).map(|second| detection("a", f64::from(second))).collect();
    let fixes: Vec<(Timestamp, Fix)> =
        (0..500).map(|second| (at_s(f64::from(second)), received(None, 0.0, 5.0).fix)).collect();
    assert!(estimate_clock_offset(&detections, &fixes, &OffsetSearch::default()).is_none());
    assert!(estimate_clock_offset(&[], &[], &OffsetSearch::default()).is_none());
}

#[test]
fn no_fix_labels_two_boxes_and_the_window_holds() {
    let detections: Vec<Detection> = (0..100).map(|frame| detection("a", f64::from(frame) * 0.04)).collect();
    let fixes = (0..6).map(|second| received(Some("a"), f64::from(second) + 0.49, 5.0)).collect();
    let found = pair(detections, fixes, &Receivers::default(), &PairingSettings::default());
    let times: Vec<Timestamp> = found.samples.iter().map(|sample| sample.time).collect();
    assert_eq!(times, [0.48, 1.48, 2.48, 3.48].map(at_s), "the fixes at 4.49 and 5.49 see no box");
    assert_eq!((found.unpaired.detections, found.unpaired.fixes), (96, 2));
    // No box is farther than the window from its nearest fix.
    assert_eq!((found.unpaired.fix_claimed_by_nearer_box, found.detections_without_fixes), (96, 0));
}

#[test]
fn receivers_are_bound_to_targets_with_their_clocks() {
    let receivers = carried_by("a", "phone-7", -18.0);
    let fixes =
        vec![received(Some("phone-7"), 28.0, 5.0), received(Some("b"), 10.1, 6.0), received(None, 10.0, 7.0)];
    let found = pair(
        vec![detection("a", 10.0), detection("b", 10.0)],
        fixes,
        &receivers,
        &PairingSettings::default(),
    );
    let longitudes: Vec<f64> = found.samples.iter().map(|it| it.fix.position.longitude_deg()).collect();
    assert!((longitudes[0] - 5.0).abs() < 1e-12 && (longitudes[1] - 6.0).abs() < 1e-12, "{longitudes:?}");
    assert_eq!(found.unpaired.receiver_missing, 1);
}

#[test]
fn what_stays_without_a_partner_is_told_by_its_reason() {
    for rule in [PairingRule::Nearest, PairingRule::Interpolated] {
        let settings = PairingSettings { rule, ..PairingSettings::default() };
        let detections = ["a", "a", "a", "lone", "lone"].map(str::to_owned);
        let detections =
            detections.iter().zip([1.0, 1.1, 9.0, 1.0, 1.0]).map(|(name, at)| detection(name, at));
        let fixes = [("a", 1.05), ("a", 1.05), ("a", 1.2), ("a", 5.0), ("b", 1.0)];
        let fixes = fixes.iter().map(|(name, at)| received(Some(name), *at, 5.0));
        let fixes = fixes.chain([received(None, 1.0, 5.0)]);
        let found = pair(detections.collect(), fixes.collect(), &Receivers::default(), &settings);
        let nearest = rule == PairingRule::Nearest;
        // Nearest: 1.0 and 1.05. Interpolated: 1.1 between 1.05 and 1.2.
        assert_eq!(found.samples.len(), 1);
        let expected = Unpaired {
            detections: 3,
            fix_claimed_by_nearer_box: u64::from(nearest),
            fixes: if nearest { 3 } else { 2 },
            duplicates: 2,
            duplicate_fixes: 1,
            receiver_missing: 1,
        };
        assert_eq!(found.unpaired, expected, "{rule:?}");
        assert_eq!((found.detections_without_fixes, found.fixes_without_detections), (1, 1));
    }
}

#[test]
fn a_fix_between_two_lies_on_their_line_across_the_antimeridian() {
    let settings = PairingSettings { rule: PairingRule::Interpolated, ..PairingSettings::default() };
    let fixes = vec![received(Some("a"), 0.0, 179.9999), received(Some("a"), 2.0, -179.9999)];
    let detections = vec![detection("a", 0.0), detection("a", 1.5), detection("a", 3.0)];
    let found = pair(detections, fixes, &Receivers::default(), &settings);
    assert_eq!(found.samples.len(), 2);
    let longitude_deg = found.samples[1].fix.position.longitude_deg();
    assert!((longitude_deg + 179.999_95).abs() < 1e-8, "{longitude_deg}");
    assert_eq!(found.unpaired.detections, 1);
}

#[test]
fn a_stream_without_partners_stays_bounded() {
    let settings = PairingSettings { items_per_target: 16, targets: 4, ..PairingSettings::default() };
    let mut pairer = Pairer::new(settings);
    let mut released = 0;
    for index in 0..10_000 {
        let name = format!("target-{}", index % 50);
        released += pairer.push_detection(detection(&name, 0.001 * f64::from(index)), ()).released.len();
        let fix = received(None, 0.001 * f64::from(index), 5.0);
        released += pairer.push_fix(&target("lone"), fix.time, fix.fix, ()).released.len();
    }
    assert!(pairer.buffered().count() <= 4);
    assert!(pairer.buffered().all(|(detections, fixes)| detections <= 16 && fixes <= 16));
    // Nothing is dropped: what gave way was decided, and is counted.
    let reported = pairer.unpaired().detections + pairer.unpaired().fixes;
    let buffered: usize = pairer.buffered().map(|(detections, fixes)| detections + fixes).sum();
    assert_eq!(reported + buffered as u64, 20_000);
    assert_eq!(released + buffered, 20_000, "every item is released once");
}

/// Boxes at 2 Hz and fixes at 1 Hz for two minutes, and what becomes of them by outcome.
fn outcomes(change: impl Fn(usize, &mut Vec<(TargetId, Timestamp, Fix)>)) -> BTreeMap<ItemOutcome, usize> {
    let mut pairer = Pairer::new(PairingSettings::default());
    let mut outcomes = BTreeMap::new();
    let mut count = |items: PairedItems<()>| {
        for item in items.released {
            *outcomes.entry(item.outcome).or_default() += 1;
        }
    };
    for index in 0..240 {
        let seconds = 0.5 * f64::from(index);
        count(pairer.push_detection(detection("a", seconds), ()));
        let mut fixes = Vec::new();
        if index % 2 == 0 {
            let received = received(None, seconds, 5.0);
            fixes.push((target("a"), received.time, received.fix));
        }
        change(index as usize, &mut fixes);
        for (target_id, time, fix) in fixes {
            count(pairer.push_fix(&target_id, time, fix, ()));
        }
    }
    count(pairer.end(&target("a")));
    outcomes
}

#[test]
fn a_fix_hours_ahead_makes_nothing_late() {
    let undisturbed = outcomes(|_, _| {});
    assert_eq!(undisturbed, BTreeMap::from([(ItemOutcome::Paired, 240), (ItemOutcome::Unpaired, 120)]));
    let ahead = |index: usize, fixes: &mut Vec<(TargetId, Timestamp, Fix)>| {
        // One in the middle, then a receiver that stays two hours ahead beside the right one.
        if index == 50 || index > 100 {
            let received = received(None, 7_200.0 + index as f64, 5.0);
            fixes.push((target("a"), received.time, received.fix));
        }
    };
    let disturbed = outcomes(ahead);
    assert_eq!(disturbed[&ItemOutcome::Paired], 240, "{disturbed:?}");
    assert!(!disturbed.contains_key(&ItemOutcome::TooLate), "{disturbed:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn a_stream_gives_what_the_lists_give(seed in 0..10_000u64, interpolated in any::<bool>()) {
        let rule = if interpolated { PairingRule::Interpolated } else { PairingRule::Nearest };
        let settings = PairingSettings { rule, ..PairingSettings::default() };
        let mut random = stream(seed, 0);
        let (mut detections, mut fixes) = (Vec::new(), Vec::new());
        for (name, rate_hz) in [("a", 5.0), ("b", 1.0)] {
            for index in 0..120 {
                let jitter_s = 0.05 * standard_normal(&mut random).sin();
                if standard_normal(&mut random) < 1.0 {
                    detections.push(detection(name, 100.0 + f64::from(index) / rate_hz + jitter_s));
                }
                if standard_normal(&mut random) < 1.0 {
                    fixes.push(received(Some(name), 100.3 + f64::from(index) + jitter_s, 5.0 + 1e-5 * f64::from(index)));
                }
            }
        }
        let batch = pair(detections.clone(), fixes.clone(), &Receivers::default(), &settings);
        // Every item arrives up to 2.8 s late.
        enum Item { Box(Detection), Fix(ReceivedFix) }
        let late = |random: &mut ChaCha8Rng, time: Timestamp| time + SignedDuration::from_secs_f64(1.4 * (1.0 + standard_normal(random).sin()));
        let mut items: Vec<(Timestamp, Item)> = Vec::new();
        for it in detections { items.push((late(&mut random, it.time), Item::Box(it))); }
        for it in fixes { items.push((late(&mut random, it.time), Item::Fix(it))); }
        items.sort_by_key(|(arrival, _)| *arrival);
        let mut pairer = Pairer::new(settings);
        let mut samples = Vec::new();
        for (_, item) in items {
            let decided = match item {
                Item::Box(it) => pairer.push_detection(it, ()),
                Item::Fix(it) => {
                    let receiver_id = it.receiver_id.as_ref().expect("named");
                    let (target_id, time) = Receivers::default().resolve(receiver_id, it.time);
                    pairer.push_fix(&target_id, time, it.fix, ())
                }
            };
            samples.extend(decided.samples);
        }
        let early = samples.len();
        samples.extend(pairer.finish().samples);
        samples.sort_by(|a, b| (a.time, &a.target_id).cmp(&(b.time, &b.target_id)));
        prop_assert!(early > samples.len() / 2, "{early} of {} came out in time", samples.len());
        prop_assert_eq!(&samples, &batch.samples);
        prop_assert_eq!(pairer.unpaired(), batch.unpaired);
    }
}
