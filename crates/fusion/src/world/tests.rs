//! Behaviour of the world tracker on scripted targets.

use std::collections::BTreeMap;

use jiff::Timestamp;
use rand::RngExt;

use super::*;
use crate::domain::{CameraId, ReceiverId, ReceiverMatch, TargetId};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};
use crate::simulation::{standard_normal, stream};

fn tracker() -> WorldTracker {
    let origin = Position::new(11.0, 48.0).expect("within range");
    WorldTracker::new(LocalPlane::new(origin), WorldTrackSettings::default())
}

fn at_s(seconds: f64) -> Timestamp {
    Timestamp::from_microsecond(1_767_600_000_000_000 + (seconds * 1e6) as i64).expect("within range")
}

fn at(east_m: f64, north_m: f64) -> EastNorth {
    EastNorth { east_m, north_m }
}

fn seen(position: EastNorth, tracker_id: Option<&str>) -> WorldDetection {
    WorldDetection {
        tracker_id: tracker_id.map(|id| TargetId::new(id).expect("short")),
        receiver: None,
        position,
        covariance_m2: PlaneCovariance::isotropic(0.04),
        offset_covariance_m2: PlaneCovariance::isotropic(0.01),
        common_covariance_m2: PlaneCovariance::isotropic(0.25),
    }
}

fn carrying(detection: WorldDetection, receiver: &str) -> WorldDetection {
    WorldDetection { receiver: Some(receiver_id(receiver)), ..detection }
}

fn receiver_id(name: &str) -> ReceiverId {
    ReceiverId::new(name).expect("short")
}

fn frame(camera: &str, seconds: f64, detections: Vec<WorldDetection>) -> CameraFrame {
    CameraFrame { camera: CameraId::new(camera).expect("slug"), time: at_s(seconds), detections }
}

fn only_track(outcome: &FrameOutcome) -> WorldTrackId {
    outcome.tracks[0].expect("assigned")
}

/// A walker from west to east, seen by camera a until 10 s and by camera b from 8 s on.
#[test]
fn a_walker_keeps_the_track_from_camera_to_camera() {
    let (mut tracker, mut random) = (tracker(), stream(1, 0));
    let (mut ids, mut handed_over) = (Vec::new(), Vec::new());
    for step in 0..40 {
        let seconds = 0.5 * f64::from(step);
        for (camera, sees, tracker_id) in [("a", seconds <= 10.0, "7"), ("b", seconds >= 8.0, "3")] {
            if !sees {
                continue;
            }
            let noise = at(0.2 * standard_normal(&mut random), 0.2 * standard_normal(&mut random));
            let position = at(1.3 * seconds + noise.east_m, noise.north_m);
            let outcome = tracker.observe(&frame(camera, seconds, vec![seen(position, Some(tracker_id))]));
            ids.push(only_track(&outcome));
            handed_over.extend(outcome.events.into_iter().filter_map(|it| match it.event {
                WorldEvent::HandedOver { from, to, .. } => Some((from, to)),
                _ => None,
            }));
        }
    }
    assert!(ids.iter().all(|id| *id == ids[0]), "{ids:?}");
    let (a, b) = (CameraId::new("a").expect("slug"), CameraId::new("b").expect("slug"));
    assert_eq!(handed_over, [(a, b)]);
    let state = tracker.track(ids[0]).expect("live").state();
    assert!(state.position.distance_m(at(1.3 * 19.5, 0.0)) < 0.5, "{state:?}");
    assert!((state.velocity.east_m_s - 1.3).abs() < 0.3, "{state:?}");
    // The common part of the error is in the output: no filtering removes it.
    assert!(state.covariance_m2.east_m2 > 0.25, "{state:?}");
}

#[test]
fn crossing_walkers_are_told_apart_by_motion_and_by_their_trackers_ids() {
    for ids in [[None, None], [Some("1"), Some("2")]] {
        let (mut tracker, mut random) = (tracker(), stream(2, 0));
        let mut tracks = Vec::new();
        for step in 0..40 {
            let seconds = 0.25 * f64::from(step);
            let along = 1.4 * (seconds - 5.0);
            let mut noisy = |position: EastNorth| {
                at(
                    position.east_m + 0.15 * standard_normal(&mut random),
                    position.north_m + 0.15 * standard_normal(&mut random),
                )
            };
            let detections = vec![seen(noisy(at(along, 0.3)), ids[0]), seen(noisy(at(-along, -0.3)), ids[1])];
            tracks.push(tracker.observe(&frame("a", seconds, detections)).tracks);
        }
        assert_eq!(tracks[0], tracks[39], "{ids:?}");
        assert_eq!(tracker.tracks().count(), 2);
    }
}

#[test]
fn false_detections_are_hardly_ever_reported_and_do_not_last() {
    let (mut tracker, mut random) = (tracker(), stream(3, 0));
    let mut reported = 0;
    for step in 0..200 {
        let position = at(100.0 * random.random::<f64>(), 100.0 * random.random::<f64>());
        let outcome = tracker.observe(&frame("a", 0.5 * f64::from(step), vec![seen(position, None)]));
        reported += outcome.events.iter().filter(|it| matches!(it.event, WorldEvent::Born { .. })).count();
    }
    // Two of 200 may be near each other by chance.
    assert!(reported <= 4, "{reported}");
    assert!(tracker.tracks().count() <= 4);
}

#[test]
fn two_tracks_of_one_target_are_merged_and_two_targets_are_not() {
    let mut tracker = tracker();
    let first = tracker.observe(&frame("a", 0.0, vec![seen(at(0.0, 0.0), None)]));
    let second = tracker.observe(&frame("b", 0.0, vec![seen(at(3.0, 0.0), None)]));
    assert_ne!(only_track(&first), only_track(&second));
    let mut merged = 0;
    for step in 1..20 {
        // Camera b's map was off at the edge of its view only.
        let offset = (3.0 - 1.0 * f64::from(step)).max(0.0);
        let seconds = 0.5 * f64::from(step);
        for (camera, position) in [("a", at(0.0, 0.0)), ("b", at(offset, 0.0))] {
            let outcome = tracker.observe(&frame(camera, seconds, vec![seen(position, None)]));
            merged += outcome
                .events
                .iter()
                .filter(
                    |it| matches!(it.event, WorldEvent::Merged { track, .. } if track == only_track(&first)),
                )
                .count();
        }
    }
    assert_eq!((merged, tracker.tracks().count()), (1, 1));

    let mut side_by_side = self::tracker();
    for step in 0..40 {
        let pair = vec![seen(at(0.0, 0.0), None), seen(at(0.5, 0.0), None)];
        side_by_side.observe(&frame("a", 0.5 * f64::from(step), pair));
        // The other camera sees but one of them.
        side_by_side.observe(&frame("b", 0.5 * f64::from(step), vec![seen(at(0.0, 0.0), None)]));
    }
    assert_eq!(side_by_side.tracks().count(), 2);
}

#[test]
fn the_identity_of_a_receiver_joins_what_the_trackers_ids_keep_apart() {
    let mut tracker = tracker();
    let phone = receiver_id("phone");
    let by_fix = tracker.observe_fix(&phone, at_s(0.0), at(4.0, 3.0), 3.0).track.expect("a track");
    let boxed = only_track(&tracker.observe(&frame("a", 0.1, vec![seen(at(0.0, 0.0), Some("9"))])));
    assert_ne!(by_fix, boxed);
    let outcome = tracker.observe(&frame("a", 0.6, vec![carrying(seen(at(0.1, 0.0), Some("9")), "phone")]));
    assert_eq!(only_track(&outcome), by_fix);
    assert_eq!(tracker.tracks().count(), 1);
    let state = tracker.track(by_fix).expect("live").state();
    assert!(state.position.distance_m(at(0.1, 0.0)) < 0.3, "{state:?}");
    // Another number of the tracker, and a gap: the receiver still names the track.
    let outcome = tracker.observe(&frame("a", 2.2, vec![carrying(seen(at(9.0, 0.0), Some("12")), "phone")]));
    assert_eq!(only_track(&outcome), by_fix);
    let jumped = tracker.track(by_fix).expect("live").state();
    assert!(jumped.position.distance_m(at(9.0, 0.0)) < 0.5, "{jumped:?}");
}

/// The tracker after 3 s in which a camera saw somebody stand 1 m beside a phone's fixes, and the track of that target.
fn standing_beside_a_phone() -> (WorldTracker, WorldTrackId) {
    let mut tracker = tracker();
    let mut track = WorldTrackId(0);
    for step in 0..6 {
        let seconds = 0.5 * f64::from(step);
        tracker.observe_fix(&receiver_id("phone"), at_s(seconds), at(1.0, 0.0), 2.5);
        track = only_track(&tracker.observe(&frame("a", seconds, vec![seen(at(0.0, 0.0), Some("7"))])));
    }
    (tracker, track)
}

#[test]
fn being_near_a_receiver_is_no_identity() {
    let (tracker, track) = standing_beside_a_phone();
    assert_eq!(tracker.tracks().count(), 2, "that of the fixes, and that of the boxes");
    assert!(tracker.track(track).expect("live").receiver().is_none());
}

#[test]
fn a_track_keeps_its_number_whatever_it_carries() {
    let (mut tracker, track) = standing_beside_a_phone();
    let carrying = |name: &str| ReceiverMatch { receiver_id: receiver_id(name), probability: 0.95 };
    let gained = tracker.set_receiver_matches(&[(track, carrying("phone"))].into());
    let kinds: Vec<&WorldEvent> = gained.iter().map(|own| &own.event).collect();
    let is_expected = matches!(
        kinds[..],
        [WorldEvent::Identified { track: identified, .. }, WorldEvent::Merged { track: goes_on, .. }]
            if *identified == track && *goes_on == track
    );
    assert!(is_expected, "the track of the fixes alone ends: {kinds:?}");
    assert!(tracker.observe_fix(&receiver_id("phone"), at_s(3.0), at(1.0, 0.0), 2.5).track.is_none());
    let changed = tracker.set_receiver_matches(&[(track, carrying("other"))].into());
    assert!(
        matches!(&changed[0].event, WorldEvent::Identified { receiver, .. } if receiver.as_str() == "other")
    );
    assert!(tracker.set_receiver_matches(&[(track, carrying("other"))].into()).is_empty());
    assert!(tracker.set_receiver_matches(&BTreeMap::new()).is_empty());
    let goes_on = tracker.observe(&frame("a", 3.5, vec![seen(at(0.0, 0.0), Some("7"))]));
    assert_eq!(only_track(&goes_on), track);
    assert!(tracker.track(track).expect("live").receiver_match().is_none());
    let alone = tracker.observe_fix(&receiver_id("phone"), at_s(4.0), at(1.0, 0.0), 2.5).track;
    assert!(alone.is_some_and(|alone| alone != track), "nobody is known to carry it");
}

#[test]
fn a_fix_does_not_pull_a_target_that_cameras_see() {
    let mut tracker = tracker();
    let phone = receiver_id("phone");
    for step in 0..20 {
        let seconds = f64::from(step);
        tracker.observe(&frame("a", seconds, vec![carrying(seen(at(0.0, 0.0), None), "phone")]));
        tracker.observe_fix(&phone, at_s(seconds + 0.2), at(3.0, 0.0), 2.6);
    }
    let seen_state = tracker.tracks().next().expect("one").state();
    assert!(seen_state.position.distance_m(at(0.0, 0.0)) < 0.1, "{seen_state:?}");
    // Out of view, the fixes carry it on, with their own error stated.
    for step in 20..40 {
        tracker.advance(at_s(f64::from(step)));
        tracker.observe_fix(&phone, at_s(f64::from(step)), at(3.0, 0.0), 2.6);
    }
    let fixed_state = tracker.tracks().next().expect("one").state();
    assert!(fixed_state.position.distance_m(at(3.0, 0.0)) < 1.0, "{fixed_state:?}");
    assert!(fixed_state.covariance_m2.per_axis_m2() > 0.8 * 2.6 * 2.6, "{fixed_state:?}");
}

#[test]
fn a_target_that_its_cameras_tracker_follows_may_jump() {
    for (tracker_id, tracks) in [(Some("1"), 1), (None, 2)] {
        let mut tracker = tracker();
        for step in 0..10 {
            tracker.observe(&frame("a", 0.5 * f64::from(step), vec![seen(at(0.0, 0.0), tracker_id)]));
        }
        // 3 m in half a second: beyond the motion model, within the largest speed.
        tracker.observe(&frame("a", 5.0, vec![seen(at(3.0, 0.0), tracker_id)]));
        assert_eq!(tracker.tracks().count(), tracks, "{tracker_id:?}");
        let state = tracker.tracks().last().expect("a track").state();
        assert!(state.position.distance_m(at(3.0, 0.0)) < 0.5, "{state:?}");
    }
}

#[test]
fn swapped_ids_do_not_swap_tracks_of_targets_that_are_apart() {
    let mut tracker = tracker();
    let mut tracks = Vec::new();
    for step in 0..20 {
        let ids = if step < 10 { ["1", "2"] } else { ["2", "1"] };
        let pair = vec![seen(at(0.0, 0.0), Some(ids[0])), seen(at(2.5, 0.0), Some(ids[1]))];
        tracks.push(tracker.observe(&frame("a", 0.5 * f64::from(step), pair)).tracks);
    }
    assert_eq!(tracks[0], tracks[19]);
}

#[test]
fn late_frames_are_moved_on_or_refused() {
    let mut tracker = tracker();
    for step in 0..20 {
        tracker.observe(&frame("a", 0.5 * f64::from(step), vec![seen(at(f64::from(step), 0.0), None)]));
    }
    // At 9.5 s the target is at 19 m; a frame of 9.0 s saw it at 18 m.
    let late = tracker.observe(&frame("b", 9.0, vec![seen(at(18.0, 0.0), None)]));
    assert!(!late.too_late);
    let state = tracker.track(only_track(&late)).expect("live").state();
    assert!(state.position.distance_m(at(19.0, 0.0)) < 0.3, "{state:?}");
    let refused = tracker.observe(&frame("b", 8.0, vec![seen(at(16.0, 0.0), None)]));
    assert!(refused.too_late && refused.tracks == [None]);
}

#[test]
fn tracks_and_detections_are_bounded() {
    let origin = Position::new(11.0, 48.0).expect("within range");
    let settings = WorldTrackSettings { max_tracks: 5, max_detections: 8, ..WorldTrackSettings::default() };
    let mut tracker = WorldTracker::new(LocalPlane::new(origin), settings);
    let far_apart = (0..10).map(|number| seen(at(20.0 * f64::from(number), 0.0), None)).collect();
    let outcome = tracker.observe(&frame("a", 0.0, far_apart));
    assert_eq!((outcome.tracks.len(), outcome.dropped, tracker.tracks().count()), (10, 5, 5));
    assert!(tracker.observe_fix(&receiver_id("phone"), at_s(0.0), at(0.0, 0.0), 3.0).track.is_none());
}

#[test]
fn a_lost_track_is_reported_once() {
    let mut tracker = tracker();
    for step in 0..4 {
        tracker.observe(&frame("a", 0.5 * f64::from(step), vec![seen(at(0.0, 0.0), None)]));
    }
    assert!(tracker.advance(at_s(3.0)).is_empty());
    let lost = tracker.advance(at_s(4.0));
    assert!(matches!(lost[..], [TimedEvent { event: WorldEvent::Lost { .. }, .. }]), "{lost:?}");
    assert!(tracker.advance(at_s(5.0)).is_empty());
}

/// Two people side by side, 1.1 m apart, whom camera b sees half a metre beside camera a; after 20 s the tracker of
/// camera b exchanges their ids. Returns how many boxes are on the other one's track after that.
fn exchanged_boxes(settings: WorldTrackSettings) -> usize {
    let plane = *tracker().plane();
    let (mut tracker, mut random) = (WorldTracker::new(plane, settings), stream(3, 0));
    let mut tracks = Vec::new();
    let mut exchanged = 0;
    for step in 0..80 {
        let seconds = 0.5 * f64::from(step);
        for (camera, offset_m, ids) in
            [("a", 0.0, ["1", "2"]), ("b", 0.5, if step < 40 { ["8", "9"] } else { ["9", "8"] })]
        {
            let detections = [0.0, 1.1].into_iter().zip(ids).map(|(east_m, id)| {
                let noise = [0; 2].map(|_| 0.1 * standard_normal(&mut random));
                let position = at(east_m + offset_m + noise[0], 0.8 * seconds + noise[1]);
                WorldDetection {
                    offset_covariance_m2: PlaneCovariance::isotropic(0.1),
                    covariance_m2: PlaneCovariance::isotropic(0.02),
                    ..seen(position, Some(id))
                }
            });
            let outcome = tracker.observe(&frame(camera, seconds, detections.collect()));
            match step {
                39 => tracks.clone_from(&outcome.tracks),
                40.. => exchanged += usize::from(outcome.tracks != tracks),
                _ => {}
            }
        }
    }
    exchanged
}

#[test]
fn neighbours_are_told_apart_by_the_offset_of_each_camera() {
    let settings = WorldTrackSettings::default();
    let forgetful = WorldTrackSettings { offset_time_constant_s: 1e-6, ..settings.clone() };
    let (with, without) = (exchanged_boxes(settings), exchanged_boxes(forgetful));
    println!("{with} frames exchanged, {without} without a state per camera");
    assert_eq!(with, 0);
    assert!(without > 0);
}

/// However many frames are averaged, the error that lasts is stated.
#[test]
fn a_lasting_error_does_not_average_out() {
    let mut tracker = tracker();
    for step in 0..200 {
        let seconds = 0.1 * f64::from(step);
        tracker.observe(&frame("a", seconds, vec![seen(at(seconds, 0.0), Some("7"))]));
    }
    let state = tracker.tracks().next().expect("a track").state();
    let lasting_m2 = 0.01 + 0.25;
    assert!(state.covariance_m2.east_m2 > lasting_m2, "{state:?}");
    assert!(state.covariance_m2.east_m2 < lasting_m2 + 0.04, "{state:?}");
}

#[test]
fn detections_without_any_error_are_tracked() {
    let mut tracker = tracker();
    let exact = |camera: &str, seconds: f64| {
        let none = PlaneCovariance::default();
        let detection = WorldDetection {
            covariance_m2: none,
            offset_covariance_m2: none,
            common_covariance_m2: none,
            ..seen(at(seconds, 0.0), Some("7"))
        };
        frame(camera, seconds, vec![detection])
    };
    // Twice at one instant, too.
    let frames = [exact("a", 0.0), exact("a", 0.0), exact("b", 0.0), exact("a", 0.5), exact("b", 0.5)];
    let tracks: Vec<WorldTrackId> = frames.iter().map(|own| only_track(&tracker.observe(own))).collect();
    assert!(tracks.iter().all(|track| *track == tracks[0]), "{tracks:?}");
    let state = tracker.tracks().next().expect("a track").state();
    assert!(state.covariance_m2.is_finite() && state.position.distance_m(at(0.5, 0.0)) < 0.1, "{state:?}");
}

/// Walkers who cross a place in all directions, seen by three cameras whose maps differ a little; the times of the third are
/// late.
#[test]
fn a_camera_whose_clock_is_late_is_found_within_two_minutes_and_corrected() {
    for late_s in [0.0, 0.5] {
        let (mut tracker, mut random) = (tracker(), stream(7, 0));
        let courses: Vec<f64> = (0..30).map(|_| std::f64::consts::TAU * random.random::<f64>()).collect();
        let position = |walker: usize, seconds: f64| {
            let along_m = 1.3 * (seconds - 4.0 * walker as f64 - 8.0);
            let beside_m = 2.0 * (walker % 5) as f64 - 4.0;
            let (sin, cos) = courses[walker].sin_cos();
            (along_m.abs() < 10.0).then(|| at(along_m * cos - beside_m * sin, along_m * sin + beside_m * cos))
        };
        for step in 0..240 {
            let seconds = 0.5 * f64::from(step);
            for (camera, late_s, offset) in
                [("a", 0.0, at(0.1, 0.0)), ("b", 0.0, at(0.0, -0.1)), ("c", late_s, at(-0.1, 0.1))]
            {
                let in_view = (0..courses.len()).filter_map(|walker| position(walker, seconds - late_s));
                let detections = in_view.map(|own| {
                    let noise = [0; 2].map(|_| 0.1 * standard_normal(&mut random));
                    seen(own.plus(offset).plus(at(noise[0], noise[1])), None)
                });
                let detections = detections.collect();
                let frame = frame(camera, seconds, detections);
                let time = tracker.corrected(&frame.camera, frame.time);
                tracker.observe(&CameraFrame { time, ..frame });
            }
        }
        for (camera, late_s) in [("a", 0.0), ("b", 0.0), ("c", late_s)] {
            let clock = tracker.clocks()[&CameraId::new(camera).expect("slug")];
            assert!((clock.offset_s - late_s).abs() < 0.12, "{camera}: {clock:?} of {late_s}");
            assert_eq!(clock.is_wrong(), late_s > 0.0, "{camera}: {clock:?}");
        }
    }
}

/// Where all targets walk alike, the difference of two maps looks like that of two clocks: nothing is corrected.
#[test]
fn targets_that_walk_alike_tell_nothing_of_clocks() {
    let (mut tracker, mut random) = (tracker(), stream(8, 0));
    for step in 0..400 {
        let seconds = 0.5 * f64::from(step);
        for (camera, ahead_m) in [("a", 0.0), ("b", 0.6)] {
            let in_view = (0..50).map(|walker| 1.3 * (seconds - 4.0 * f64::from(walker)));
            let detections = in_view.filter(|along_m| (0.0..20.0).contains(along_m)).map(|along_m| {
                let noise = [0; 2].map(|_| 0.1 * standard_normal(&mut random));
                seen(at(along_m + ahead_m + noise[0], noise[1]), None)
            });
            let detections = detections.collect();
            tracker.observe(&frame(camera, seconds, detections));
        }
    }
    assert!(tracker.clocks().values().all(|clock| !clock.is_wrong()), "{:?}", tracker.clocks());
}
