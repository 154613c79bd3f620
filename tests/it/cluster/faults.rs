//! Nodes that end, sleep or lose the database in the middle of streams.

use std::path::Path;
use std::time::{Duration, Instant};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use sightfix::grpc::proto;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::Code;
use tonic_types::StatusExt as _;

use super::feed::{Feed, PACE};
use super::{assert_stored_once, create, fence, items, node, sql, url};
use crate::harness::{TestServer, data_folder};
use crate::live_client::{Received, Sent, begin, channel};

const END_ALL_CONNECTIONS: &str = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity \
                                   WHERE datname = current_database() AND pid <> pg_backend_pid()";

/// A stream of items that runs beside the test, at these nodes. The second half waits until the sender says true: a fault
/// always comes before the end.
fn streaming(
    items: Vec<proto::StreamItem>,
    nodes: &[&TestServer],
) -> (JoinHandle<Feed>, watch::Sender<bool>) {
    let nodes: Vec<_> = nodes.iter().map(|server| url(server)).collect();
    let (go_on, goes_on) = watch::channel(false);
    let feeding = tokio::spawn(async move {
        let mut feed = Feed { goes_on, ..Feed::new("yard", items) };
        feed.resume_at(&nodes.iter().map(String::as_str).collect::<Vec<_>>()).await;
        feed
    });
    (feeding, go_on)
}

/// Waits until that number of samples is stored.
async fn until_stored(folder: &Path, samples: i64) {
    loop {
        let stored: i64 = sql(folder, "SELECT count(*) FROM samples").parse().expect("a number");
        if stored >= samples {
            return;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn another_node_follows_one_that_was_killed() {
    let folder = data_folder();
    let (mut first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let (feeding, go_on) = streaming(items(500), &[&first, &second]);
    until_stored(folder.path(), 100).await;
    first.kill_now();
    let killed = Instant::now();
    go_on.send(true).expect("the stream runs");
    let feed = feeding.await.expect("no panic");
    println!(
        "killed: another node answers after {:?}, {} attempts, {} redirects",
        feed.taken_over_after(killed, &url(&first)),
        feed.attempts,
        feed.redirects
    );
    assert_eq!((feed.answered_by(), fence(folder.path(), "yard")), (&*url(&second), 2));
    assert_stored_once(&second, &feed).await;
    let metrics = second.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_camera_takeovers_total 1"), "{metrics}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_that_shuts_down_hands_over_at_once() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let (feeding, go_on) = streaming(items(500), &[&first, &second]);
    until_stored(folder.path(), 100).await;
    let (ended, before) = (Instant::now(), url(&first));
    let terminated = tokio::task::spawn_blocking(move || first.terminate());
    go_on.send(true).expect("the stream runs");
    let feed = feeding.await.expect("no panic");
    let took = feed.taken_over_after(ended, &before);
    println!("shut down: another node answers after {took:?}, {} attempts", feed.attempts);
    assert!(terminated.await.expect("no panic"), "it ends in order");
    assert_eq!((feed.answered_by(), fence(folder.path(), "yard")), (&*url(&second), 2));
    assert_stored_once(&second, &feed).await;
    let metrics = second.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_camera_takeovers_total 0"), "it was released: {metrics}");
    assert_eq!(sql(folder.path(), "SELECT count(*) FROM nodes"), "1");
}

/// A client whose node sleeps; the camera goes to another node, and the first one wakes up to items on its open stream.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_that_slept_through_its_lease_answers_no_more() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let items = items(60);
    let mut sleeper = Sleeper::open(&first, &items[..20]).await;
    first.signal("-STOP");
    for item in &items[..20] {
        sleeper.stream.item(item.clone()).await;
    }
    let mut feed = Feed::new("yard", items);
    feed.resume_at(&[&url(&second)]).await;
    let fence_of_second = fence(folder.path(), "yard");
    assert!(fence_of_second >= 2, "{fence_of_second}");
    first.signal("-CONT");
    let (answers, ended) = sleeper.rest().await;
    let reason = ended.get_details_error_info().map(|info| info.reason).unwrap_or_default();
    println!("woke up: {answers} answers, then {ended}");
    assert_eq!((answers, ended.code(), &*reason), (0, Code::Unavailable, "camera-between-nodes"), "{ended}");
    assert_eq!(fence(folder.path(), "yard"), fence_of_second, "one owner");
    // It registers again, and knows who the owner is.
    super::until_status(&first, "/v1/cameras/yard/tracks", 307).await;
    assert_stored_once(&first, &feed).await;
}

/// A client that goes on reading its stream while the node sleeps.
struct Sleeper {
    stream: crate::live_client::Client,
}

impl Sleeper {
    /// Streams items and waits until all of them are answered.
    async fn open(server: &TestServer, items: &[proto::StreamItem]) -> Self {
        let opening = Sent::Opening(proto::StreamOpening {
            camera_id: "yard".to_owned(),
            client_name: "sleeper".to_owned(),
            ..Default::default()
        });
        let mut stream = begin(&channel(server).await, opening).await;
        for item in items {
            stream.item(item.clone()).await;
        }
        for _ in items {
            stream.answer().await;
        }
        Self { stream }
    }

    /// Answers until the stream ends, and how it ends.
    async fn rest(mut self) -> (usize, tonic::Status) {
        let mut answers = 0;
        loop {
            match self.stream.next().await {
                Ok(Some(Received::Answer(_))) => answers += 1,
                Ok(Some(_)) => {}
                Ok(None) => panic!("it is ended with a reason"),
                Err(status) => return (answers, status),
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn connections_that_the_database_ends_lose_nothing_that_was_acknowledged() {
    let folder = data_folder();
    let (first, second) = (node(folder.path()), node(folder.path()));
    create(&first, &json!({"id": "yard"})).await;
    let (feeding, go_on) = streaming(items(500), &[&first, &second]);
    go_on.send(true).expect("the stream runs");
    let mut ended = 0;
    for stored in [50, 150, 250, 350] {
        until_stored(folder.path(), stored).await;
        ended += sql(folder.path(), END_ALL_CONNECTIONS).parse::<i64>().expect("a number");
    }
    let feed = feeding.await.expect("no panic");
    println!("{ended} connections ended: {} attempts, {} redirects", feed.attempts, feed.redirects);
    assert_eq!(fence(folder.path(), "yard"), 1, "the registration outlasts its connections");
    assert_stored_once(&second, &feed).await;
}

/// The node that owns the camera, as soon as one does.
async fn owner(folder: &Path, nodes: &[TestServer]) -> usize {
    loop {
        let owner = sql(folder, "SELECT url FROM nodes JOIN camera_owners ON node_id = id");
        match nodes.iter().position(|server| url(server) == owner) {
            Some(owner) => return owner,
            None => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}

/// A number of the environment.
pub(super) fn number_of(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// A fault of the owner in the middle of a stream.
#[derive(Debug, Clone, Copy)]
enum FaultKind {
    Kill,
    Sleep,
    ShutDown,
    EndConnections,
}

/// Faults of owners at random moments. `CLUSTER_FAULTS` is their number, `CLUSTER_SEED` the seed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn faults_of_owners_at_random_moments_lose_and_duplicate_nothing() {
    let (faults, seed) = (number_of("CLUSTER_FAULTS", 6), number_of("CLUSTER_SEED", 1));
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let folder = data_folder();
    let mut nodes: Vec<TestServer> = (0..3).map(|_| node(folder.path())).collect();
    create(&nodes[0], &json!({"id": "yard"})).await;
    let all = items(300 * faults as usize);
    let (mut acknowledged, mut two_owners, mut takeovers) = (0, 0, Vec::new());
    for round in 0..faults as usize {
        let kind = [FaultKind::Kill, FaultKind::Sleep, FaultKind::ShutDown, FaultKind::EndConnections]
            [random.random_range(0..4)];
        let before: i64 = sql(folder.path(), "SELECT count(*) FROM samples").parse().expect("a number");
        let mut known: Vec<&TestServer> = nodes.iter().collect();
        let begin_at = random.random_range(0..known.len());
        known.rotate_left(begin_at);
        let (feeding, go_on) = streaming(all[300 * round..300 * (round + 1)].to_vec(), &known);
        until_stored(folder.path(), before + random.random_range(5..120)).await;
        let owner = owner(folder.path(), &nodes).await;
        let owner_url = url(&nodes[owner]);
        let fence_before = fence(folder.path(), "yard");
        let began = Instant::now();
        let ended = match kind {
            FaultKind::Kill => {
                nodes[owner].kill_now();
                None
            }
            FaultKind::Sleep => {
                nodes[owner].signal("-STOP");
                None
            }
            FaultKind::ShutDown => {
                let ending = std::mem::replace(&mut nodes[owner], node(folder.path()));
                Some(tokio::task::spawn_blocking(move || ending.terminate()))
            }
            FaultKind::EndConnections => {
                sql(folder.path(), END_ALL_CONNECTIONS);
                None
            }
        };
        go_on.send(true).expect("the stream runs");
        let feed = feeding.await.expect("no panic");
        acknowledged += feed.acknowledged;
        let fence_after = fence(folder.path(), "yard");
        println!("round {round}: {kind:?}, fence {fence_before} -> {fence_after}");
        if matches!(kind, FaultKind::Kill | FaultKind::Sleep) {
            takeovers.push(feed.taken_over_after(began, &owner_url));
        }
        match kind {
            FaultKind::Kill => nodes[owner] = node(folder.path()),
            FaultKind::Sleep => {
                let mut late = Feed::new("yard", all[..1].to_vec());
                nodes[owner].signal("-CONT");
                // The first thing that it is asked, of a camera that another node owns.
                two_owners += usize::from(late.stream(&owner_url, PACE).await.is_ok());
            }
            FaultKind::ShutDown | FaultKind::EndConnections => {}
        }
        if let Some(ended) = ended {
            assert!(ended.await.expect("no panic"), "it ends in order");
        }
        if !matches!(kind, FaultKind::EndConnections) {
            assert!(fence_after > fence_before, "another owner has another fence");
        }
    }
    let stored: u64 = sql(folder.path(), "SELECT count(*) FROM samples").parse().expect("a number");
    let distinct: u64 =
        sql(folder.path(), "SELECT count(DISTINCT time_us) FROM samples").parse().expect("a number");
    takeovers.sort_unstable();
    let quantile = |share: f64| {
        let at = ((takeovers.len() as f64 - 1.0).max(0.0) * share).round() as usize;
        takeovers.get(at).map_or(0, Duration::as_millis)
    };
    println!(
        "| tries | acknowledged | lost | duplicated | two owners | take-over p50 ms | p99 ms |\n\
         | {faults} | {acknowledged} | {} | {} | {two_owners} | {} | {} |",
        acknowledged.saturating_sub(distinct),
        stored - distinct,
        quantile(0.5),
        quantile(0.99)
    );
    assert_eq!((stored, distinct, two_owners), (acknowledged, acknowledged, 0));
}
