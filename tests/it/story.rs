//! The main use case end to end, through the real binary and its port.

use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;

use crate::harness::{Answer, TestServer, data_folder, run, shared, simulated_csv};

/// Creates a camera, imports samples, trains and fuses; kills and restarts the server.
async fn main_use_case(image_size: Option<Value>, csv: String, rows: u64, epochs: u32) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());

    let mut profile = json!({"id": "square", "display_name": "The square", "recipe": "hybrid"});
    if let Some(size) = &image_size {
        profile["image_size"] = size.clone();
    }
    let created = server.post("/v1/cameras", &profile).await.expect(201);
    assert_eq!(created.header("location"), "/v1/cameras/square");
    let warned = created.json()["warnings"].to_string().contains("image_size");
    assert_eq!(warned, image_size.is_none(), "{}", created.text());

    let imported = import(&server, &csv).await.json();
    assert_eq!(imported["accepted"], rows, "{imported}");
    assert_eq!(imported["rejected"], 0, "{imported}");
    let again = import(&server, &csv).await.json();
    assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(rows)), "{again}");

    let observation = observation_of(&csv);
    let early = server.post("/v1/cameras/square/fusions", &observation).await.expect(409).json();
    assert!(early["type"].as_str().expect("a type").ends_with("no-model"), "{early}");

    let ended = server.train("square", &json!({"seed": 7, "epochs": epochs})).await;
    assert_eq!(ended["state"], "succeeded", "{ended}");
    assert_eq!(ended["model_version"], 1, "{ended}");

    let fused = server.post("/v1/cameras/square/fusions", &observation).await.expect(200).json();
    let item = &fused["items"][0];
    let number = |name: &str| item[name].as_f64().unwrap_or_else(|| panic!("{name}: {item}"));
    assert!((number("confidence_regression") + number("confidence_gnss") - 1.0).abs() < 1e-12);
    assert!(number("r95_m") > 0.0 && number("e_regression_m2") > 0.0 && number("e_gnss_m2") > 0.0);
    assert_eq!(item["model_version"], 1);

    let by_grpc = fuse_by_grpc(&server, &observation).await;
    let position =
        |name: &str| [number_of(&item[name]["longitude_deg"]), number_of(&item[name]["latitude_deg"])];
    let degrees = |position: Option<proto::Position>| {
        position
            .and_then(|position| Some([position.longitude_deg?, position.latitude_deg?]))
            .expect("a position")
    };
    assert_eq!(degrees(by_grpc.fused).map(f64::to_bits), position("fused").map(f64::to_bits));
    assert_eq!(degrees(by_grpc.regressed).map(f64::to_bits), position("regressed").map(f64::to_bits));
    for (grpc, rest) in [
        (by_grpc.confidence_regression, "confidence_regression"),
        (by_grpc.confidence_gnss, "confidence_gnss"),
        (by_grpc.e_regression_m2.expect("a box was given"), "e_regression_m2"),
        (by_grpc.e_gnss_m2.expect("a fix was given"), "e_gnss_m2"),
        (by_grpc.r95_m, "r95_m"),
        (by_grpc.reconstruction_error.expect("a box was given"), "reconstruction_error"),
    ] {
        assert_eq!(grpc.to_bits(), number(rest).to_bits(), "{rest} differs between the transports");
    }

    server.kill();
    let server = TestServer::start(folder.path());
    let count = server.get("/v1/cameras/square/samples/count").await.expect(200).json();
    assert_eq!(count["count"], rows);
    let after = server.post("/v1/cameras/square/fusions", &observation).await.expect(200).json();
    assert_eq!(after, fused, "the same model gives the same answer after a crash");
    assert!(server.terminate(), "the server exits successfully");
}

fn number_of(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The same observation by the other transport, on the same port.
async fn fuse_by_grpc(server: &TestServer, observation: &Value) -> proto::FusedFix {
    let time: jiff::Timestamp = observation["time"].as_str().expect("text").parse().expect("an instant");
    let (sides, fix) = (&observation["bounding_box"], &observation["fix"]);
    let request = proto::FuseRequest {
        camera_id: "square".to_owned(),
        observations: vec![proto::Observation {
            time: Some(prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() }),
            target_id: None,
            bounding_box: Some(proto::BoundingBox {
                left_px: sides["left_px"].as_f64(),
                top_px: sides["top_px"].as_f64(),
                width_px: sides["width_px"].as_f64(),
                height_px: sides["height_px"].as_f64(),
            }),
            fix: Some(proto::Fix {
                longitude_deg: fix["longitude_deg"].as_f64(),
                latitude_deg: fix["latitude_deg"].as_f64(),
                sigma_m: None,
            }),
        }],
    };
    let address = format!("http://{}", server.address);
    let mut client = FusionServiceClient::connect(address).await.expect("gRPC is on the same port");
    let answer = client.fuse(request).await.expect("an answer").into_inner();
    answer.fusions.into_iter().next().expect("one answer for one observation")
}

async fn import(server: &TestServer, csv: &str) -> Answer {
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/square/samples", &headers, csv.to_owned()).await.expect(200)
}

/// The middle row of a sample file, as a fusion request.
fn observation_of(csv: &str) -> Value {
    let lines: Vec<_> = csv.lines().collect();
    let column = |name: &str| {
        lines[0].split(',').position(|column| column.trim_end_matches("_px").trim_end_matches("_deg") == name)
    };
    let cells: Vec<_> = lines[lines.len() / 2].split(',').collect();
    let cell = |name: &str| cells[column(name).unwrap_or_else(|| panic!("no column {name}: {}", lines[0]))];
    let number = |name: &str| cell(name).parse::<f64>().expect("a number");
    json!({
        "time": cell("time"),
        "bounding_box": {
            "left_px": number("left"), "top_px": number("top"),
            "width_px": number("width"), "height_px": number("height"),
        },
        "fix": {"longitude_deg": number("longitude"), "latitude_deg": number("latitude")},
    })
}

#[tokio::test]
async fn a_simulated_square_is_imported_trained_and_fused() {
    let csv = simulated_csv();
    let rows = csv.lines().count() as u64 - 1;
    main_use_case(Some(json!({"width_px": 1920, "height_px": 1080})), csv, rows, 60).await;
}

#[tokio::test]
#[ignore = "needs ../shared/data"]
async fn shared_square_is_imported_trained_and_fused() {
    let csv = std::fs::read_to_string(shared("square/training.csv")).expect("the file can be read");
    main_use_case(None, csv, 10_078, 20).await;
}

#[tokio::test]
async fn the_command_line_does_the_same_without_a_server() {
    let folder = data_folder();
    let file = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    std::fs::write(file("samples.csv"), simulated_csv()).expect("the folder can be written");
    let data = file("data");
    let printed = run(&["import", &file("samples.csv"), "--camera", "c", "--create", "--data", &data]);
    assert!(printed.starts_with("accepted "), "{printed}");
    let printed = run(&["train", "--camera", "c", "--recipe", "hybrid", "--epochs", "60", "--data", &data]);
    assert!(printed.starts_with("version 1 became active"), "{printed}");
    let (from, to) = (file("samples.csv"), file("fused.geojson"));
    let printed = run(&["fuse", &from, "--out", &to, "--camera", "c", "--data", &data]);
    assert!(printed.contains("rejected 0"), "{printed}");
    let positions: Value =
        serde_json::from_str(&std::fs::read_to_string(to).expect("was written")).expect("GeoJSON");
    assert!(positions["features"].as_array().is_some_and(|features| features.len() > 100));

    let server = TestServer::start(&folder.path().join("data"));
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    assert_eq!(camera["active_model"], 1, "{camera}");
}

#[tokio::test]
async fn the_demonstration_prints_requests_that_work() {
    let folder = data_folder();
    let (server, printed) = TestServer::demonstrate(folder.path());
    let observation = printed.split('\'').nth(1).unwrap_or_else(|| panic!("no body for curl: {printed}"));
    let observation: Value = serde_json::from_str(observation).expect("JSON");
    let fused = server.post("/v1/cameras/demo/fusions", &observation).await.expect(200).json();
    assert!(fused["items"][0]["r95_m"].as_f64().is_some_and(|r95_m| r95_m > 0.0), "{fused}");
    assert!(printed.contains("grpcurl -plaintext") && printed.contains("/docs"), "{printed}");
    // Targets of the demonstration walk: what is tracked moves.
    let position = async || -> Value {
        let tracks = server.get("/v1/cameras/demo/tracks").await.expect(200).json();
        tracks["features"][0]["geometry"]["coordinates"].clone()
    };
    let mut first = position().await;
    while first.is_null() {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        first = position().await;
    }
    while position().await == first {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    // Its display is told who enters the quay.
    while server.get("/v1/connections/demo-display").await.expect(200).json()["status"]["messages"] == 0 {
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
    }
    // It ends although one of its cameras is being trained.
    let long = json!({"recipe": "hybrid", "epochs": 2_000});
    server.post("/v1/cameras/demo/training-runs", &long).await.expect(202);
    server.send("DELETE", "/v1/demonstration", &[], "").await.expect(204);
    let cameras = server.get("/v1/cameras").await.expect(200).json();
    assert_eq!(cameras["items"], json!([]), "{cameras}");
}

/// A model file of an earlier format loads, and is more accurate than the receiver alone.
#[test]
fn the_reference_model_loads() {
    use sightfix::geo::distance_m;

    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
    let file = std::fs::read(model).expect("the reference model");
    let regressor =
        sightfix::model::Artifact::from_file(&file).expect("a model file").load().expect("a model");
    let world = sightfix::simulation::simulate(&sightfix::simulation::Options {
        seed: 99,
        ..sightfix::simulation::Options::demo()
    });
    let (mut fused_m, mut gnss_m, mut rows) = (0.0, 0.0, 0.0);
    for row in &world.rows {
        let (Some(bounding_box), Some(fix)) = (row.bounding_box, row.fix) else { continue };
        let observation = sightfix::domain::Observation::with_fix(row.time, None, Some(bounding_box), fix);
        let fused = sightfix::fusion::two_step::fuse(&observation, Some((&regressor, 1)), None, None);
        fused_m += distance_m(fused.expect("a model answers").fused, row.truth);
        gnss_m += distance_m(fix.position, row.truth);
        rows += 1.0;
    }
    assert!(rows > 100.0, "{rows}");
    assert!(fused_m < 0.7 * gnss_m, "fused {} m, GNSS {} m", fused_m / rows, gnss_m / rows);
}
