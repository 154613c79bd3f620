//! Wrong positions, wrong clocks, deleted cameras: what they do to live answers, and to others.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use sightfix::clock::{Clock, Randomness};
use sightfix::config::Config;
use sightfix::domain::{CameraId, ErrorKind, Fix, NewCamera, Observation, TargetId};
use sightfix::geo::{EastNorth, LocalPlane, Position, distance_m};
use sightfix::grpc::proto;
use sightfix::grpc::proto::stream_answer::Outcome;
use sightfix::server::Server;
use sightfix::simulation::{Options, SimulatedRow};
use tonic::Code;

use crate::harness::{TestServer, data_folder};
use crate::live_client::{Received, boxed, channel, fixed, open, rows, whole, yard};

fn position_of(value: &Value) -> Position {
    let degrees = |name: &str| value[name].as_f64().expect("degrees");
    Position::new(degrees("longitude_deg"), degrees("latitude_deg")).expect("valid")
}

fn track_position(feature: &Value) -> Position {
    let degrees = |axis: usize| feature["geometry"]["coordinates"][axis].as_f64().expect("degrees");
    Position::new(degrees(0), degrees(1)).expect("valid")
}

fn fix_json(position: Position) -> Value {
    json!({"longitude_deg": position.longitude_deg(), "latitude_deg": position.latitude_deg()})
}

fn box_json(row: &SimulatedRow) -> Value {
    let [left_px, top_px, width_px, height_px] = row.bounding_box.expect("a box").sides_px();
    json!({"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px})
}

/// A fix of a target alone, for `tracks`.
fn fix_of(target: &str, time: Timestamp, position: Position) -> Value {
    json!({"time": time, "target_id": target, "fix": fix_json(position)})
}

async fn follow(server: &TestServer, observation: &Value) -> Value {
    server.post("/v1/cameras/yard/tracks", observation).await.expect(200).json()["items"][0].clone()
}

fn at(longitude_deg: f64, latitude_deg: f64) -> Position {
    Position::new(longitude_deg, latitude_deg).expect("valid")
}

/// Null island, a pole, the other hemisphere, coordinates swapped, and a place 60 km away.
fn far_positions(near: Position) -> [Position; 5] {
    let (longitude_deg, latitude_deg) = (near.longitude_deg(), near.latitude_deg());
    [
        at(0.0, 0.0),
        at(0.0, 90.0),
        at(longitude_deg, -latitude_deg),
        at(latitude_deg, longitude_deg.clamp(-90.0, 90.0)),
        at(longitude_deg, latitude_deg + 0.54),
    ]
}

#[tokio::test]
async fn one_wrong_fix_displaces_no_track_of_a_camera_without_a_model() {
    let near = at(8.0, 47.0);
    for far in far_positions(near) {
        let folder = data_folder();
        let server = yard(folder.path(), &[], json!({}), false).await;
        let start: Timestamp = "2026-01-01T00:00:00Z".parse().expect("an instant");
        let second = |index: i64| start + SignedDuration::from_secs(index);
        follow(&server, &fix_of("wrong", second(0), far)).await;
        let mut worst_m: f64 = 0.0;
        for index in 0..5 {
            let item = follow(&server, &fix_of("right", second(index), near)).await;
            worst_m = worst_m.max(distance_m(track_position(&item["track"]), near));
        }
        // Nor does it outlast two good fixes of its own target.
        for index in 1..3 {
            follow(&server, &fix_of("wrong", second(index), near)).await;
        }
        let item = follow(&server, &fix_of("wrong", second(3), near)).await;
        let own_m = distance_m(track_position(&item["track"]), near);
        println!("first fix at {far:?}: another target {worst_m:.1} m off, its own later {own_m:.1} m");
        assert!(worst_m < 5.0 && own_m < 5.0, "{far:?}: {worst_m} m, {own_m} m");
    }
}

#[tokio::test]
async fn one_wrong_fix_is_flagged_and_displaces_no_track_of_a_camera_with_a_model() {
    let rows = rows(&Options { seed: 51, samples: 40, targets: 1, ..Options::demo() });
    for far in far_positions(rows[0].truth) {
        let folder = data_folder();
        let server = yard(folder.path(), &[], json!({}), true).await;
        let alone = follow(&server, &fix_of("wrong", rows[0].time, far)).await;
        assert!(flags(&alone["fused"]).contains(&"fix_out_of_range"), "{alone}");
        assert!(alone["track"].is_null(), "{alone}");
        let both = json!({
            "time": rows[0].time, "target_id": "both", "bounding_box": box_json(&rows[0]), "fix": fix_json(far)
        });
        let both = follow(&server, &both).await;
        assert!(flags(&both["fused"]).contains(&"fix_rejected"), "{both}");
        let rejection = &both["track"]["properties"]["rejections"][0];
        assert_eq!((&rejection["source"], &rejection["reason"]), (&json!("fix"), &json!("out_of_range")));
        let mut worst_m: f64 = distance_m(track_position(&both["track"]), rows[0].truth);
        for row in &rows {
            let observation = json!({"time": row.time, "target_id": "right", "bounding_box": box_json(row)});
            let item = follow(&server, &observation).await;
            worst_m = worst_m.max(distance_m(track_position(&item["track"]), row.truth));
        }
        println!("a fix at {far:?}: tracks at most {worst_m:.1} m off");
        assert!(worst_m < 5.0, "{far:?}: {worst_m} m");
    }
}

fn flags(fused: &Value) -> Vec<&str> {
    fused["flags"].as_array().expect("flags").iter().map(|flag| flag.as_str().expect("a name")).collect()
}

#[tokio::test]
async fn a_clock_that_is_ahead_is_refused_and_disturbs_nobody() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let rows = rows(&Options { seed: 52, samples: 20, targets: 1, ..Options::demo() });
    #[expect(clippy::disallowed_methods, reason = "the server reads the wall clock, too")]
    let now = Timestamp::now();
    let live = |row: &SimulatedRow, name: &str, ahead_s: i64| {
        let mut item = whole(row);
        let time = now + SignedDuration::from_secs(ahead_s) + row.time.duration_since(rows[19].time);
        item.time =
            Some(prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() });
        proto::StreamItem { target_id: Some(name.to_owned()), ..item }
    };
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    for row in &rows {
        client.item(live(row, "walker", 0)).await;
        assert!(matches!(client.answer().await.outcome, Some(Outcome::Fused(_))));
    }
    for ahead_s in [65, 3_600, 23 * 3_600] {
        for name in ["phone", "walker"] {
            client.item(live(&rows[19], name, ahead_s)).await;
            let Some(Outcome::Error(error)) = client.answer().await.outcome else {
                panic!("{ahead_s} s taken")
            };
            assert_eq!(
                (error.field.as_str(), error.reason.as_str()),
                ("time", "invalid-argument"),
                "{error:?}"
            );
            assert!(error.message.contains("5 s ahead"), "{error:?}");
        }
    }
    let tracks = server.get("/v1/cameras/yard/tracks").await.expect(200).json();
    let names: Vec<&Value> = tracks["features"]
        .as_array()
        .expect("features")
        .iter()
        .map(|it| &it["properties"]["target_id"])
        .collect();
    assert_eq!(names, [&json!("walker")]);
    // The next item of the target is not late, within the allowed seconds even ahead.
    client.item(live(&rows[19], "walker", 2)).await;
    let track = client.answer().await.track.expect("followed");
    assert!(track.rejections.is_empty(), "{track:?}");
    let refused = server
        .post(
            "/v1/cameras/yard/tracks",
            &json!({"observations": [fix_of("phone", now + SignedDuration::from_mins(5), rows[0].truth)]}),
        )
        .await;
    assert_eq!(refused.expect(422).json()["violations"][0]["field"], "observations[0].time");
    let (acknowledgement, _, ended) = client.finish_with_counts().await;
    let acknowledgement = acknowledgement.expect("samples are stored");
    let not_stored = not_stored(&acknowledgement);
    assert!(ended.is_none() && acknowledgement.stored == 21, "{acknowledgement:?}");
    assert_eq!(not_stored, BTreeMap::from([(proto::not_stored::Reason::Refused as i32, 6)]));
}

fn not_stored(acknowledgement: &proto::StreamAcknowledgement) -> BTreeMap<i32, u64> {
    acknowledgement.not_stored.iter().map(|it| (it.reason, it.count)).collect()
}

#[tokio::test]
async fn a_fix_hours_ahead_in_a_recording_loses_no_samples() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let rows = rows(&Options { seed: 53, samples: 100, targets: 1, ..Options::demo() });
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    for (index, row) in rows.iter().enumerate() {
        if index == 3 {
            let mut ahead = fixed(row);
            ahead.time.as_mut().expect("set").seconds += 7_200;
            client.item(ahead).await;
        }
        client.item(boxed(row)).await;
        client.item(fixed(row)).await;
    }
    let (acknowledgement, _, ended) = client.finish_with_counts().await;
    let acknowledgement = acknowledgement.expect("acknowledged");
    let samples = server.get("/v1/cameras/yard/samples/count").await.expect(200).json();
    println!("{} samples of 100; {acknowledgement:?}", samples["count"]);
    assert!(ended.is_none() && acknowledgement.seq == 201, "{acknowledgement:?} {ended:?}");
    assert_eq!(samples["count"], 100);
    assert_eq!(acknowledgement.stored, 200);
    assert_eq!(
        not_stored(&acknowledgement),
        BTreeMap::from([(proto::not_stored::Reason::Unpaired as i32, 1)])
    );
}

/// One input of the table in docs/explanation/method.md.
struct Case {
    name: &'static str,
    bounding_box: Value,
    fix: Position,
    truth: Position,
}

fn cases(rows: &[SimulatedRow], origin: Position) -> Vec<Case> {
    let plane = LocalPlane::new(origin);
    let row = &rows[rows.len() / 2];
    let moved = |position: Position, east_m: f64| {
        let point = plane.to_plane(position);
        plane.to_position(EastNorth { east_m: point.east_m + east_m, ..point })
    };
    let of =
        |name, row: &SimulatedRow, fix| Case { name, bounding_box: box_json(row), fix, truth: row.truth };
    let (truth, fix) = (row.truth, row.fix.expect("no gaps").position);
    // The row farthest from this one: its box, or its place for a receiver that stands still.
    let other = rows
        .iter()
        .max_by(|a, b| distance_m(a.truth, truth).total_cmp(&distance_m(b.truth, truth)))
        .expect("rows");
    let swapped = at(truth.latitude_deg(), truth.longitude_deg().clamp(-90.0, 90.0));
    vec![
        of("consistent", row, fix),
        of("fix off by 3 m", row, moved(truth, 3.0)),
        of("fix off by 5 m", row, moved(truth, 5.0)),
        of("fix off by 7 m", row, moved(truth, 7.0)),
        of("fix off by 10 m", row, moved(truth, 10.0)),
        of("fix off by 30 m", row, moved(truth, 30.0)),
        of("fix off by 1 km", row, moved(truth, 1_000.0)),
        of("fix in the other hemisphere", row, at(truth.longitude_deg(), -truth.latitude_deg())),
        of("fix at (0, 0)", row, at(0.0, 0.0)),
        of("longitude and latitude swapped", row, swapped),
        of("frozen receiver", row, other.fix.expect("no gaps").position),
        Case { name: "box of another target", bounding_box: box_json(other), fix, truth },
    ]
}

/// Radius of 99 % per radius of 95 % of a circular normal error. One row may lie outside of the latter, hardly of the former.
const R99_PER_R95: f64 = 1.24;

/// Prints the table of docs/explanation/method.md.
#[tokio::test]
async fn sources_that_contradict_each_other_are_flagged_and_the_radius_holds_the_truth() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let rows = rows(&Options { seed: 54, samples: 200, targets: 1, ..Options::demo() });
    let number =
        |fused: &Value, name: &str| fused[name].as_f64().unwrap_or_else(|| panic!("{name}: {fused}"));
    println!(
        "| input | error of the position | `r95_m` | `confidence_regression` | flags |\n|---|---|---|---|---|"
    );
    for Case { name, bounding_box, fix, truth } in cases(&rows, rows[0].truth) {
        let observation = json!({
            "time": rows[100].time, "target_id": name, "bounding_box": bounding_box, "fix": fix_json(fix)
        });
        let answer = server.post("/v1/cameras/yard/fusions", &observation).await.expect(200).json();
        let fused = &answer["items"][0];
        let error_m = distance_m(position_of(&fused["fused"]), truth);
        let (r95_m, flags) = (number(fused, "r95_m"), flags(fused));
        println!(
            "| {name} | {error_m:.2} m | {r95_m:.2} m | {:.2} | {} |",
            number(fused, "confidence_regression"),
            flags.join(", ")
        );
        assert!(error_m <= R99_PER_R95 * r95_m, "{name}: {fused}");
        let apart_m = distance_m(fix, position_of(&fused["regressed"]));
        assert_eq!(flags.contains(&"sources_disagree"), apart_m > 9.5, "{name}: {apart_m} m, {fused}");
        // The live answer of the same observation says the same.
        let live = follow(&server, &observation).await;
        assert_eq!(&live["fused"], fused, "{name}");
    }
}

#[tokio::test]
async fn a_fix_alone_has_the_receiver_error_of_the_model() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({"gnss_error": "unknown"}), true).await;
    let rows = rows(&Options { seed: 55, samples: 20, targets: 1, ..Options::demo() });
    let fix = fix_json(rows[0].fix.expect("no gaps").position);
    let body = json!({"observations": [
        {"time": rows[0].time, "fix": fix},
        {"time": rows[0].time, "bounding_box": box_json(&rows[0]), "fix": fix},
    ]});
    let answer = server.post("/v1/cameras/yard/fusions", &body).await.expect(200).json();
    let (alone, both) = (&answer["items"][0], &answer["items"][1]);
    println!("r95_m of the fix alone: {}, e_gnss_m2 beside a box: {}", alone["r95_m"], both["e_gnss_m2"]);
    assert_eq!(alone["e_gnss_m2"], both["e_gnss_m2"]);
    let r95_m = 2.447_746_830_680_816 * both["e_gnss_m2"].as_f64().expect("a number").sqrt();
    assert!((alone["r95_m"].as_f64().expect("a number") - r95_m).abs() < 1e-9, "{alone}");
}

#[tokio::test]
async fn a_wall_clock_that_jumps_back_keeps_no_target_out() {
    let folder = data_folder();
    let wall_s = Arc::new(AtomicI64::new(1_767_225_600));
    let monotonic_s = Arc::new(AtomicU64::new(0));
    let clock = {
        let (wall_s, monotonic_s) = (wall_s.clone(), monotonic_s.clone());
        let now = move || Timestamp::from_second(wall_s.load(Ordering::SeqCst)).expect("in range");
        Clock::from_fn(now).with_monotonic(move || Duration::from_secs(monotonic_s.load(Ordering::SeqCst)))
    };
    let mut config = Config { data: folder.path().to_owned(), ..Config::default() };
    config.listen.set_port(0);
    config.limits.tracks_per_camera = 4;
    let server = Server::bind(config, clock, Randomness::seeded(1)).await.expect("a free port");
    let app = server.app();
    let id = CameraId::new("yard").expect("a slug");
    app.cameras().create(NewCamera::named(id.clone())).await.expect("a new camera");
    let (camera, lease) = app.nodes().own_camera(&id).await.expect("known");
    let follow = |name: &str| {
        let time = Timestamp::from_second(wall_s.load(Ordering::SeqCst)).expect("in range");
        let target_id = Some(TargetId::new(name).expect("a name"));
        let fix = Fix { position: at(8.0, 47.0), sigma_m: None };
        app.live().follow((&camera, &lease), Observation::with_fix(time, target_id, None, fix))
    };
    for name in ["a", "b", "c", "d"] {
        follow(name).expect("followed");
    }
    assert_eq!(follow("e").expect_err("no room").kind(), ErrorKind::Overloaded);
    wall_s.fetch_sub(3_600, Ordering::SeqCst);
    monotonic_s.fetch_add(61, Ordering::SeqCst);
    assert!(app.live().tracks(&id).await.expect("tracks").is_empty(), "expired by the monotonic clock");
    follow("e").expect("there is room");
    assert_eq!(app.live().tracks(&id).await.expect("tracks").len(), 1);
}

#[tokio::test]
async fn streams_and_listeners_of_a_deleted_camera_end() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let rows = rows(&Options { seed: 56, samples: 40, targets: 1, ..Options::demo() });
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    let events = server.open("GET", "/v1/cameras/yard/events", &[], "").await.into_body();
    for row in &rows[..20] {
        client.item(whole(row)).await;
        client.answer().await;
    }
    server.send("DELETE", "/v1/cameras/yard", &[("if-match", "*")], "").await.expect(204);
    server.post("/v1/cameras", &json!({"id": "yard"})).await.expect(201);
    for row in &rows[20..] {
        client.item(whole(row)).await;
    }
    let ended = async {
        loop {
            match client.next().await {
                Ok(Some(Received::Answer(_) | Received::Acknowledgement(_))) => {}
                other => break other,
            }
        }
    };
    let status = ended.await.expect_err("ends with a status");
    assert_eq!(status.code(), Code::NotFound, "{status:?}");
    // The events end, too: the body can be read to its end.
    let body = tokio::time::timeout(Duration::from_secs(30), http_body_util::BodyExt::collect(events));
    body.await.expect("the events end").expect("in order");
    let samples = server.get("/v1/cameras/yard/samples/count").await.expect(200).json();
    assert_eq!(samples["count"], 0, "samples of the old camera are in the new one");
}

#[tokio::test]
async fn a_retraining_that_failed_is_tried_again() {
    let folder = data_folder();
    let settings = [("SIGHTFIX_LIMITS__RETRAIN_PAUSE_S", "1")];
    let server = yard(folder.path(), &settings, json!({"retrain_when_moved": true}), true).await;
    let csv = crate::harness::simulated_csv();
    let kind = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/yard/samples", &kind, csv).await.expect(200);
    assert!(server.terminate(), "ends well");
    // The camera was moved, and the run that was started for it has failed.
    let database = rusqlite::Connection::open(folder.path().join("sightfix.db")).expect("the database");
    let failed = "019b0000-0000-7000-8000-000000000001";
    database
        .execute(
            "INSERT INTO training_runs (id, camera_key, recipe, seed, state, created_at_us, priority) \
             SELECT ?, key, 'hybrid', 0, 'failed', 0, 0 FROM cameras",
            [failed],
        )
        .expect("a run");
    database
        .execute(
            "INSERT INTO camera_moves (camera_key, model_number, began_at_us, raised_at_us, shift_east_m, \
             shift_north_m, statistic, targets, retraining_run) SELECT key, 1, 0, 0, 3, 0, 30, 2, ? FROM cameras",
            [failed],
        )
        .expect("a move");
    drop(database);
    let server = TestServer::start_with(folder.path(), &settings);
    let begun = Instant::now();
    loop {
        let runs = server.get("/v1/cameras/yard/training-runs").await.expect(200).json();
        if runs["items"].as_array().expect("runs").len() > 1 {
            break;
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "no run was started again");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}
