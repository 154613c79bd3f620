//! Sources and sinks of several nodes.

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::routing::post;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

use super::feed::Feed;
use super::{assert_stored_once, create, items, node, sql, url};
use crate::harness::{TestServer, data_folder, now};
use crate::outside::peers::{connection_when, create_gate, patch};

/// A source of positions that devices send over TCP, at a listener of the test.
async fn receiver(server: &TestServer, id: &str, camera: &str) -> TcpListener {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let source = json!({"address": format!("gpsd://{address}"), "format": "gpsd", "camera_ids": [camera]});
    server.post("/v1/connections", &json!({"id": id, "source": source})).await.expect(201);
    listener
}

async fn send_report(stream: &mut TcpStream) {
    let report = format!(
        "{{\"class\":\"TPV\",\"device\":\"boat\",\"mode\":3,\"time\":\"{:.3}\",\"lat\":30.628,\"lon\":103.98678}}\n",
        now()
    );
    stream.write_all(report.as_bytes()).await.expect("written");
}

/// Address of the node that runs a connection, as a server shows it.
async fn runner(server: &TestServer, id: &str) -> String {
    let shown = connection_when(server, id, |status| {
        status["state"] == "running" && status["node"]["url"].is_string()
    });
    shown.await["status"]["node"]["url"].as_str().expect("an address").to_owned()
}

fn connection_fence(folder: &Path) -> i64 {
    sql(folder, "SELECT fence FROM connection_owners").parse().expect("a number")
}

/// The owner and the other one.
fn by_url(nodes: [TestServer; 2], owner: &str) -> (TestServer, TestServer) {
    let [first, second] = nodes;
    if url(&first) == owner { (first, second) } else { (second, first) }
}

/// Waits until the peer has closed the connection.
async fn until_closed(stream: &mut TcpStream) {
    let mut read = [0; 256];
    while stream.read(&mut read).await.is_ok_and(|bytes| bytes > 0) {}
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_source_runs_on_one_node_and_on_another_after_a_kill() {
    let folder = data_folder();
    let nodes = [node(folder.path()), node(folder.path())];
    create_gate(&nodes[0]).await;
    let listener = receiver(&nodes[1], "boat", "gate").await;
    let (mut stream, _) = listener.accept().await.expect("a node connects");
    let owner = runner(&nodes[0], "boat").await;
    assert_eq!(runner(&nodes[1], "boat").await, owner, "every node names it");
    let (mut owner, other) = by_url(nodes, &owner);
    send_report(&mut stream).await;
    for server in [&owner, &other] {
        connection_when(server, "boat", |status| status["items"] == 1).await;
    }
    let camera_owner = sql(folder.path(), "SELECT url FROM nodes JOIN camera_owners ON node_id = id");
    assert_eq!((camera_owner, connection_fence(folder.path())), (url(&owner), 1));
    let tried = other.post("/v1/connections/boat/test", &json!({})).await.expect(200).json();
    assert!(tried["message"]["text"].as_str().expect("text").contains("TPV"), "{tried}");
    // No second node has connected by now.
    let second = tokio::time::timeout(Duration::from_millis(1_500), listener.accept()).await;
    assert!(second.is_err(), "two nodes read one source");

    owner.kill_now();
    let killed = Instant::now();
    let (mut stream, _) = listener.accept().await.expect("the other node connects");
    println!("killed: another node runs the source after {:?}", killed.elapsed());
    send_report(&mut stream).await;
    connection_when(&other, "boat", |status| status["items"] == 1).await;
    assert_eq!(runner(&other, "boat").await, url(&other));
    assert_eq!(connection_fence(folder.path()), 2);

    // Any node changes it; the one that runs it follows.
    let third = node(folder.path());
    patch(&third, "boat", &json!({"paused": true})).await.expect(200);
    until_closed(&mut stream).await;
    for server in [&other, &third] {
        connection_when(server, "boat", |status| status["state"] == "paused").await;
    }
    patch(&third, "boat", &json!({"paused": false})).await.expect(200);
    listener.accept().await.expect("a node connects");
    let runs_again = runner(&third, "boat").await;
    assert!([url(&other), url(&third)].contains(&runs_again), "{runs_again}");
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_message_that_meets_another_node_is_redirected_to_the_source() {
    let folder = data_folder();
    let nodes = [node(folder.path()), node(folder.path())];
    create_gate(&nodes[0]).await;
    let source = json!({"address": "push:", "format": "traccar", "camera_ids": ["gate"]});
    nodes[0].post("/v1/connections", &json!({"id": "push", "source": source})).await.expect(201);
    let owner = runner(&nodes[1], "push").await;
    let (owner, other) = by_url(nodes, &owner);
    let position = json!({
        "position": {"id": 7, "deviceId": 3, "fixTime": format!("{:.3}", now()), "valid": true,
            "latitude": 30.628, "longitude": 103.98678, "accuracy": 4.0},
        "device": {"id": 3, "uniqueId": "boat"},
    });
    let path = "/v1/connections/push/messages";
    let redirected = other.post(path, &position).await.expect(307);
    assert_eq!(redirected.header("location"), format!("{}{path}", url(&owner)));
    owner.post(path, &position).await.expect(204);
}

/// A camera that a client streams to on another node goes to the node of its source, and the client follows it there.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_camera_goes_to_the_node_of_its_source() {
    let folder = data_folder();
    let nodes = [node(folder.path()), node(folder.path())];
    create(&nodes[0], &json!({"id": "yard"})).await;
    let listener = receiver(&nodes[0], "boat", "yard").await;
    let (mut stream, _) = listener.accept().await.expect("a node connects");
    let source_url = runner(&nodes[0], "boat").await;
    let (owner, other) = by_url(nodes, &source_url);

    let mut feed = Feed::new("yard", items(500));
    let client_url = url(&other);
    let streaming = tokio::spawn(async move {
        feed.resume_at(&[&client_url]).await;
        feed
    });
    while sql(folder.path(), "SELECT count(*) FROM samples").parse::<i64>().expect("a number") < 50 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let camera_owner = || sql(folder.path(), "SELECT url FROM nodes JOIN camera_owners ON node_id = id");
    assert_eq!(camera_owner(), url(&other));
    send_report(&mut stream).await;
    connection_when(&other, "boat", |status| status["items"] == 1).await;
    assert_eq!(camera_owner(), source_url);
    let feed = streaming.await.expect("no panic");
    println!("the camera went to its source: {} attempts, {} redirects", feed.attempts, feed.redirects);
    assert_eq!(feed.answered_by(), source_url);
    assert_stored_once(&owner, &feed).await;
}

/// Ids of the messages that a webhook's receiver has taken, in their order.
#[derive(Clone, Default)]
struct Receiver(Arc<Mutex<Vec<String>>>);

impl Receiver {
    async fn start() -> (Self, String) {
        let (receiver, listener) = (Self::default(), TcpListener::bind("127.0.0.1:0").await.expect("a port"));
        let address = listener.local_addr().expect("an address");
        let router = Router::new().route("/hook", post(Self::take)).with_state(receiver.clone());
        tokio::spawn(async move { axum::serve(listener, router).await.expect("it serves") });
        (receiver, format!("http://{address}/hook"))
    }

    async fn take(State(receiver): State<Self>, headers: HeaderMap) {
        let id = headers["webhook-id"].to_str().expect("an id").to_owned();
        receiver.0.lock().expect("no panic").push(id);
    }

    fn taken(&self) -> Vec<String> {
        self.0.lock().expect("no panic").clone()
    }
}

/// A camera's fix of now at the node that has the camera.
async fn fix(server: &TestServer, camera: &str, target: &str) {
    let fix = json!({"observations": [{"time": now().to_string(), "target_id": target,
        "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.628, "sigma_m": 1.5}}]});
    let path = format!("/v1/cameras/{camera}/tracks?store_samples=false");
    server.post(&path, &fix).await.expect(200);
}

async fn until_taken(receiver: &Receiver, count: usize) -> Vec<String> {
    for _ in 0..1_500 {
        let taken = receiver.taken();
        if taken.len() >= count {
            return taken;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("{} of {count} messages were delivered", receiver.taken().len())
}

/// Every node queues what happens in the cameras that it owns, and one of them delivers it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_sink_of_cameras_on_two_nodes_is_delivered_once() {
    let folder = data_folder();
    let nodes = [node(folder.path()), node(folder.path())];
    for camera in ["gate", "yard"] {
        create(&nodes[0], &json!({"id": camera})).await;
    }
    let (receiver, address) = Receiver::start().await;
    let sink = json!({"address": address, "camera_ids": ["gate", "yard"], "min_interval_s": 0});
    nodes[0].post("/v1/connections", &json!({"id": "hook", "sink": sink})).await.expect(201);
    let owner = runner(&nodes[0], "hook").await;
    assert_eq!(runner(&nodes[1], "hook").await, owner);
    // Both nodes publish from here on; a node looks for connections once a second.
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    for number in 0..20 {
        fix(&nodes[0], "gate", &format!("van-{number}")).await;
        fix(&nodes[1], "yard", &format!("boat-{number}")).await;
    }
    let mut taken = until_taken(&receiver, 40).await;
    let shown = |status: &Value| status["items"] == 40 && status["messages"] == 40 && status["queued"] == 0;
    for server in &nodes {
        connection_when(server, "hook", shown).await;
    }
    taken.sort_unstable();
    taken.dedup();
    assert_eq!((taken.len(), receiver.taken().len()), (40, 40), "each once");

    let (mut owner, other) = by_url(nodes, &owner);
    owner.kill_now();
    let killed = Instant::now();
    // The survivor has one of the cameras, and takes the other one over.
    super::until_status(&other, "/v1/cameras/yard/tracks", 200).await;
    for number in 0..5 {
        fix(&other, "yard", &format!("late-{number}")).await;
    }
    until_taken(&receiver, 45).await;
    println!("killed: another node delivers after {:?}", killed.elapsed());
    let mut taken = receiver.taken();
    taken.sort_unstable();
    taken.dedup();
    assert_eq!((taken.len(), receiver.taken().len()), (45, 45), "each once");
    assert_eq!(runner(&other, "hook").await, url(&other));
    // Items that the other node had not queued cannot be known.
    connection_when(&other, "hook", |status| status["dropped"] == 1).await;
}

/// Has a node give a camera up for another.
fn hand_over(folder: &Path, camera: &str, to: &TestServer) {
    let wanted = format!(
        "UPDATE camera_owners SET wanted_by = (SELECT id FROM nodes WHERE url = '{}') \
         WHERE camera_key = (SELECT key FROM cameras WHERE id = '{camera}')",
        url(to)
    );
    sql(folder, &wanted);
}

/// Sends a fix to a node until it has the camera.
async fn fix_when_owner(server: &TestServer, camera: &str, fix: &Value) {
    let path = format!("/v1/cameras/{camera}/tracks?store_samples=false");
    for _ in 0..1_500 {
        if server.post(&path, &json!({"observations": [fix]})).await.status == 200 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("{} never owns {camera}", url(server))
}

/// A camera that goes to another node and comes back, six times: each position is delivered, and what is sent again to
/// the next owner has the id that it had.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_camera_that_changes_nodes_loses_no_position_and_doubles_none() {
    let folder = data_folder();
    let nodes = [node(folder.path()), node(folder.path())];
    create(&nodes[0], &json!({"id": "yard"})).await;
    let (receiver, address) = Receiver::start().await;
    let sink = json!({"address": address, "camera_ids": ["yard"], "min_interval_s": 0});
    nodes[0].post("/v1/connections", &json!({"id": "hook", "sink": sink})).await.expect(201);
    runner(&nodes[1], "hook").await;
    // Both nodes publish from here on; a node looks for connections once a second.
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    let fix = |target: String| {
        json!({"time": now().to_string(), "target_id": target,
            "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.628, "sigma_m": 1.5}})
    };
    let mut last = fix("first".to_owned());
    fix_when_owner(&nodes[0], "yard", &last).await;
    for turn in 1..=6 {
        let owner = &nodes[turn % 2];
        hand_over(folder.path(), "yard", owner);
        // The answer to it was lost, as far as its sender knows.
        fix_when_owner(owner, "yard", &last).await;
        for item in 0..10 {
            last = fix(format!("van-{turn}-{item}"));
            fix_when_owner(owner, "yard", &last).await;
        }
    }
    let mut ids = until_taken(&receiver, 67).await;
    let shown = |status: &Value| status["items"] == 67 && status["queued"] == 0 && status["dropped"] == 0;
    connection_when(&nodes[0], "hook", shown).await;
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(
        (ids.len(), receiver.taken().len()),
        (61, 67),
        "61 observations, 6 of them sent to both nodes"
    );
}

/// What a node has seen of a camera is older than what the next owner has seen, and no track of now.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_former_owner_lists_no_tracks_of_its_own_once_the_next_one_has_ended() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    first.post("/v1/sites", &json!({"id": "port"})).await.expect(201);
    create(&first, &json!({"id": "yard", "site": "port"})).await;
    let fix = |target: &str| {
        json!({"time": now().to_string(), "target_id": target,
            "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.628, "sigma_m": 1.5}})
    };
    fix_when_owner(&first, "yard", &fix("van")).await;
    let lists = [("/v1/cameras/yard/tracks", "features"), ("/v1/sites/port/tracks", "items")];
    for (path, list) in lists {
        let tracks = first.get(path).await.expect(200).json();
        assert_eq!(tracks[list].as_array().map(Vec::len), Some(1), "{path}: {tracks}");
    }
    hand_over(folder.path(), "yard", &second);
    fix_when_owner(&second, "yard", &fix("bus")).await;
    let targets =
        async || first.get("/v1/camera-statuses").await.expect(200).json()["items"][0]["targets"].clone();
    assert_eq!(targets().await, 0);
    assert!(second.terminate(), "the server ends in order");
    for (path, list) in lists {
        let tracks = super::until_status(&first, path, 200).await.json();
        assert_eq!(tracks[list], json!([]), "{path}: {tracks}");
    }
}
