//! Live streams of several serving processes with one PostgreSQL database. `.ci/postgres` starts the server.

mod balancer;
mod connections;
mod database;
mod database_faults;
mod fail_over;
mod faults;
mod feed;
mod proxy;
mod replay;

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use sightfix::simulation::Options;
use tonic::Code;
use tonic_types::StatusExt as _;

use self::feed::{Feed, PACE};
use crate::harness::{TestServer, data_folder, store_arguments};
use crate::live_client::{rows, whole};

/// A serving process with short leases.
fn node(folder: &Path) -> TestServer {
    TestServer::start_with(folder, &[("SIGHTFIX_ROLE", "serve"), ("SIGHTFIX_NODE_LEASE_S", "2")])
}

fn url(server: &TestServer) -> String {
    format!("http://{}", server.address)
}

/// The output of a statement in the database of a folder.
fn sql(folder: &Path, statement: &str) -> String {
    let [_, url] = store_arguments(folder);
    let output = Command::new("psql").args([&url, "-Atqc", statement]).output().expect("psql runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// The fence of a camera's owner.
fn fence(folder: &Path, camera: &str) -> i64 {
    let of =
        format!("SELECT fence FROM camera_owners JOIN cameras ON key = camera_key WHERE id = '{camera}'");
    sql(folder, &of).parse().expect("a number")
}

/// Samples of a camera as items with both halves, one a second, of one target.
fn items(count: usize) -> Vec<sightfix::grpc::proto::StreamItem> {
    let options = Options { seed: 5, samples: 2 * count, targets: 1, ..Options::demo() };
    let rows = rows(&options);
    let whole_rows = rows.iter().filter(|row| row.bounding_box.is_some() && row.fix.is_some());
    let items: Vec<_> = whole_rows.take(count).map(whole).collect();
    assert_eq!(items.len(), count);
    items
}

/// Asserts that every item is stored once.
async fn assert_stored_once(server: &TestServer, feed: &Feed) {
    let path = format!("/v1/cameras/{}/samples?limit=1000", feed.camera);
    let page = server.get(&path).await.expect(200).json();
    let stored = page["items"].as_array().expect("a page");
    let mut times: Vec<_> = stored.iter().map(|sample| sample["time"].as_str().expect("a time")).collect();
    times.sort_unstable();
    times.dedup();
    assert_eq!((stored.len(), times.len()), (feed.items.len(), feed.items.len()), "lost or twice");
}

async fn create(server: &TestServer, profile: &Value) {
    server.post("/v1/cameras", profile).await.expect(201);
}

/// Answers of a node that has looked at the others since they changed.
async fn until_status(server: &TestServer, path: &str, status: u16) -> crate::harness::Answer {
    for _ in 0..400 {
        let answer = server.get(path).await;
        if answer.status.as_u16() == status {
            return answer;
        }
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
    panic!("{path} never answers {status}")
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_stream_that_meets_another_node_is_redirected_to_the_owner() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let mut feed = Feed::new("yard", items(40));
    feed.upto = 20;
    feed.stream(&url(&first), PACE).await.expect("all is acknowledged");
    assert_eq!((feed.acknowledged, fence(folder.path(), "yard")), (20, 1));

    let tracks = until_status(&second, "/v1/cameras/yard/tracks", 307).await;
    assert_eq!(tracks.header("location"), format!("{}/v1/cameras/yard/tracks", url(&first)));
    assert_eq!(tracks.json()["type"], "urn:sightfix:problem:camera-on-other-node");
    let events = second.get("/v1/cameras/yard/events").await.expect(307);
    assert_eq!(events.header("location"), format!("{}/v1/cameras/yard/events", url(&first)));
    let observation = json!({"time": "2026-01-01T00:00:00Z", "target_id": "a",
        "fix": {"longitude_deg": 8.0, "latitude_deg": 47.0}});
    let followed = second.post("/v1/cameras/yard/tracks?store_samples=false", &observation).await.expect(307);
    let location = followed.header("location").to_owned();
    assert_eq!(location, format!("{}/v1/cameras/yard/tracks?store_samples=false", url(&first)));
    first.post("/v1/cameras/yard/tracks?store_samples=false", &observation).await.expect(200);
    // A request that changes no live state is answered by any node.
    second.post("/v1/cameras/yard/fusions", &observation).await.expect(200);

    feed.upto = 40;
    let refused = feed.stream(&url(&second), PACE).await.expect_err("the other node owns the camera");
    let info = refused.get_details_error_info().expect("ErrorInfo");
    assert_eq!((refused.code(), &*info.reason), (Code::Unavailable, "camera-on-other-node"), "{refused}");
    let owner = info.metadata.get("owner").expect("the owner's address").clone();
    assert_eq!(owner, url(&first));
    feed.stream(&owner, PACE).await.expect("all is acknowledged");
    assert_eq!(fence(folder.path(), "yard"), 1, "the owner stays");
    assert_stored_once(&second, &feed).await;

    let nodes = second.get("/v1/nodes").await.expect(200).json();
    let of = |url: &str, field: &str| {
        let items = nodes["items"].as_array().expect("nodes");
        items.iter().find(|node| node["url"] == url).unwrap_or_else(|| panic!("{nodes}"))[field].clone()
    };
    assert_eq!((of(&url(&first), "cameras"), of(&url(&second), "cameras")), (json!(1), json!(0)), "{nodes}");
    assert_eq!((of(&url(&first), "is_this"), of(&url(&second), "is_this")), (json!(false), json!(true)));
    assert_eq!(of(&url(&first), "role"), "serve");
}

/// World tracks are made of what all cameras of a site see, so these have one owner.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn cameras_of_one_site_have_one_owner() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    first.post("/v1/sites", &json!({"id": "port"})).await.expect(201);
    create(&first, &json!({"id": "east", "site": "port"})).await;
    create(&first, &json!({"id": "west", "site": "port"})).await;
    create(&first, &json!({"id": "yard"})).await;
    let mut east = Feed::new("east", items(10));
    east.stream(&url(&first), PACE).await.expect("all is acknowledged");
    until_status(&second, "/v1/sites/port/tracks", 307).await;
    second.get("/v1/sites/port/events").await.expect(307);
    let mut west = Feed::new("west", items(10));
    let refused = west.stream(&url(&second), PACE).await.expect_err("the site is on the other node");
    let info = refused.get_details_error_info().expect("ErrorInfo");
    assert_eq!(info.metadata.get("owner"), Some(&url(&first)), "{refused}");
    west.stream(&url(&first), PACE).await.expect("all is acknowledged");
    let mut yard = Feed::new("yard", items(10));
    yard.stream(&url(&second), PACE).await.expect("a camera of no site");
    until_status(&first, "/v1/cameras/yard/tracks", 307).await;
}
