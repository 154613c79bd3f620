//! The recipe `gaussian_process` from the outside: training, what the model version reports, and answers.

use serde_json::json;

use crate::harness::{TestServer, data_folder, simulated_csv};

#[tokio::test]
async fn a_model_states_weights_and_an_error_that_grows_with_an_odd_box() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let camera = json!({"id": "c", "image_size": {"width_px": 1280, "height_px": 720}});
    server.post("/v1/cameras", &camera).await.expect(201);
    let samples = "/v1/cameras/c/samples";
    server.send("POST", samples, &[("content-type", "text/csv")], simulated_csv()).await.expect(200);
    let run = server.train("c", &json!({"recipe": "gaussian_process"})).await;
    assert_eq!(run["state"], "succeeded", "{run}");

    let model = server.get("/v1/cameras/c/models/1").await.expect(200).json();
    let parameters = &model["metadata"]["parameters"];
    let weight = |name: &str| parameters[format!("weight.{name}")].as_f64().unwrap_or(0.0);
    let sum: f64 = ["homography", "upright_camera", "residual"].map(weight).iter().sum();
    println!("{parameters}");
    assert_eq!(model["metadata"]["recipe"], "gaussian_process", "{model}");
    assert!((sum - 1.0).abs() < 1e-6, "the weights of the maps add up to {sum}: {parameters}");

    let csv = simulated_csv();
    let row: Vec<&str> = csv.lines().nth(200).expect("a row").split(',').collect();
    let columns: Vec<&str> = csv.lines().next().expect("a header").split(',').collect();
    let number = |name: &str| {
        let at = columns.iter().position(|column| *column == name).expect("the column");
        row[at].parse::<f64>().expect("a number")
    };
    let fuse = |grown_px: f64| {
        json!({"time": "2026-01-01T00:00:00Z", "bounding_box": {
            "left_px": number("left") - grown_px,
            "top_px": number("top") - grown_px,
            "width_px": number("width") + grown_px,
            "height_px": number("height") + grown_px,
        }})
    };
    let radius_m = async |grown_px: f64| {
        let answer = server.post("/v1/cameras/c/fusions", &fuse(grown_px)).await.expect(200).json();
        answer["items"][0]["r95_m"].as_f64().unwrap_or_else(|| panic!("no radius: {answer}"))
    };
    let (usual_m, odd_m) = (radius_m(0.0).await, radius_m(30.0).await);
    println!("95 % radius {usual_m:.2} m, of the box grown by 30 px {odd_m:.2} m");
    assert!(usual_m > 0.0 && odd_m > 1.2 * usual_m, "{usual_m} {odd_m}");
}
