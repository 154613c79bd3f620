//! `/v1/evaluations` through the real binary: the same figures as the command line, and SIGKILL.

use std::time::Duration;

use serde_json::{Value, json};
use sightfix::exchange::{Format, write_samples};
use sightfix::simulation::{Options, Scene, World, simulate};

use crate::harness::{TestServer, data_folder, run};

const SIGMA_M: f64 = 2.2;

/// Training and test world of a square with truth, a week apart.
fn square(train: usize, test: usize) -> (World, World) {
    let options = Options { samples: train, ..Options::new(Scene::Square) };
    (simulate(&options), simulate(&options.test(test)))
}

fn csv(world: &World) -> String {
    let mut csv = Vec::new();
    write_samples(&mut csv, Format::Csv, &world.training_samples()).expect("memory can be written");
    String::from_utf8(csv).expect("UTF-8")
}

async fn import(server: &TestServer, csv: String) {
    let headers = [("content-type", "text/csv")];
    let report = server.send("POST", "/v1/cameras/square/samples", &headers, csv).await.expect(200).json();
    assert_eq!(report["rejected"], 0, "{report}");
}

/// The camera `square` with all samples of both worlds.
async fn create_camera(server: &TestServer, train: &World, test: &World) {
    let size = train.image_size;
    let profile = json!({
        "id": "square",
        "image_size": {"width_px": size.width_px(), "height_px": size.height_px()},
        "gnss_error": {"sigma_m": SIGMA_M},
    });
    server.post("/v1/cameras", &profile).await.expect(201);
    import(server, csv(train)).await;
    import(server, csv(test)).await;
}

/// Waits until an evaluation satisfies a condition.
async fn until(server: &TestServer, path: &str, condition: impl Fn(&Value) -> bool) -> Value {
    for _ in 0..3_600 {
        let seen = server.get(path).await.expect(200).json();
        if condition(&seen) {
            return seen;
        }
        assert!(!has_ended(&seen), "{seen}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("the evaluation makes no progress")
}

fn has_ended(evaluation: &Value) -> bool {
    !matches!(evaluation["state"].as_str(), Some("queued" | "running" | "cancelling"))
}

/// True if its worker has reported a phase.
fn runs(evaluation: &Value) -> bool {
    evaluation["progress"]["phase"].as_str().is_some_and(|phase| !phase.is_empty())
}

#[tokio::test]
async fn rest_and_command_line_give_the_same_figures() {
    let folder = data_folder();
    let (train, test) = square(600, 200);
    let file = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    std::fs::write(file("train.csv"), csv(&train)).expect("written");
    std::fs::write(file("test.csv"), csv(&test)).expect("written");
    let size = format!("{}x{}", train.image_size.width_px(), train.image_size.height_px());
    let methods = "gnss,imm_ukf,homography.denied,hybrid.one_step,hybrid.two_step,hybrid.denied,dnn.denied";
    let (train_file, test_file, json_file) = (file("train.csv"), file("test.csv"), file("report.json"));
    let files = ["--train", &train_file, "--test", &test_file, "--json", &json_file];
    let options = ["--image-size", &size, "--gnss-sigma-m", "2.2", "--methods", methods, "--seeds", "2"];
    run(&[&["evaluate"][..], &files, &options, &["--box-shift-px", "3.5"]].concat());
    let printed_report: Value =
        serde_json::from_str(&std::fs::read_to_string(json_file).expect("was written")).expect("JSON");

    let server = TestServer::start(&folder.path().join("data"));
    create_camera(&server, &train, &test).await;
    let begin = test.rows.iter().map(|row| row.time).min().expect("rows").to_string();
    let asked = json!({
        "camera_id": "square",
        "train": {"until": begin},
        "test": {"from": begin},
        "methods": methods.split(',').collect::<Vec<_>>(),
        "seeds": 2,
        "box_shift_px": 3.5,
    });
    let queued = server.post("/v1/evaluations", &asked).await.expect(202);
    let ended = until(&server, queued.header("location"), has_ended).await;
    assert_eq!(ended["state"], "succeeded", "{ended}");
    assert_eq!(ended["progress"]["steps_done"], 2 * (1 + 7), "one fit and seven methods: {ended}");

    let reported = ended["report"]["methods"].as_object().expect("figures");
    let printed = printed_report["methods"].as_object().expect("figures");
    assert_eq!(reported.len(), 7, "{ended}");
    assert_eq!(reported.keys().collect::<Vec<_>>(), printed.keys().collect::<Vec<_>>());
    for (name, method) in printed {
        let tested = test.training_samples().len();
        assert_eq!(method["n"], tested, "{name}: {method}");
        for (figure, value) in method.as_object().expect("an object") {
            // Only durations may differ.
            if !matches!(figure.as_str(), "train_cpu_s" | "fuse_us") {
                assert_eq!(reported[name][figure], *value, "{name}.{figure}");
            }
        }
    }
    let mean_m = |name: &str| reported[name]["mean_m"].as_f64().expect("a number");
    assert!(mean_m("hybrid.two_step") < mean_m("gnss"), "{ended}");
    let positions = &ended["report"]["positions"];
    assert!(printed_report.get("positions").is_none(), "the command line prints figures alone");
    for (name, method) in reported {
        let shown = positions[name].as_array().expect("positions");
        assert_eq!(shown.len(), test.training_samples().len(), "{name}: fewer rows than the limit");
        let sum_m: f64 = shown.iter().map(|it| it["error_m"].as_f64().expect("a number")).sum();
        // Those of the first seed.
        let seed_mean_m = method["seed_means_m"][0].as_f64().expect("a number");
        let mean_m = sum_m / shown.len() as f64;
        assert!((mean_m - seed_mean_m).abs() < 1e-4, "{name}: {mean_m} and {seed_mean_m}");
        assert!(shown[0]["truth_latitude_deg"].is_number(), "{name}: {}", shown[0]);
    }

    let listed = server.get("/v1/evaluations?camera=square").await.expect(200).json();
    assert_eq!(listed["items"][0]["id"], ended["id"]);
    assert!(listed["items"][0].get("report").is_none(), "lists leave reports out");
    let metrics = server.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_evaluations_total{state=\"succeeded\"} 1"), "{metrics}");
}

#[tokio::test]
async fn an_evaluation_is_resumed_after_a_kill() {
    let folder = data_folder();
    // Longer than a loaded machine needs to start the server again.
    let short_lease = [("SIGHTFIX_EVALUATION__LEASE_S", "12")];
    let server = TestServer::start_with(folder.path(), &short_lease);
    let (train, test) = square(400, 60);
    create_camera(&server, &train, &test).await;
    let asked = json!({"camera_id": "square", "methods": ["gnss", "hybrid.denied"], "seeds": 4});
    let queued = server.post("/v1/evaluations", &asked).await.expect(202);
    let path = queued.header("location").to_owned();
    until(&server, &path, runs).await;
    server.kill();

    let server = TestServer::start_with(folder.path(), &short_lease);
    let left = server.get(&path).await.expect(200).json();
    assert_eq!((&left["state"], &left["attempt"]), (&json!("running"), &json!(1)), "the lease holds: {left}");
    let ended = until(&server, &path, has_ended).await;
    assert_eq!((&ended["state"], &ended["attempt"]), (&json!("succeeded"), &json!(2)), "{ended}");
    let means = ended["report"]["methods"]["hybrid.denied"]["seed_means_m"].as_array().expect("means");
    assert_eq!(means.len(), 4, "all seeds again: {ended}");
}

#[tokio::test]
async fn a_running_evaluation_is_cancelled_requeued_and_deleted() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let (train, test) = square(600, 60);
    create_camera(&server, &train, &test).await;
    // Long enough to be observed while it runs.
    let asked = json!({"camera_id": "square", "methods": ["auto.denied"], "seeds": 20});
    let start = async |server: &TestServer| {
        let queued = server.post("/v1/evaluations", &asked).await.expect(202);
        queued.header("location").to_owned()
    };
    let path = start(&server).await;
    until(&server, &path, runs).await;
    server.send("POST", &format!("{path}/cancel"), &[], "").await.expect(200);
    let ended = until(&server, &path, has_ended).await;
    assert_eq!(ended["state"], "cancelled", "{ended}");
    assert!(ended.get("report").is_none());

    let path = start(&server).await;
    until(&server, &path, runs).await;
    assert!(server.terminate(), "the server exits successfully");
    let server = TestServer::start(folder.path());
    let again = until(&server, &path, |seen| seen["state"] == "running" && runs(seen)).await;
    assert_eq!(again["attempt"], 1, "an orderly return is no attempt: {again}");
    server.send("DELETE", &path, &[], "").await.expect(204);
    server.get(&path).await.expect(404);

    // The one worker is free again.
    let short = json!({"camera_id": "square", "methods": ["gnss"]});
    let queued = server.post("/v1/evaluations", &short).await.expect(202);
    let ended = until(&server, queued.header("location"), has_ended).await;
    assert_eq!(ended["state"], "succeeded", "{ended}");
}
