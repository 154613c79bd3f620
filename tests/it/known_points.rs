//! Known points of the ground from the outside: stated in the profile, used by training, refused where they cannot be.

use serde_json::{Value, json};
use sightfix::domain::BoundingBox;
use sightfix::evaluation::site::nearest_to_corners;
use sightfix::exchange::{Format, write_samples};
use sightfix::geo::{Position, distance_m};
use sightfix::simulation::{Options, Scene, simulate};

use crate::harness::{TestServer, data_folder};

/// Boxes with their true positions.
type Truths = Vec<(BoundingBox, Position)>;

/// One person with one phone whose fixes have a bias, as CSV; and boxes of another walk, with the truth.
fn biased_walk() -> (Vec<u8>, Truths) {
    let options = Options {
        seed: 71,
        camera_seed: 71,
        samples: 900,
        gnss_bias_sigma_m: 3.0,
        ..Options::new(Scene::Square)
    };
    let mut csv = Vec::new();
    write_samples(&mut csv, Format::Csv, &simulate(&options).training_samples()).expect("writes to memory");
    let test = simulate(&options.test(300));
    let truths = test.rows.iter().filter_map(|row| Some((row.bounding_box?, row.truth)));
    (csv, truths.collect())
}

/// The corners of what is seen, as an operator reads them off a picture and a map.
fn corners(truths: &Truths) -> Value {
    let feet_px: Vec<[f64; 2]> = truths.iter().map(|(own, _)| own.foot_px()).collect();
    let point = |at: usize| {
        let (own, truth) = truths[at];
        let [x_px, y_px] = own.foot_px();
        json!({
            "x_px": x_px, "y_px": y_px, "sigma_m": 0.2,
            "position": {"longitude_deg": truth.longitude_deg(), "latitude_deg": truth.latitude_deg()},
        })
    };
    json!(nearest_to_corners(&feet_px).map(point))
}

/// Mean error of the active model's answers to boxes alone, m, and the mean 95 % radius that they state, m.
async fn errors(server: &TestServer, truths: &Truths) -> [f64; 2] {
    let item = |(own, _): &(BoundingBox, Position)| {
        let [left_px, top_px, width_px, height_px] = own.sides_px();
        json!({
            "time": "2026-01-01T00:00:00Z",
            "bounding_box": {"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px},
        })
    };
    let items: Vec<Value> = truths.iter().map(item).collect();
    let answer =
        server.post("/v1/cameras/c/fusions", &json!({"observations": items})).await.expect(200).json();
    let items = answer["items"].as_array().expect("a list");
    let (mut error_m, mut r95_m) = (0.0, 0.0);
    for (item, (_, truth)) in items.iter().zip(truths) {
        let degrees =
            |name: &str| item["fused"][name].as_f64().unwrap_or_else(|| panic!("no {name}: {item}"));
        let at = Position::new(degrees("longitude_deg"), degrees("latitude_deg")).expect("a position");
        error_m += distance_m(at, *truth) / truths.len() as f64;
        r95_m += item["r95_m"].as_f64().expect("a radius") / truths.len() as f64;
    }
    assert_eq!(items.len(), truths.len());
    [error_m, r95_m]
}

#[tokio::test]
async fn an_operator_who_states_four_corners_gets_positions_without_the_phones_bias() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let camera = json!({"id": "c", "image_size": {"width_px": 1280, "height_px": 720}});
    let created = server.post("/v1/cameras", &camera).await.expect(201).json();
    assert_eq!(created["known_points"], json!([]), "{created}");
    let (csv, truths) = biased_walk();
    server.send("POST", "/v1/cameras/c/samples", &[("content-type", "text/csv")], csv).await.expect(200);
    assert_eq!(server.train("c", &json!({})).await["state"], "succeeded");
    let [without_m, without_r95_m] = errors(&server, &truths).await;

    let points = corners(&truths);
    let patch = json!({"known_points": points}).to_string();
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    let patched = server.send("PATCH", "/v1/cameras/c", &headers, patch).await.expect(200).json();
    assert_eq!(patched["known_points"], points, "{patched}");
    let run = server.train("c", &json!({})).await;
    assert_eq!(run["state"], "succeeded", "{run}");
    let model = server.get("/v1/cameras/c/models/2").await.expect(200).json();
    assert_eq!(model["metadata"]["recipe"], "gaussian_process", "alone uses them: {model}");
    let log = format!("/v1/cameras/c/training-runs/{}/log", run["id"].as_str().expect("an id"));
    let log = server.get(&log).await.expect(200).text();
    assert!(log.contains("known point 4: ") && !log.contains("contradicts"), "{log}");
    assert_eq!(server.get("/v1/cameras/c").await.expect(200).json()["active_model"], 2, "{run}");
    let [with_m, with_r95_m] = errors(&server, &truths).await;
    println!(
        "{without_m:.2} m (r95 {without_r95_m:.2}), with four corners {with_m:.2} m (r95 {with_r95_m:.2})"
    );
    assert!(with_m < 0.4 * without_m && with_r95_m < 0.6 * without_r95_m, "{with_m} of {without_m} m");
}

#[tokio::test]
async fn points_that_cannot_be_are_refused_with_the_field() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let camera = |point: Value| json!({"id": "c", "image_size": {"width_px": 1280, "height_px": 720}, "known_points": [point]});
    let position = json!({"longitude_deg": 8.5, "latitude_deg": 47.4});
    for (point, field) in [
        (json!({"x_px": 1280.5, "y_px": 1, "position": position}), "known_points[0].x_px"),
        (json!({"x_px": 1, "y_px": -1, "position": position}), "known_points[0].y_px"),
        (json!({"x_px": 1, "y_px": 1, "position": position, "sigma_m": 0}), "known_points[0].sigma_m"),
        (
            json!({"x_px": 1, "y_px": 1, "position": {"longitude_deg": 8.5, "latitude_deg": 91}}),
            "known_points[0].position.latitude_deg",
        ),
    ] {
        let refusal = server.post("/v1/cameras", &camera(point)).await.expect(422).json();
        assert_eq!(refusal["violations"][0]["field"], field, "{refusal}");
    }
    let many = vec![json!({"x_px": 1, "y_px": 1, "position": position}); 101];
    let refusal =
        server.post("/v1/cameras", &json!({"id": "c", "known_points": many})).await.expect(422).json();
    assert_eq!(refusal["violations"][0]["field"], "known_points", "{refusal}");
}
