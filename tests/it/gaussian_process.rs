//! The recipe `gaussian_process` from the outside: training, what the model version reports, and answers.

use serde_json::json;
use sightfix::grpc::proto;
use sightfix::grpc::proto::training_run::Findings;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;

use crate::harness::{TestServer, data_folder, shared, simulated_csv};

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
    let answer_of = async |grown_px: f64| {
        let answer = server.post("/v1/cameras/c/fusions", &fuse(grown_px)).await.expect(200).json();
        let item = answer["items"][0].clone();
        let number = |name: &str| item[name].as_f64().unwrap_or_else(|| panic!("no {name}: {item}"));
        (number("r95_m"), number("reconstruction_error"), item["flags"].to_string())
    };
    let (usual_m, usual_error, usual_flags) = answer_of(0.0).await;
    let (odd_m, odd_error, odd_flags) = answer_of(30.0).await;
    println!("95 % radius {usual_m:.2} m, of the box grown by 30 px {odd_m:.2} m");
    println!("reconstruction error {usual_error:.2e} {usual_flags}, grown {odd_error:.2e} {odd_flags}");
    assert!(usual_m > 0.0 && odd_m > 1.2 * usual_m, "{usual_m} {odd_m}");
    // The decoder of the auto-encoder cannot reconstruct it.
    assert!(odd_error > 4.0 * usual_error, "{usual_error} {odd_error}");
    assert!(!usual_flags.contains("outside_training") && odd_flags.contains("outside_training"));
}

#[tokio::test]
async fn a_run_reports_what_it_found_on_every_way() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let samples = "/v1/cameras/c/samples";
    server.send("POST", samples, &[("content-type", "text/csv")], simulated_csv()).await.expect(200);
    let run = server.train("c", &json!({"recipe": "gaussian_process", "epochs": 3})).await;
    assert_eq!(run["state"], "succeeded", "{run}");

    let model = server.get("/v1/cameras/c/models/1").await.expect(200).json();
    let metadata = &model["metadata"];
    assert_eq!(run["report"], metadata["report"], "run and model have the same report");
    let finding = &run["report"]["candidates"][0];
    assert_eq!(finding["candidate"], "gaussian_process", "{finding}");
    assert_eq!(finding["weight"], 1.0, "{finding}");
    let number = |value: &serde_json::Value| value.as_f64().unwrap_or_else(|| panic!("{finding}"));
    assert!(number(&finding["held_out_miss_m"]) > 0.0 && number(&finding["coverage95_of_fixes"]) > 0.5);
    let advice = run["report"]["advice"].to_string();
    assert!(advice.contains("another day") && advice.contains("image_size"), "{advice}");
    // Es by (4), of the auto-encoder that every run fits.
    assert!(number(&metadata["error_scale"]) > 0.0 && metadata["error_scale"] != 1.0, "{metadata}");

    let text = run["report_text"].as_str().expect("text");
    println!("{text}");
    assert!(text.contains("gaussian_process: ") && text.contains("What would help:\n- "), "{text}");
    assert!(text.contains("at the median of the scene, and to"), "{text}");
    let request = proto::GetTrainingRunRequest {
        camera_id: "c".to_owned(),
        run_id: run["id"].as_str().expect("an id").to_owned(),
    };
    let address = format!("http://{}", server.address);
    let mut client = TrainingServiceClient::connect(address).await.expect("gRPC is on the same port");
    let by_grpc = client.get_training_run(request).await.expect("the run").into_inner().run;
    let Some(Findings::Report(by_grpc)) = by_grpc.and_then(|run| run.findings) else {
        panic!("a run of a camera without its report")
    };
    assert_eq!(by_grpc.text, text);
    assert_eq!(by_grpc.candidates[0].candidate, "gaussian_process");
    assert_eq!(by_grpc.advice.len(), run["report"]["advice"].as_array().map_or(0, Vec::len));

    drop(server);
    let printed = crate::harness::run(&[
        "train",
        "--camera",
        "c",
        "--recipe",
        "projective",
        "--data",
        folder.path().to_str().expect("UTF-8"),
    ]);
    assert!(printed.contains("projective/foot: ") && printed.contains("What would help:"), "{printed}");
}

/// Mean error, m, and shares of the truths inside the stated 50 % and 95 % radii, of a method.
fn evaluated(arguments: &[&str], method: &str) -> [f64; 3] {
    let folder = data_folder();
    let report = folder.path().join("report.json");
    let report = report.to_str().expect("UTF-8");
    let methods = format!("homography.denied,{method}");
    let mut all = vec!["evaluate", "--methods", &methods, "--json", report];
    all.extend(arguments);
    crate::harness::run(&all);
    let json = std::fs::read_to_string(report).expect("a report");
    let report: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    let own = &report["methods"][method];
    let number = |name: &str| own[name].as_f64().unwrap_or_else(|| panic!("no {name} of {method}: {own}"));
    [number("mean_m"), number("coverage50"), number("coverage95")]
}

/// The real square, one segment of time held out in turn. The truth is the distance to a line, one of two
/// axes, of which an honest radius of 95 % holds 98.6 %.
#[test]
#[ignore = "needs ../shared/data; four minutes"]
fn shared_square_is_covered_by_segment() {
    let rows = std::fs::read_to_string(shared("square/training.csv")).expect("the recording");
    let (header, rows) = rows.split_once('\n').expect("a header");
    let segment = |row: &&str| match &row[..13] {
        time if time < "2020-12-15" => 0,
        time if time < "2020-12-15T13" => 1,
        _ => 2,
    };
    let line = shared("square/truth_line.geojson");
    for (held_out, most_m) in [(0, 0.50), (1, 0.98), (2, 1.15)] {
        let folder = data_folder();
        let file = |name: &str, keep: &dyn Fn(usize) -> bool| {
            let own: Vec<&str> = rows.lines().filter(|row| keep(segment(row))).collect();
            let path = folder.path().join(name);
            std::fs::write(&path, format!("{header}\n{}\n", own.join("\n"))).expect("written");
            path.to_str().expect("UTF-8").to_owned()
        };
        let train = file("train.csv", &|own| own != held_out);
        let test = file("test.csv", &|own| own == held_out);
        let line = line.to_str().expect("UTF-8");
        let arguments = ["--train", &train, "--test", &test, "--truth-line", line, "--gnss-sigma-m", "2.2"];
        let [mean_m, half, covered] = evaluated(&arguments, "gaussian_process.two_step");
        println!("segment {held_out}: {mean_m:.3} m, {half:.3} inside 50 %, {covered:.3} inside 95 %");
        assert!(mean_m <= most_m, "segment {held_out}: {mean_m} m, not {most_m} m");
        assert!(covered >= 0.9, "segment {held_out}: {covered}");
    }
}

/// Boxes unlike training on an aircraft with white noise: enlarged, and on a line that was not walked.
#[test]
#[ignore = "two minutes"]
fn boxes_unlike_training_keep_a_radius_that_holds() {
    let folder = data_folder();
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let (train, test, line) = (path("train.csv"), path("test.csv"), path("line.csv"));
    let world = ["simulate", "airport", "--seed", "1001", "--camera-seed", "1001", "--samples", "4000"];
    let simulate = |more: &[&str]| crate::harness::run(&[&world[..], more].concat());
    simulate(&["--out", &train, "--test-out", &test, "--test-samples", "400"]);
    let route = ["--out", &train, "--test-out", &line, "--test-samples", "400", "--test-route", "new-line"];
    simulate(&route);
    for (name, test, grown_px, least) in [
        ("10 px", &test, "10", 0.9),
        ("30 px", &test, "30", 0.9),
        ("a line not in training", &line, "0", 0.85),
    ] {
        let arguments =
            ["--train", &train, "--test", test, "--image-size", "1920x1080", "--box-shift-px", grown_px];
        let [mean_m, half, covered] = evaluated(&arguments, "gaussian_process.two_step");
        println!("{name}: {mean_m:.2} m, {half:.3} inside 50 %, {covered:.3} inside 95 %");
        assert!(covered >= least, "{name}: {covered}");
    }
}
