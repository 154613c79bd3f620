//! The figures against cases computed by hand, and the gain of training a site together.

use jiff::{SignedDuration, Timestamp};

use super::*;
use crate::domain::{BoundingBox, TargetId};
use crate::fusion::association::{MatchedPiece, Matching};
use crate::fusion::world::WorldTrackId;
use crate::geo::EastNorth;
use crate::simulation::{SiteOptions, simulate_site};

fn at_s(seconds: f64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(seconds)
}

fn record(camera: usize, seconds: f64, target: Option<usize>, track: u64) -> BoxRecord {
    BoxRecord { camera, time: at_s(seconds), target, track: Some(WorldTrackId(track)) }
}

fn near(one: f64, other: f64) -> bool {
    (one - other).abs() < 1e-9
}

#[test]
fn identity_by_boxes_of_a_broken_track_and_a_false_box() {
    // Target 0: six boxes on track 1, two on track 2. Target 1: four boxes on track 2. One false box on track 1.
    let mut records: Vec<BoxRecord> = (0..6).map(|at| record(0, f64::from(at), Some(0), 1)).collect();
    records.extend((6..8).map(|at| record(0, f64::from(at), Some(0), 2)));
    records.extend((0..4).map(|at| record(0, f64::from(at), Some(1), 2)));
    records.push(record(0, 0.0, None, 1));
    let figures = BoxFigures::of(&records);
    // Most in common: 6 + 4; boxes of targets 12, of tracks 13.
    assert!(near(figures.identity_f1, 20.0 / 25.0), "{figures:?}");
    // 6 boxes of 6/7, 2 of 2/6, 4 of 4/6; then 6 of 6/8, 2 of 2/8, 4 of 4/4.
    let precision = (6.0 * 6.0 / 7.0 + 2.0 * 2.0 / 6.0 + 4.0 * 4.0 / 6.0) / 12.0;
    assert!(near(figures.association_precision, precision), "{figures:?}");
    assert!(near(figures.association_recall, (6.0 * 0.75 + 2.0 * 0.25 + 4.0) / 12.0), "{figures:?}");
    assert_eq!((figures.handovers, figures.handover_rate), (0, None));
}

#[test]
fn handovers_that_keep_and_that_lose_the_identity() {
    let mut records = Vec::new();
    for step in 0..20 {
        let seconds = 0.5 * f64::from(step);
        // Target 0 stays on its track, target 1 gets another one in camera 1, target 2 is merged within 2 s.
        for (target, in_first, in_second) in [(0, 1, 1), (1, 2, 3), (2, 4, if seconds < 6.0 { 5 } else { 4 })]
        {
            if seconds <= 6.0 {
                records.push(record(0, seconds, Some(target), in_first));
            }
            if seconds >= 4.5 {
                records.push(record(1, seconds, Some(target), in_second));
            }
        }
        // Never in a second camera.
        records.push(record(0, seconds, Some(3), 6));
    }
    // Target 4 was away for longer than 2 s: no hand-over.
    records.extend([record(0, 0.0, Some(4), 7), record(1, 5.0, Some(4), 8)]);
    let figures = BoxFigures::of(&records);
    assert_eq!(figures.handovers, 3);
    assert!(figures.handover_rate.is_some_and(|rate| near(rate, 2.0 / 3.0)), "{figures:?}");
}

fn instant(targets: &[(usize, f64)], tracks: &[(u64, f64)]) -> WorldInstant {
    let at = |east_m: f64| EastNorth { east_m, north_m: 0.0 };
    WorldInstant {
        targets: targets.iter().map(|(target, east_m)| (*target, at(*east_m))).collect(),
        tracks: tracks
            .iter()
            .map(|(track, east_m)| ReportedTrack {
                track: WorldTrackId(*track),
                position: at(*east_m),
                r95_m: 0.5,
                target: None,
            })
            .collect(),
    }
}

#[test]
fn errors_of_tracks_in_the_world_by_hand() {
    let instants = [
        instant(&[(0, 0.0), (1, 10.0)], &[(1, 0.3), (2, 10.4)]),
        // Track 1 keeps target 0 though track 3 is nearer; target 1 is missed, track 3 is false.
        instant(&[(0, 0.0), (1, 10.0)], &[(1, 0.6), (3, 0.1)]),
        // Target 1 changes to track 3: a switch.
        instant(&[(0, 0.0), (1, 10.0)], &[(1, 0.0), (3, 9.5)]),
    ];
    let figures = WorldFigures::of(&instants);
    // One miss, one false track, one switch of six targets.
    assert!(near(figures.mota, 0.5), "{figures:?}");
    // Targets 0 with 1: three, 1 with 2 or 3: one; six targets, six tracks.
    assert!(near(figures.idf1, 8.0 / 12.0), "{figures:?}");
    let first = (0.09f64 + 0.16).sqrt();
    // The nearer track matches; a target and a track without a match cost 2 m2 each.
    let second = (0.01f64 + 4.0).sqrt();
    let third = 0.5;
    assert!(near(figures.gospa_m, (first + second + third) / 3.0), "{figures:?}");
}

#[test]
fn errors_and_coverage_of_positions_by_hand() {
    let mut both = instant(&[(0, 0.0), (1, 10.0)], &[(1, 0.3), (2, 10.9), (3, 50.0)]);
    both.tracks[0].target = Some(0);
    both.tracks[1].target = Some(1);
    let figures = PositionFigures::of(&[both]).expect("two positions");
    assert!(near(figures.mean_error_m, 0.6) && near(figures.coverage95, 0.5), "{figures:?}");
    assert_eq!((figures.positions, PositionFigures::of(&[])), (2, None));
}

/// Many walkers and vehicles before two overlapping cameras and a third one beyond a gap.
fn simulated(seed: u64) -> SiteRecording {
    let options = SiteOptions {
        seed,
        receiver_seed: seed,
        camera_seed: seed,
        tracker_id_lifetime_s: Some(20.0),
        ..SiteOptions::default()
    };
    SiteRecording::simulated(&simulate_site(&options))
}

#[test]
fn a_site_trained_together_has_better_positions_and_states_less_than_each_camera_alone() {
    let (mut together, mut apart) = (Vec::new(), Vec::new());
    for seed in 1..=2 {
        let recording = simulated(seed);
        let run = |training| {
            let trained = train_site(&recording, training).expect("trained");
            track_site(&recording, &recording, &trained, Identities::Tracked, &[0, 1, 2], false)
        };
        together.push(run(SiteTraining::Together));
        apart.push(run(SiteTraining::Apart));
    }
    let together = SiteCase::over_draws("together", &together).expect("draws");
    let apart = SiteCase::over_draws("apart", &apart).expect("draws");
    println!("{}", SiteReport { cases: vec![together.clone(), apart.clone()] }.table());
    assert!(together.handover_rate > Some(0.85), "{together:?}");
    // Targets that nobody sees for longer than a track coasts come back as new ones, which costs recall alone.
    assert!(together.association_precision > 0.95, "{together:?}");
    assert!(together.mota > apart.mota, "{together:?} {apart:?}");
    assert!(together.mean_error_m < apart.mean_error_m, "{together:?} {apart:?}");
    // Four of the twenty targets are vehicles, whose antenna is metres behind the foot of the box: no homography has that.
    assert!(
        together.coverage95 > Some(0.7) && apart.coverage95 > together.coverage95,
        "{together:?} {apart:?}"
    );
}

#[test]
fn degraded_boxes_cost_some_identity_not_most_of_it() {
    let recording = simulated(3);
    let trained = train_site(&recording, SiteTraining::Together).expect("trained");
    let degraded = Degradation::ROUGH.apply(&recording, 1);
    let boxes =
        |recording: &SiteRecording| -> usize { recording.cameras.iter().map(|it| it.boxes.len()).sum() };
    assert_ne!(boxes(&recording), boxes(&degraded));
    let clean = track_site(&recording, &recording, &trained, Identities::Tracked, &[0, 1, 2], false);
    let rough = track_site(&degraded, &recording, &trained, Identities::Tracked, &[0, 1, 2], false);
    println!("{clean:?}\n{rough:?}");
    assert!(rough.boxes.identity_f1 > clean.boxes.identity_f1 - 0.2, "{rough:?}");
}

#[test]
fn a_clock_that_is_late_is_found_within_two_minutes_and_costs_little_identity() {
    let recording = simulated(3);
    let trained = train_site(&recording, SiteTraining::Together).expect("trained");
    let late = Degradation::LATE.apply(&recording, 1);
    let track = |recording: &SiteRecording| {
        track_site(recording, recording, &trained, Identities::Tracked, &[0, 1, 2], false)
    };
    let (clean, late) = (track(&recording), track(&late));
    println!("{:?} {:?}; {:?} {:?}", clean.boxes, clean.wrong_clocks, late.boxes, late.wrong_clocks);
    assert!(clean.wrong_clocks.is_empty(), "{:?}", clean.wrong_clocks);
    let [found] = &late.wrong_clocks[..] else { panic!("{:?}", late.wrong_clocks) };
    assert!(found.camera == recording.cameras[0].id && found.after_s < 120.0, "{found:?}");
    assert!(late.boxes.identity_f1 > clean.boxes.identity_f1 - 0.02, "{late:?}");
}

/// Cameras that all see one place, and walkers.
fn overlapping(cameras: usize) -> SiteRecording {
    let options = SiteOptions {
        seed: 5,
        receiver_seed: 5,
        cameras,
        cameras_per_group: cameras,
        walkers: 14,
        vehicles: 0,
        duration_s: 240.0,
        ..SiteOptions::default()
    };
    SiteRecording::simulated(&simulate_site(&options))
}

#[test]
fn a_knocked_camera_is_found_within_two_minutes() {
    let recording = overlapping(3);
    let trained = train_site(&recording, SiteTraining::Together).expect("trained");
    let track = |boxes: &SiteRecording| {
        track_site(boxes, &recording, &trained, Identities::Tracked, &[0, 1, 2], false)
    };
    let clean = track(&recording);
    assert!(clean.moved.is_empty(), "{:?}", clean.moved);
    let mut outcome = track(&Degradation::KNOCKED.apply(&recording, 1));
    outcome.count_moves_from(Degradation::KNOCKED.knocked_at(&recording).expect("in the recording"));
    println!("{:?} {:?}", outcome.moved, outcome.boxes);
    let [found] = &outcome.moved[..] else { panic!("{:?}", outcome.moved) };
    assert_eq!(found.camera, recording.cameras[0].id);
    assert!((0.0..120.0).contains(&found.after_s), "{found:?}");
}

#[test]
fn of_two_cameras_neither_is_called_moved() {
    let recording = overlapping(2);
    let trained = train_site(&recording, SiteTraining::Together).expect("trained");
    let knocked = Degradation::KNOCKED.apply(&recording, 1);
    let outcome = track_site(&knocked, &recording, &trained, Identities::Tracked, &[0, 1], false);
    assert!(outcome.moved.is_empty(), "{:?}", outcome.moved);
}

fn small_site() -> SiteRecording {
    let options =
        SiteOptions { walkers: 8, vehicles: 0, cameras: 2, duration_s: 60.0, ..SiteOptions::default() };
    SiteRecording::simulated(&simulate_site(&options))
}

#[test]
fn a_draw_is_repeatable_and_keeps_the_truth() {
    let site = small_site();
    let (one, again, other) = (site.redrawn(3), site.redrawn(3), site.redrawn(4));
    assert_eq!((&one.fixes, &one.cameras, &one.receivers), (&again.fixes, &again.cameras, &again.receivers));
    assert_ne!(one.fixes, other.fixes);
    assert_ne!(one.cameras, other.cameras);
    assert_eq!(one.receivers.len(), site.receivers.len());
    let paths = one.true_paths();
    let mut squares = 0.0;
    for fix in &one.fixes {
        let truth = draw::position_at(&paths[&one.receivers[fix.receiver].1], fix.time).expect("on the path");
        squares += 0.5 * fix.position.distance_m(truth).powi(2) / one.fixes.len() as f64;
    }
    // Four receivers of a minute each: few independent errors.
    assert!((1.0..5.0).contains(&squares.sqrt()), "{squares}");
    let boxes =
        |recording: &SiteRecording| recording.cameras.iter().map(|own| own.boxes.len()).sum::<usize>();
    let kept = boxes(&one) as f64 / boxes(&site) as f64;
    assert!((0.94..0.99).contains(&kept), "{kept}");
}

#[test]
fn pairs_are_counted_against_the_truth() {
    let mut site = small_site();
    let target = site.receivers[0].1;
    let own = |at: usize, id: &str, target: usize| LabelledBox {
        time: at_s(at as f64),
        tracker_id: TargetId::new(id).expect("an id"),
        bounding_box: BoundingBox::new(10.0, 10.0, 20.0, 50.0).expect("a box"),
        target: Some(target),
    };
    site.cameras[0].boxes = (0..10).map(|at| own(at, "a", target)).collect();
    site.cameras[0].boxes.extend((0..10).map(|at| own(at, "b", target + 1)));
    let fix = |at: usize| RecordedFix { receiver: 0, time: at_s(at as f64), position: EastNorth::default() };
    site.fixes = (0..10).map(fix).collect();
    let piece = |id: &str, detections: std::ops::Range<usize>, probability| MatchedPiece {
        tracker_id: TargetId::new(id).expect("an id"),
        detections: detections.collect(),
        receiver_id: site.receivers[0].0.clone(),
        probability,
    };
    let pieces = vec![piece("a", 0..8, 0.92), piece("b", 10..20, 0.97), piece("a", 8..10, 0.6)];
    let figures = PairFigures::of(&site, 0, &Matching { pieces, ..Matching::default() });
    assert_eq!((figures.true_pairs, figures.found), (1, 1));
    assert_eq!((figures.true_boxes, figures.found_boxes), (10, 8));
    assert_eq!((figures.sure().pairs, figures.sure().right), (2, 1));
    assert_eq!((figures.bins[2].pairs, figures.bins[2].right), (1, 1));
}
