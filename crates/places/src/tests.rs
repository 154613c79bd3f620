//! Tracks with known truth through places.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::domain::{CameraId, ErrorKind, PlaceId, PlaceKey, Revision, TargetClass, TrackScope, Velocity};
use crate::event::{Direction, PlaceEvent};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};
use crate::settings::{EventKind, PlaceSettings};
use crate::statistics::Counts;
use crate::{Engine, Measurement, Outcome, Place, PlaceIndex};

const STEP_S: f64 = 0.1;

fn plane() -> LocalPlane {
    LocalPlane::new(Position::new(8.54, 47.37).expect("valid"))
}

/// Longitude and latitude of a point, m east and north of the origin.
fn degrees(east_m: f64, north_m: f64) -> [f64; 2] {
    let position = plane().to_position(EastNorth { east_m, north_m });
    [position.longitude_deg(), position.latitude_deg()]
}

fn place(number: i64, geometry: &serde_json::Value, rules: &serde_json::Value) -> Arc<Place> {
    let settings = serde_json::json!({ "display_name": "P", "geometry": geometry, "rules": rules });
    let settings: PlaceSettings = serde_json::from_value(settings).expect("settings");
    let id = PlaceId::new(&format!("p{number}")).expect("a slug");
    Arc::new(Place::new(PlaceKey(number), id, Revision(1), settings).expect("valid"))
}

/// A line from south to north at some metres east, 40 m long: targets that go east cross it from its left to its right.
fn line(number: i64, east_m: f64) -> Arc<Place> {
    let coordinates = [degrees(east_m, -20.0), degrees(east_m, 20.0)];
    let geometry = serde_json::json!({ "type": "LineString", "coordinates": coordinates });
    let rules = serde_json::json!([{ "id": "any", "kind": "cross" }, { "id": "wrong", "kind": "wrong_way" }]);
    place(number, &geometry, &rules)
}

fn square(rules: &serde_json::Value) -> Arc<Place> {
    let corners = [(-10.0, -10.0), (10.0, -10.0), (10.0, 10.0), (-10.0, 10.0), (-10.0, -10.0)];
    let ring: Vec<_> = corners.iter().map(|(east_m, north_m)| degrees(*east_m, *north_m)).collect();
    place(7, &serde_json::json!({ "type": "Polygon", "coordinates": [ring] }), rules)
}

fn engine(places: impl IntoIterator<Item = Arc<Place>>) -> Engine {
    let scope = TrackScope::Camera(CameraId::new("gate").expect("a slug"));
    Engine::new(scope, Arc::new(PlaceIndex::new(places)), 100)
}

fn time(seconds: f64) -> Timestamp {
    let offset = SignedDuration::try_from_secs_f64(seconds).expect("in range");
    Timestamp::from_second(1_800_000_000).expect("in range").checked_add(offset).expect("in range")
}

/// What is measured of a target at a point, with errors of that standard deviation.
fn measured(track: &str, at_s: f64, point: EastNorth, velocity_mps: [f64; 2], sigma_m: f64) -> Measurement {
    let [east_m_s, north_m_s] = velocity_mps;
    let velocity_error = PlaneCovariance::isotropic(0.04);
    Measurement {
        time: time(at_s),
        track: track.into(),
        identity: track.into(),
        target_id: None,
        class: TargetClass::new("car").ok(),
        position: plane().to_position(point),
        velocity: Velocity { east_m_s, north_m_s },
        covariance_m2: PlaneCovariance::isotropic(sigma_m * sigma_m),
        velocity_covariance_m2_s2: velocity_error,
        stationary_probability: Velocity { east_m_s, north_m_s }.stationary_probability(velocity_error, 1.5),
        has_box: true,
        has_fix: false,
    }
}

/// Drives from `from_m` towards the east with an error that changes slowly, as that of a track does.
fn drive(engine: &mut Engine, track: &str, from_m: f64, speed_mps: f64, sigma_m: f64, seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let memory = (-STEP_S / 3.0f64).exp();
    let mut draw = || sigma_m * random.sample::<f64, _>(StandardNormal);
    let mut error = [draw(), draw()];
    let steps = (2.0 * from_m.abs() / speed_mps.abs() / STEP_S) as usize;
    for step in 0..steps {
        let at_s = step as f64 * STEP_S;
        error = error.map(|error| memory * error + (1.0 - memory * memory).sqrt() * draw());
        let point = EastNorth { east_m: from_m + speed_mps * at_s + error[0], north_m: error[1] };
        engine.observe(measured(track, at_s, point, [speed_mps, 0.0], sigma_m));
    }
}

fn events(engine: &mut Engine, kind: EventKind) -> Vec<PlaceEvent> {
    all_events(engine).into_iter().filter(|event| event.kind == kind).collect()
}

fn all_events(engine: &mut Engine) -> Vec<PlaceEvent> {
    engine.take_outcome().events.into_iter().map(|(_, event)| event).collect()
}

#[test]
fn the_interval_of_a_crossing_holds_its_true_time() {
    let (mut crossings, mut covered) = (0, 0);
    for (speed_mps, sigma_m) in [(1.5, 0.3), (5.0, 0.5), (15.0, 1.0), (40.0, 1.5)] {
        for seed in 0..250 {
            let mut engine = engine([line(1, 0.0)]);
            drive(&mut engine, "t", -60.0, speed_mps, sigma_m, seed);
            let found = events(&mut engine, EventKind::Cross);
            assert_eq!(found.len(), 1, "{speed_mps} m/s, seed {seed}: {found:?}");
            assert_eq!(found[0].direction, Some(Direction::LeftToRight));
            let true_s = 60.0 / speed_mps;
            let error_s = found[0].time.duration_since(time(true_s)).as_secs_f64();
            crossings += 1;
            covered += usize::from(error_s.abs() <= 1.959_964 * found[0].time_sigma_s);
        }
    }
    let share = f64::from(covered as u32) / f64::from(crossings);
    assert!((0.92..=0.98).contains(&share), "{share}");
}

#[test]
fn a_target_on_the_border_makes_no_series_of_events() {
    let rules = serde_json::json!([{ "id": "in", "kind": "enter" }, { "id": "out", "kind": "leave" }]);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut changes = 0;
    for track in 0..20 {
        let mut engine = engine([square(&rules), line(8, 10.0)]);
        let mut error = 0.0;
        for step in 0..6_000 {
            error =
                0.97 * error + (1.0 - 0.97f64 * 0.97).sqrt() * 0.5 * random.sample::<f64, _>(StandardNormal);
            let point = EastNorth { east_m: 10.0 + error, north_m: 0.0 };
            let id = format!("t{track}");
            engine.observe(measured(&id, f64::from(step) * STEP_S, point, [0.0, 0.0], 0.5));
        }
        changes += all_events(&mut engine).len();
    }
    // In these 200 minutes the estimate changes its side of the border thousands of times.
    assert!(changes <= 20, "{changes} events");
}

#[test]
fn what_passes_beside_the_end_of_a_line_does_not_cross_it() {
    let mut engine = engine([line(1, 0.0)]);
    for step in 0..200 {
        let point = EastNorth { east_m: -20.0 + 0.2 * f64::from(step), north_m: 22.0 };
        engine.observe(measured("t", f64::from(step) * STEP_S, point, [2.0, 0.0], 0.3));
    }
    assert_eq!(all_events(&mut engine), []);
}

#[test]
fn a_fast_target_is_counted_however_far_apart_its_measurements_are() {
    let mut engine = engine([line(1, 0.0)]);
    for (at_s, east_m) in [(0.0, -300.0), (5.0, -100.0), (10.0, 100.0)] {
        engine.observe(measured("t", at_s, EastNorth { east_m, north_m: 0.0 }, [40.0, 0.0], 1.0));
    }
    let found = events(&mut engine, EventKind::Cross);
    assert_eq!(found.len(), 1);
    assert!((found[0].time.duration_since(time(7.5)).as_secs_f64()).abs() < 0.01, "{:?}", found[0].time);
}

#[test]
fn the_same_tracks_give_the_same_events() {
    let run = || {
        let mut engine = engine([line(1, 0.0), line(2, 20.0)]);
        drive(&mut engine, "t", -60.0, 10.0, 0.5, 3);
        all_events(&mut engine)
    };
    let first = run();
    assert_eq!(first.len(), 2);
    assert_ne!(first[0].id, first[1].id);
    assert_eq!(first, run());
}

#[test]
fn against_the_direction_of_a_line_is_the_wrong_way() {
    let mut engine = engine([line(1, 0.0)]);
    drive(&mut engine, "t", 60.0, -10.0, 0.3, 1);
    let found = events(&mut engine, EventKind::WrongWay);
    assert_eq!((found.len(), found[0].direction), (1, Some(Direction::RightToLeft)));
}

#[test]
fn a_visit_is_reported_by_each_rule_and_counted_once() {
    let rules = serde_json::json!([
        { "id": "in", "kind": "enter" }, { "id": "out", "kind": "leave" },
        { "id": "stay", "kind": "dwell", "after_s": 3.0 },
        { "id": "fast", "kind": "speed_above", "speed_mps": 4.0 },
        { "id": "slow", "kind": "speed_below", "speed_mps": 4.0 },
        { "id": "bikes", "kind": "enter", "classes": ["bicycle"] },
        { "id": "unknown", "kind": "box_without_receiver", "after_s": 2.0 },
    ]);
    let place = square(&rules);
    let mut engine = engine([place.clone()]);
    drive(&mut engine, "t", -40.0, 2.0, 0.1, 1);
    let Outcome { events, counts } = engine.take_outcome();
    let events: Vec<_> = events.into_iter().map(|(_, event)| event).collect();
    let mut kinds: Vec<_> = events.iter().map(|event| (&*event.rule_id, event.time)).collect();
    kinds.sort_by_key(|(_, time)| *time);
    let names: Vec<_> = kinds.iter().map(|(rule, _)| *rule).collect();
    assert_eq!(names, ["in", "slow", "unknown", "stay", "out"], "{events:?}");
    let left = events.iter().find(|event| event.rule_id == "out").expect("it left");
    assert!((left.dwell_s.expect("it was inside") - 10.0).abs() < 0.3, "{left:?}");
    let mut all = Counts::default();
    for (figure, value) in counts.values().flat_map(Counts::to_figures) {
        all.add_figure(&figure, value);
    }
    let figures = all.figures(60.0);
    assert_eq!((figures.enters.count, figures.leaves.count), (1, 1));
    assert!((figures.mean_occupancy - 10.0 / 60.0).abs() < 0.01, "{figures:?}");
    assert_eq!(engine.occupancy(place.key).count, 0);
}

#[test]
fn tracks_that_begin_and_end_inside_appear_and_are_lost() {
    let rules = serde_json::json!([
        { "id": "new", "kind": "appeared" }, { "id": "gone", "kind": "lost" }, { "id": "in", "kind": "enter" },
    ]);
    let mut engine = engine([square(&rules)]);
    for step in 0..10 {
        engine.observe(measured("t", f64::from(step), EastNorth::default(), [0.0, 0.0], 0.3));
    }
    engine.advance(time(30.0));
    let found = all_events(&mut engine);
    let reported: Vec<_> = found.iter().map(|event| (event.kind, event.time)).collect();
    assert_eq!(reported, [(EventKind::Appeared, time(0.0)), (EventKind::Lost, time(9.0))]);
}

#[test]
fn two_targets_are_near_once_until_they_part() {
    let rules = serde_json::json!([{ "id": "close", "kind": "near", "distance_m": 3.0 }]);
    let mut engine = engine([square(&rules)]);
    for step in 0..160 {
        let at_s = f64::from(step) * STEP_S;
        engine.observe(measured("a", at_s, EastNorth::default(), [0.0, 0.0], 0.2));
        let point = EastNorth { east_m: -8.0 + at_s, north_m: 1.0 };
        engine.observe(measured("b", at_s, point, [1.0, 0.0], 0.2));
    }
    let found = all_events(&mut engine);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].distance_m.expect("of two") < 3.0);
}

#[test]
fn origins_and_destinations_are_counted_between_lines() {
    let mut engine = engine([line(1, -10.0), line(2, 10.0)]);
    drive(&mut engine, "t", -60.0, 10.0, 0.3, 2);
    let counts = engine.take_outcome().counts;
    let of_second = counts.iter().find(|((place, ..), _)| *place == PlaceKey(2)).expect("crossed");
    let figures = of_second.1.figures(60.0);
    assert_eq!(figures.origins.get("p1"), Some(&1));
    assert_eq!(figures.left_to_right.count, 1);
    assert!((figures.speed_mps[1].value - 10.0).abs() < 0.2, "{figures:?}");
}

#[test]
fn a_geometry_that_cannot_be_evaluated_is_refused_by_name() {
    let polygon = |ring: &[[f64; 2]]| serde_json::json!({ "type": "Polygon", "coordinates": [ring] });
    let many: Vec<_> = (0..600).map(|number| degrees(f64::from(number), 0.0)).collect();
    let cases = [
        (polygon(&[[8.0, 47.0], [8.001, 47.001], [8.001, 47.0], [8.0, 47.001], [8.0, 47.0]]), "not valid"),
        (polygon(&[[8.0, 47.0], [8.001, 47.001], [8.0, 47.0]]), "4 points"),
        (polygon(&[[8.0, 47.0], [8.001, 47.0], [8.002, 47.0], [8.0, 47.0]]), "no area"),
        (polygon(&[[8.0, 47.0], [8.001, 47.0], [8.001, 47.001], [8.0, 47.001]]), "first corner"),
        (polygon(&[[179.9, 0.0], [-179.9, 0.0], [-179.9, 0.1], [179.9, 0.0]]), "antimeridian"),
        (polygon(&[[8.0, 89.0], [8.1, 89.0], [8.1, 89.1], [8.0, 89.0]]), "pole"),
        (polygon(&[[8.0, 47.0], [9.0, 47.0], [9.0, 47.1], [8.0, 47.0]]), "too large"),
        (polygon(&[[8.0, 91.0], [9.0, 47.0], [9.0, 47.1], [8.0, 91.0]]), "latitude"),
        (serde_json::json!({ "type": "LineString", "coordinates": many }), "512"),
        (serde_json::json!({ "type": "LineString", "coordinates": [[8.0, 47.0], [8.0, 47.0]] }), "differ"),
        (
            serde_json::json!({ "type": "LineString", "coordinates":
                [[8.0, 47.0], [8.002, 47.0], [8.001, 47.001], [8.001, 46.999]] }),
            "cross itself",
        ),
    ];
    for (geometry, word) in cases {
        let settings = serde_json::json!({ "display_name": "P", "geometry": geometry });
        let settings: PlaceSettings = serde_json::from_value(settings).expect("settings");
        let error = Place::check(&settings).expect_err(word);
        assert_eq!(error.kind(), ErrorKind::InvalidArgument);
        assert!(error.to_string().contains(word), "{word}: {error}");
    }
}
