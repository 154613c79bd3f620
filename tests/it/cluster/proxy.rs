//! Nodes that send requests on to the owner of a camera instead of redirecting them.

use std::path::Path;

use serde_json::json;
use sightfix::simulation::Options;
use tonic::Code;
use tonic_types::StatusExt as _;

use super::feed::{Feed, PACE};
use super::{assert_stored_once, create, fence, items, url};
use crate::harness::{TestServer, data_folder};
use crate::live_client::{Client, Received, boxed, channel, fixed, open, rows, whole};

/// A serving process that sends on what another one answers.
fn proxying_node(folder: &Path) -> TestServer {
    TestServer::start_with(
        folder,
        &[
            ("SIGHTFIX_ROLE", "serve"),
            ("SIGHTFIX_NODE_LEASE_S", "2"),
            ("SIGHTFIX_CAMERA_ON_OTHER_NODE", "proxy"),
        ],
    )
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_sends_on_what_the_owner_of_the_camera_answers() {
    let folder = data_folder();
    let (first, second) = (proxying_node(folder.path()), proxying_node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let mut feed = Feed::new("yard", items(60));
    feed.upto = 20;
    feed.stream(&url(&first), PACE).await.expect("all is acknowledged");
    feed.upto = 40;
    feed.stream(&url(&second), PACE).await.expect("all is acknowledged, by the owner");
    assert_eq!((feed.acknowledged, fence(folder.path(), "yard")), (40, 1), "the owner stays");

    let tracks = second.get("/v1/cameras/yard/tracks").await.expect(200).json();
    assert_eq!(tracks["features"].as_array().expect("tracks").len(), 1, "{tracks}");
    let observation = json!({"time": "2026-01-01T00:00:00Z", "target_id": "late",
        "fix": {"longitude_deg": 8.0, "latitude_deg": 47.0}});
    let path = "/v1/cameras/yard/tracks?store_samples=false";
    second.post(path, &observation).await.expect(200);
    let refused = second.post(path, &json!({"time": "yesterday", "target_id": "late"})).await.expect(422);
    assert_eq!(refused.json()["violations"][0]["field"], "time", "{}", refused.text());
    let owners = first.get("/v1/nodes").await.expect(200).json();
    let cameras: u64 =
        owners["items"].as_array().expect("nodes").iter().filter_map(|node| node["cameras"].as_u64()).sum();
    assert_eq!(cameras, 1, "{owners}");

    // A node that ends settles what it sends on; the client goes on elsewhere.
    feed.upto = 60;
    let known = [url(&second), url(&first)];
    let feeding = tokio::spawn(async move {
        feed.resume_at(&known.iter().map(String::as_str).collect::<Vec<_>>()).await;
        feed
    });
    let terminated = tokio::task::spawn_blocking(move || second.terminate());
    let feed = feeding.await.expect("no panic");
    assert!(terminated.await.expect("no panic"), "it ends in order");
    assert_eq!(fence(folder.path(), "yard"), 1, "the owner stays");
    assert_stored_once(&first, &feed).await;
}

/// A stream of the camera `yard` at a node, which sends it on to the owner, another one.
async fn sent_on(owner: &TestServer, node: &TestServer) -> Client {
    create(owner, &json!({"id": "yard"})).await;
    let first = open(&channel(owner).await, "the first", false).await;
    assert!(first.finish().await.2.is_none(), "it has the camera now");
    open(&channel(node).await, "the second", true).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn the_client_of_a_stream_that_is_sent_on_ends_it_after_a_whole_sample() {
    let folder = data_folder();
    let (owner, second) = (proxying_node(folder.path()), proxying_node(folder.path()));
    let rows = rows(&Options { seed: 5, samples: 100, targets: 1, ..Options::demo() });
    let mut client = sent_on(&owner, &second).await;
    client.item(whole(&rows[0])).await;
    client.item(boxed(&rows[1])).await;
    for _ in 0..2 {
        client.answer().await;
    }
    let terminated = tokio::task::spawn_blocking(move || second.terminate());
    while !matches!(client.next().await.expect("no end"), Some(Received::Reconnect(_))) {}
    client.item(fixed(&rows[1])).await;
    let (acknowledgement, answers, ended) = client.finish_with_counts().await;
    let acknowledgement = acknowledgement.expect("all is acknowledged");
    assert_eq!((acknowledgement.seq, acknowledgement.stored), (3, 3), "{acknowledgement:?}");
    assert!(answers.len() == 1 && ended.is_none(), "{answers:?} {ended:?}");
    assert!(terminated.await.expect("no panic"), "it ends in order");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_stream_whose_owner_is_killed_ends_as_unavailable() {
    let folder = data_folder();
    let (mut owner, second) = (proxying_node(folder.path()), proxying_node(folder.path()));
    let mut client = sent_on(&owner, &second).await;
    owner.kill_now();
    let ended = loop {
        match client.next().await {
            Ok(message) => assert!(message.is_some(), "no end in order"),
            Err(status) => break status,
        }
    };
    let reason = ended.get_details_error_info().expect("details").reason;
    assert_eq!((ended.code(), &*reason), (Code::Unavailable, "camera-between-nodes"), "{ended:?}");
}

/// The owner's address is that of a process which does not exist any more.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_killed_owner_is_followed_behind_a_node_that_sends_on() {
    let folder = data_folder();
    let (mut first, second) = (proxying_node(folder.path()), proxying_node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let mut feed = Feed::new("yard", items(60));
    feed.upto = 20;
    feed.stream(&url(&first), PACE).await.expect("all is acknowledged");
    first.kill_now();
    feed.upto = 60;
    feed.resume_at(&[&url(&second)]).await;
    assert_eq!((feed.answered_by(), fence(folder.path(), "yard")), (&*url(&second), 2));
    assert_stored_once(&second, &feed).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_says_itself_whose_request_it_sends_on() {
    let folder = data_folder();
    let settings = [
        ("SIGHTFIX_NODE_LEASE_S", "2"),
        ("SIGHTFIX_TRUSTED_PROXIES", "127.0.0.1"),
        ("SIGHTFIX_LIMITS__REQUESTS_PER_S", "3"),
    ];
    let (owner, other) = (TestServer::start_with(folder.path(), &settings), proxying_node(folder.path()));
    create(&owner, &json!({"id": "yard"})).await;
    let path = "/v1/cameras/yard/tracks?store_samples=false";
    let observation = json!({"time": "2026-01-01T00:00:00Z", "target_id": "a",
        "fix": {"longitude_deg": 8.0, "latitude_deg": 47.0}});
    owner.post(path, &observation).await.expect(200);
    // Each claims to be of another client; all are of one address.
    let mut statuses = Vec::new();
    for number in 0..50 {
        let headers =
            [("content-type", "application/json"), ("x-forwarded-for", &*format!("203.0.113.{number}"))];
        let answer = other.send("POST", path, &headers, observation.to_string()).await;
        statuses.push(answer.status.as_u16());
    }
    assert!(statuses.contains(&200) && statuses.contains(&429), "{statuses:?}");
}
