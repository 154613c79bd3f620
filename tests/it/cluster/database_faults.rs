//! A database that is killed, out of reach or full in the middle of streams that store samples, and of training runs.

use std::time::{Duration, Instant};

use rand::seq::SliceRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tokio::sync::watch;

use super::database::{Database, Link};
use super::faults::number_of;
use super::feed::{Feed, PACE};
use super::{create, items, url};
use crate::harness::{TestServer, sightfix, simulated_csv};

const END_ALL_CONNECTIONS: &str = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity \
                                   WHERE datname = current_database() AND pid <> pg_backend_pid()";
/// Items of a round.
const ITEMS: usize = 300;
const RUNS: &str = "/v1/cameras/trained/training-runs";

/// A fault of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FaultKind {
    /// `kill -9` of the server, started again after a while.
    Kill,
    /// The owner does not reach it.
    Partition,
    /// Its disk has no byte left.
    FullDisk,
    /// It ends all of its connections, again and again.
    Terminate,
}

const KINDS: [FaultKind; 4] =
    [FaultKind::Kill, FaultKind::Partition, FaultKind::FullDisk, FaultKind::Terminate];

/// Nodes that answer clients and train, each on a way of its own to one database.
struct Nodes {
    database: Database,
    links: Vec<Link>,
    nodes: Vec<TestServer>,
}

impl Nodes {
    async fn start(count: usize) -> Self {
        let database = Database::start().await;
        let (mut links, mut nodes) = (Vec::new(), Vec::new());
        for _ in 0..count {
            let link = Link::to(database.address()).await;
            let mut command = sightfix();
            command.args(["serve", "--listen", "127.0.0.1:0", "--database", &database.url(Some(link.port))]);
            command.envs([("SIGHTFIX_NODE_LEASE_S", "2"), ("SIGHTFIX_TRAINING__LEASE_S", "3")]);
            let server = tokio::task::spawn_blocking(|| TestServer::run(command));
            nodes.push(server.await.expect("it starts"));
            links.push(link);
        }
        Self { database, links, nodes }
    }

    fn stored(&self) -> u64 {
        self.database
            .number("SELECT count(*) FROM samples JOIN cameras ON key = camera_key WHERE id = 'yard'")
    }

    fn fence(&self) -> u64 {
        let fence = "SELECT fence FROM camera_owners JOIN cameras ON key = camera_key WHERE id = 'yard'";
        self.database.number(fence)
    }

    /// The node that owns the camera, as soon as one does.
    async fn owner(&self) -> usize {
        let owner = "SELECT url FROM nodes JOIN camera_owners ON node_id = nodes.id \
                     JOIN cameras ON key = camera_key WHERE cameras.id = 'yard'";
        loop {
            let owner = self.database.sql(owner).expect("the database answers");
            match self.nodes.iter().position(|server| url(server) == owner) {
                Some(owner) => return owner,
                None => tokio::time::sleep(Duration::from_millis(20)).await,
            }
        }
    }

    /// Queues a training run; a node that has just lost its connections asks for another attempt.
    async fn start_run(&self, round: usize) {
        let run = json!({"seed": round, "epochs": 4});
        loop {
            let answer = self.nodes[round % 2].post(RUNS, &run).await;
            if answer.status != 503 {
                answer.expect(202);
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Injects a fault and takes it back after `duration`; whether the node that was cut off was the owner beside another one.
    async fn fault(
        &mut self,
        kind: FaultKind,
        duration: Duration,
        item: &sightfix::grpc::proto::StreamItem,
    ) -> bool {
        let mut are_two = false;
        match kind {
            FaultKind::Kill => {
                self.database.kill();
                tokio::time::sleep(duration).await;
            }
            FaultKind::Partition => {
                let (owner, fence) = (self.owner().await, self.fence());
                self.links[owner].cut();
                while self.fence() == fence {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                // Another node is the owner, and this one does not know.
                let mut late = Feed::new("yard", vec![item.clone()]);
                are_two = late.stream(&url(&self.nodes[owner]), PACE).await.is_ok();
                tokio::time::sleep(duration).await;
                self.links[owner].mend();
            }
            FaultKind::FullDisk => {
                self.database.fill_disk();
                tokio::time::sleep(duration).await;
                self.database.free_disk();
            }
            FaultKind::Terminate => {
                for _ in 0..10 {
                    // The server may still be busy with those of before.
                    let _ = self.database.sql(END_ALL_CONNECTIONS);
                    tokio::time::sleep(duration / 10).await;
                }
            }
        }
        self.database.keep_running().await;
        are_two
    }
}

/// Faults of the database at random moments, of random lengths. `DATABASE_FAULTS` is their number, `DATABASE_SEED` the seed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn faults_of_the_database_lose_and_duplicate_nothing() {
    let (faults, seed) = (number_of("DATABASE_FAULTS", 4), number_of("DATABASE_SEED", 1));
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut cluster = Nodes::start(2).await;
    let csv = [("content-type", "text/csv")];
    create(&cluster.nodes[0], &json!({"id": "yard"})).await;
    create(&cluster.nodes[0], &json!({"id": "trained"})).await;
    cluster.nodes[0].send("POST", "/v1/cameras/trained/samples", &csv, simulated_csv()).await.expect(200);
    let all = items(ITEMS * faults as usize);
    let mut kinds: Vec<FaultKind> = KINDS.into_iter().cycle().take(faults as usize).collect();
    kinds.shuffle(&mut random);
    if !cluster.database.has_own_disk() {
        println!("no disk can be filled without the superuser");
        kinds.retain(|kind| *kind != FaultKind::FullDisk);
    }
    let (mut acknowledged, mut two_owners, mut recoveries) = (0, 0, Vec::new());
    for (round, kind) in kinds.iter().enumerate() {
        cluster.start_run(round).await;
        let before = cluster.stored();
        let (go_on, goes_on) = watch::channel(false);
        let mut feed =
            Feed { goes_on, ..Feed::new("yard", all[ITEMS * round..ITEMS * (round + 1)].to_vec()) };
        let mut known: Vec<String> = cluster.nodes.iter().map(url).collect();
        known.rotate_left(random.random_range(0..2));
        let feeding = tokio::spawn(async move {
            feed.resume_at(&known.iter().map(String::as_str).collect::<Vec<_>>()).await;
            feed
        });
        let until = before + random.random_range(5..120);
        while cluster.stored() < until {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let duration = Duration::from_millis(random.random_range(200..3_000));
        let began = Instant::now();
        let going_on = tokio::spawn(async move {
            // Items are sent while the fault lasts, too.
            tokio::time::sleep(duration / 2).await;
            go_on.send(true).is_ok()
        });
        two_owners += usize::from(cluster.fault(*kind, duration, &all[0]).await);
        going_on.await.expect("no panic");
        let feed = feeding.await.expect("no panic");
        acknowledged += feed.acknowledged;
        recoveries.push(feed.longest_silence_after(began));
        println!(
            "round {round}: {kind:?} for {} ms, {} attempts, longest time without an answer {} ms",
            duration.as_millis(),
            feed.attempts,
            recoveries[round].as_millis()
        );
        until_ended(&cluster.nodes[round % 2]).await;
    }
    let (stored, runs) = (cluster.stored(), "SELECT count(*) FROM training_runs WHERE state = 'succeeded'");
    // A full disk fails a run for good, and says so.
    let full = "SELECT count(*) FROM training_runs \
                WHERE state = 'failed' AND outcome LIKE 'the disk of the database is full%'";
    let distinct = cluster.database.number(
        "SELECT count(DISTINCT time_us) FROM samples JOIN cameras ON key = camera_key WHERE id = 'yard'",
    );
    let (succeeded, failed) = (cluster.database.number(runs), cluster.database.number(full));
    let full_disks = kinds.iter().filter(|kind| **kind == FaultKind::FullDisk).count() as u64;
    let models = cluster.database.number("SELECT count(*) FROM models WHERE run_id IS NOT NULL");
    recoveries.sort_unstable();
    println!(
        "| faults | acknowledged | lost | duplicated | two owners | runs succeeded, versions | runs failed by a full disk | longest without an answer, ms |\n\
         | {} | {acknowledged} | {} | {} | {two_owners} | {succeeded}, {models} | {failed} | {} |",
        kinds.len(),
        acknowledged.saturating_sub(distinct),
        stored - distinct,
        recoveries.last().map_or(0, Duration::as_millis)
    );
    assert_eq!((stored, distinct, two_owners), (acknowledged, acknowledged, 0));
    assert_eq!((succeeded + failed, models), (kinds.len() as u64, succeeded), "every run ends, and once");
    assert!(failed <= full_disks, "{failed} runs failed, the disk was full {full_disks} times");
}

/// Waits until no training run is queued or running.
async fn until_ended(server: &TestServer) {
    for _ in 0..1_200 {
        let page = server.get(RUNS).await;
        let is_live = |run: &serde_json::Value| matches!(run["state"].as_str(), Some("queued" | "running"));
        if page.status == 200 && !page.json()["items"].as_array().expect("runs").iter().any(is_live) {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("a run never ends");
}
