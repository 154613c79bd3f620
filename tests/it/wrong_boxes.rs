//! Boxes that are wrong: of a frozen picture, of something else, beside good fixes, gross ones and none.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use sightfix::geo::{Position, distance_m};
use sightfix::simulation::{Options, SimulatedRow, simulate};

use crate::harness::{TestServer, data_folder, simulated_csv};

const IMAGE_PX: [f64; 2] = [1280.0, 720.0];

/// A camera that was trained by a recipe.
async fn trained(folder: &std::path::Path, recipe: &str) -> TestServer {
    let server = TestServer::start(folder);
    let size = json!({"width_px": 1280, "height_px": 720});
    let camera = json!({"id": "c", "image_size": size, "gnss_error": {"sigma_m": 2.2}});
    server.post("/v1/cameras", &camera).await.expect(201);
    let kind = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &kind, simulated_csv()).await.expect(200);
    let run = server.train("c", &json!({"recipe": recipe, "epochs": 20})).await;
    assert_eq!(run["state"], "succeeded", "{run}");
    server
}

/// One target that walks in view of the camera without a pause of more than a second.
fn walk(seed: u64, seconds: usize) -> Vec<SimulatedRow> {
    let options = Options { seed, samples: 8 * seconds, targets: 1, ..Options::demo() };
    let rows = simulate(&options).rows;
    let walks = rows.chunk_by(|one, next| next.time.duration_since(one.time).as_secs() == 1);
    walks.max_by_key(|walk| walk.len()).expect("rows").iter().take(seconds).cloned().collect()
}

fn box_json(row: &SimulatedRow) -> Value {
    let [left_px, top_px, width_px, height_px] = row.bounding_box.expect("a box").sides_px();
    json!({"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px})
}

/// A box of any size anywhere in the image.
fn false_box(random: &mut ChaCha8Rng) -> Value {
    let [width_px, height_px] =
        [random.random_range(10.0..0.4 * IMAGE_PX[0]), random.random_range(10.0..0.5 * IMAGE_PX[1])];
    json!({
        "left_px": random.random_range(0.0..IMAGE_PX[0] - width_px),
        "top_px": random.random_range(0.0..IMAGE_PX[1] - height_px),
        "width_px": width_px, "height_px": height_px
    })
}

fn fix_json(row: &SimulatedRow) -> Value {
    let position = row.fix.expect("no gaps").position;
    json!({"longitude_deg": position.longitude_deg(), "latitude_deg": position.latitude_deg()})
}

fn position(longitude_deg: &Value, latitude_deg: &Value) -> Position {
    let degrees = |value: &Value| value.as_f64().expect("degrees");
    Position::new(degrees(longitude_deg), degrees(latitude_deg)).expect("valid")
}

/// The live answer to one observation.
async fn follow(server: &TestServer, row: &SimulatedRow, bounding_box: &Value) -> Value {
    let observation =
        json!({"time": row.time, "target_id": "walker", "bounding_box": bounding_box, "fix": fix_json(row)});
    server.post("/v1/cameras/c/tracks", &observation).await.expect(200).json()["items"][0].clone()
}

/// Distance of a track's position from the truth and its 95 % radius, m.
fn error_of(item: &Value, row: &SimulatedRow) -> (f64, f64) {
    let at = &item["track"]["geometry"]["coordinates"];
    let r95_m = item["track"]["properties"]["r95_m"].as_f64().expect("a radius");
    (distance_m(position(&at[0], &at[1]), row.truth), r95_m)
}

fn share_inside(errors: &[(f64, f64)]) -> f64 {
    errors.iter().filter(|(error_m, r95_m)| error_m <= r95_m).count() as f64 / errors.len() as f64
}

fn mentions(item: &Value, list: &Value, word: &str) -> bool {
    list.as_array()
        .unwrap_or_else(|| panic!("no list: {item}"))
        .iter()
        .any(|own| own == word || own["reason"] == word)
}

#[tokio::test]
async fn a_frozen_picture_beside_good_fixes_is_noticed_and_reported() {
    let folder = data_folder();
    let server = trained(folder.path(), "gaussian_process").await;
    let rows = walk(71, 60);
    let (moving, frozen) = rows.split_at(10);
    for row in moving {
        let item = follow(&server, row, &box_json(row)).await;
        assert!(!mentions(&item, &item["fused"]["flags"], "box_frozen"), "{item}");
    }
    let last = box_json(&moving[9]);
    let mut errors = Vec::new();
    let mut rejected = 0;
    for row in frozen {
        let item = follow(&server, row, &last).await;
        errors.push(error_of(&item, row));
        let is_frozen = mentions(&item, &item["fused"]["flags"], "box_frozen");
        rejected += usize::from(mentions(&item, &item["track"]["properties"]["rejections"], "frozen"));
        assert!(is_frozen || errors.len() <= 4, "{item}");
    }
    let status = async || server.get("/v1/camera-statuses").await.expect(200).json()["items"][0].clone();
    let inside = share_inside(&errors);
    println!("{:.0} % inside of {} s, {rejected} boxes rejected; {errors:.1?}", 100.0 * inside, errors.len());
    assert!(inside >= 0.88, "{inside}");
    assert!(rejected + 4 >= errors.len(), "{rejected}");
    assert!(status().await["frozen_since"].is_string(), "the camera is not reported");
    // The picture goes on.
    let after = &frozen[frozen.len() - 1];
    let later = SimulatedRow { time: after.time + jiff::SignedDuration::from_secs(1), ..after.clone() };
    let item = follow(&server, &later, &box_json(&later)).await;
    assert!(!mentions(&item, &item["fused"]["flags"], "box_frozen"), "{item}");
    assert!(status().await["frozen_since"].is_null(), "still reported");
}

#[tokio::test]
async fn a_false_box_is_answered_within_the_scene_by_every_recipe() {
    for recipe in ["projective", "hybrid", "gaussian_process"] {
        let folder = data_folder();
        let server = trained(folder.path(), recipe).await;
        let mut random = ChaCha8Rng::seed_from_u64(73);
        let (mut errors, mut silent) = (Vec::new(), 0);
        for row in &walk(73, 60) {
            let alone = json!({"time": row.time, "bounding_box": false_box(&mut random)});
            // A fix a kilometre off, beside such a box.
            let mut gross = json!({
                "time": row.time, "bounding_box": false_box(&mut random), "fix": fix_json(row)
            });
            let latitude_deg = row.truth.latitude_deg() + 0.009;
            gross["fix"]["latitude_deg"] = json!(latitude_deg);
            let body = json!({"observations": [alone, gross]});
            let answer = server.post("/v1/cameras/c/fusions", &body).await.expect(200).json();
            let error_of = |item: &Value| {
                let at = position(&item["fused"]["longitude_deg"], &item["fused"]["latitude_deg"]);
                (distance_m(at, row.truth), item["r95_m"].as_f64().expect("a radius"))
            };
            errors.push(error_of(&answer["items"][0]));
            let (gross, (error_m, r95_m)) = (&answer["items"][1], error_of(&answer["items"][1]));
            silent += usize::from(error_m > r95_m && !mentions(gross, &gross["flags"], "sources_disagree"));
        }
        let inside = share_inside(&errors);
        let farthest_m = errors.iter().map(|(error_m, _)| *error_m).fold(0.0, f64::max);
        println!("{recipe}: {:.0} % inside, at most {farthest_m:.0} m off, {silent} silent", 100.0 * inside);
        assert!(inside >= 0.6 && farthest_m < 400.0, "{recipe}: {inside}, {farthest_m} m");
        assert_eq!(silent, 0, "{recipe}");
    }
}

#[tokio::test]
async fn a_track_of_false_boxes_states_a_radius_that_holds() {
    let folder = data_folder();
    let server = trained(folder.path(), "gaussian_process").await;
    // Boxes alone, and beside fixes that are a kilometre off.
    for target_id in ["alone", "gross"] {
        let mut random = ChaCha8Rng::seed_from_u64(83);
        let mut errors = Vec::new();
        for row in &walk(83, 120) {
            let seen = false_box(&mut random);
            let mut observation = json!({"time": row.time, "target_id": target_id, "bounding_box": seen});
            if target_id == "gross" {
                observation["fix"] = fix_json(row);
                observation["fix"]["latitude_deg"] = json!(row.truth.latitude_deg() + 0.009);
            }
            let answer = server.post("/v1/cameras/c/tracks", &observation).await.expect(200).json();
            let item = &answer["items"][0];
            if item["track"].is_object() {
                errors.push(error_of(item, row));
            }
        }
        let inside = share_inside(&errors);
        println!("{target_id}: {:.0} % inside of {} s", 100.0 * inside, errors.len());
        assert!(errors.len() > 60 && inside >= 0.88, "{target_id}: {inside}, {errors:.0?}");
    }
}

#[tokio::test]
async fn a_hidden_foot_is_completed_and_flagged_and_a_whole_one_is_not() {
    let folder = data_folder();
    let server = trained(folder.path(), "gaussian_process").await;
    let hidden_below = |row: &SimulatedRow, visible: f64| {
        let mut hidden = box_json(row);
        hidden["height_px"] = json!(visible * hidden["height_px"].as_f64().expect("a height"));
        hidden
    };
    for visible in [1.0, 0.6, 0.4] {
        let (mut errors, mut flagged) = (Vec::new(), 0);
        for row in &walk(79, 60) {
            let observation = json!({"time": row.time, "bounding_box": hidden_below(row, visible)});
            let body = json!({"observations": [observation]});
            let answer = server.post("/v1/cameras/c/fusions", &body).await.expect(200).json();
            let item = &answer["items"][0];
            let at = position(&item["fused"]["longitude_deg"], &item["fused"]["latitude_deg"]);
            errors.push((distance_m(at, row.truth), item["r95_m"].as_f64().expect("a radius")));
            flagged += usize::from(mentions(item, &item["flags"], "foot_hidden"));
        }
        let inside = share_inside(&errors);
        let mean_m = errors.iter().map(|(error_m, _)| error_m).sum::<f64>() / errors.len() as f64;
        let count = errors.len();
        println!(
            "{visible} visible: {mean_m:.2} m, {:.0} % inside, {flagged} of {count} flagged",
            100.0 * inside
        );
        assert!(inside >= 0.88 && mean_m < 3.0, "{visible}: {inside}, {mean_m} m");
        let is_right = if visible < 1.0 { 10 * flagged >= 9 * count } else { 20 * flagged <= count };
        assert!(is_right, "{visible}: {flagged} of {count} flagged");
    }
}
