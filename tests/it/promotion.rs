//! A worse model version does not replace a good one by itself.

use std::fmt::Write as _;

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, simulated_csv};

const SAMPLES: &str = "/v1/cameras/c/samples";
const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";

/// A camera with the samples of a small simulated square, and a good model.
async fn with_good_model(folder: &std::path::Path) -> TestServer {
    let server = TestServer::start(folder);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    import(&server, simulated_csv()).await;
    let run = train(&server).await;
    assert_eq!((&run["state"], active_model(&server).await), (&json!("succeeded"), 1), "{run}");
    server
}

async fn import(server: &TestServer, csv: String) {
    let report = server.send("POST", SAMPLES, &[("content-type", "text/csv")], csv).await.expect(200).json();
    assert_eq!(report["rejected"], 0, "{report}");
}

async fn train(server: &TestServer) -> Value {
    server.train("c", &json!({"recipe": "projective", "epochs": 2})).await
}

async fn active_model(server: &TestServer) -> u64 {
    let camera = server.get("/v1/cameras/c").await.expect(200).json();
    camera["active_model"].as_u64().expect("an active model")
}

/// Rows of a target that the camera never saw, one a second through the year before the good samples.
fn rows(count: u32, row: impl Fn(u32) -> String) -> String {
    let first = jiff::Timestamp::from_second(1_577_836_800).expect("2020");
    (0..count).fold(HEADER.to_owned(), |mut csv, n| {
        let time = first + jiff::SignedDuration::from_secs(n.into());
        let _ = writeln!(csv, "{time},garbage,{}", row(n));
        csv
    })
}

#[tokio::test]
async fn samples_that_repeat_one_box_and_fix_are_refused() {
    let folder = data_folder();
    let server = with_good_model(folder.path()).await;
    import(&server, rows(20_000, |_| "300,300,40,90,24.7453,59.4371".to_owned())).await;
    let run = train(&server).await;
    println!("{}: {}, active {}", run["state"], run["outcome"], active_model(&server).await);
    assert_eq!((&run["state"], active_model(&server).await), (&json!("failed"), 1), "{run}");
    let outcome = run["outcome"].as_str().expect("an outcome");
    assert!(outcome.contains("repeat one and the same box and fix"), "{outcome}");
}

/// Many boxes anywhere in the image, all with nearly one position: easy to predict, and useless.
#[tokio::test]
async fn a_version_that_lost_the_active_ones_samples_stays_inactive() {
    let folder = data_folder();
    let server = with_good_model(folder.path()).await;
    let garbage = rows(20_000, |n| {
        let (left, top) = (f64::from(n * 7_919 % 1_200), f64::from(n * 104_729 % 600));
        let jitter = 1e-7 * f64::from(n % 101);
        format!("{left},{top},40,90,{:.7},{:.7}", 24.745_3 + jitter, 59.437_1 - jitter)
    });
    import(&server, garbage).await;
    let run = train(&server).await;
    println!("{}: {}, active {}", run["state"], run["outcome"], active_model(&server).await);
    assert_eq!((&run["state"], &run["model_version"]), (&json!("succeeded"), &json!(2)), "{run}");
    assert_eq!(active_model(&server).await, 1, "{run}");
    assert!(run["outcome"].as_str().is_some_and(|outcome| outcome.contains("stays active")), "{run}");
}

#[tokio::test]
async fn the_same_training_once_more_replaces_the_version() {
    let folder = data_folder();
    let server = with_good_model(folder.path()).await;
    let run = train(&server).await;
    assert_eq!((&run["state"], active_model(&server).await), (&json!("succeeded"), 2), "{run}");
}
