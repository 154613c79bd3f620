//! `sightfix replay` with several nodes: one camera that moves to another node, and a thousand.

use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::Duration;

use futures_util::{StreamExt as _, stream};
use serde_json::{Value, json};
use sightfix::exchange::{Format, write_samples};
use sightfix::simulation::{Options, simulate};

use super::balancer::Balancer;
use super::faults::number_of;
use super::{create, node, sql, url};
use crate::harness::{data_folder, sightfix};

/// A recording of that many samples of one target, a second apart.
fn recording(folder: &Path, samples: usize) -> PathBuf {
    let options = Options { seed: 3, samples: 2 * samples, targets: 1, ..Options::demo() };
    let mut recorded = simulate(&options).training_samples();
    recorded.truncate(samples);
    assert_eq!(recorded.len(), samples);
    let mut csv = Vec::new();
    write_samples(&mut csv, Format::Csv, &recorded).expect("memory can be written");
    let path = folder.join("recording.csv");
    std::fs::write(&path, csv).expect("the file can be written");
    path
}

fn replay(server: &str, recording: &Path, arguments: &[&str]) -> Child {
    let mut command = sightfix();
    command.args(["replay", "--json", "--store-samples", "--server", server]).arg(recording).args(arguments);
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the binary runs")
}

/// The report of a replay that has lost nothing.
async fn report(replaying: Child) -> Value {
    let waiting = tokio::task::spawn_blocking(|| replaying.wait_with_output());
    let output = waiting.await.expect("no panic").expect("it ends");
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let report: Value =
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {errors}"));
    assert!(output.status.success(), "{report} {errors}");
    report
}

fn stored(folder: &Path) -> u64 {
    sql(folder, "SELECT count(*) FROM samples").parse().expect("a number")
}

async fn until_stored(folder: &Path, samples: u64) {
    while stored(folder) < samples {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_replay_follows_the_owner_and_resumes_behind_its_last_acknowledgement() {
    let (folder, files) = (data_folder(), data_folder());
    let (mut first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let recording = recording(files.path(), 400);
    let short = super::items(1);
    let mut owning = super::Feed::new("yard", short);
    owning.stream(&url(&first), super::PACE).await.expect("the first node owns the camera");

    // The server that it is given is not the owner.
    let replaying = replay(&url(&second), &recording, &["--camera", "yard", "--rate", "100"]);
    until_stored(folder.path(), 150).await;
    assert_eq!(sql(folder.path(), "SELECT url FROM nodes JOIN camera_owners ON node_id = id"), url(&first));
    first.kill_now();
    let report = report(replaying).await;
    println!("{} redirects, {} reconnects", report["redirects"], report["reconnects"]);
    assert!(report["redirects"].as_u64() >= Some(1), "{report}");
    assert_eq!((&report["acknowledged"], &report["given_up"]), (&json!(400), &json!(0)), "{report}");
    let path = "SELECT count(*) FROM samples JOIN cameras ON key = camera_key WHERE id = 'yard'";
    // The first stream's sample has the camera, target and time of one of the recording.
    assert_eq!(sql(folder.path(), path), "400");
    assert_eq!(super::fence(folder.path(), "yard"), 2);
}

/// `CLUSTER_CAMERAS` cameras stream to three nodes behind nginx, and a node that owns a third of them is killed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL and nginx: .ci/postgres"]
async fn a_thousand_cameras_lose_nothing_when_a_node_is_killed() {
    let cameras = number_of("CLUSTER_CAMERAS", 1_000);
    let (folder, files) = (data_folder(), data_folder());
    let mut nodes = [node(folder.path()), node(folder.path()), node(folder.path())];
    let server = &nodes[0];
    stream::iter(1..=cameras)
        .for_each_concurrent(8, |number| async move {
            create(server, &json!({"id": format!("city-{number}")})).await
        })
        .await;
    // Every node knows all of them; it looks every two seconds.
    for server in &nodes {
        super::until_status(server, &format!("/v1/cameras/city-{cameras}"), 200).await;
    }
    let balancer = Balancer::start(files.path(), &nodes.each_ref()).await;
    let (items, count) = (12, cameras.to_string());
    let recording = recording(files.path(), items);
    let arguments = ["--camera-prefix", "city", "--cameras", &count, "--rate", "0.8", "--attempts", "30"];
    let arguments = [&arguments[..], &["--response-timeout-s", "20"]].concat();
    let replaying = replay(&format!("http://{}", balancer.grpc), &recording, &arguments);
    until_stored(folder.path(), cameras * items as u64 / 3).await;
    let owned = "SELECT count(*) FROM camera_owners JOIN nodes ON nodes.id = node_id WHERE url = ";
    let owned = sql(folder.path(), &format!("{owned}'{}'", url(&nodes[1])));
    nodes[1].kill_now();
    let report = report(replaying).await;
    let acknowledged = report["acknowledged"].as_u64().expect("a number");
    let twice = "SELECT count(*) - count(DISTINCT (camera_key, time_us)) FROM samples";
    let recovery = &report["recovery_ms"];
    println!(
        "| cameras | of the killed node | acknowledged | lost | duplicated | take-over p50 ms | p99 ms |\n\
         | {cameras} | {owned} | {acknowledged} | {} | {} | {} | {} |",
        acknowledged.saturating_sub(stored(folder.path())),
        sql(folder.path(), twice),
        recovery["p50"],
        recovery["p99"],
    );
    println!("{report}");
    assert_eq!(acknowledged, cameras * items as u64, "{report}");
    assert_eq!((stored(folder.path()), sql(folder.path(), twice)), (acknowledged, "0".to_owned()));
    assert_eq!(report["given_up"], 0);
    // Cameras of the killed node are owned by others.
    let others = "SELECT count(*) FROM camera_owners JOIN nodes ON nodes.id = node_id";
    assert_eq!(sql(folder.path(), others), count);
}
