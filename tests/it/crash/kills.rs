//! Kills at random moments, and at every kind of call that writes to the database.
//!
//! After SIGKILL the kernel still has what the process wrote, so moments differ only by the writes before
//! them. strace kills the process at its n-th write or flush, or makes that call fail; so every point within
//! an insert, commit, claim, heartbeat or finish can be hit, in the binary as it is delivered.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

use super::checks::{Findings, check, check_database};
use super::client::{Client, Reply};
use super::load::Load;
use super::setting;
use crate::harness::{TestServer, data_folder, run, sightfix};

/// The calls by which SQLite writes, and flushes.
pub(super) const WRITE: &str = "pwrite64";
pub(super) const FLUSH: &str = "fsync,fdatasync";
/// A server that reached no such call is killed after this time.
const LONGEST_LIFE: Duration = Duration::from_secs(3);
/// One in this number of moments is within the creation of the database.
const CREATION_EVERY: u64 = 6;

/// How a server ends.
#[derive(Debug, Clone)]
pub(super) enum Kill {
    After(Duration),
    /// At the n-th call of that name of the writing thread.
    AtCall(&'static str, u32),
    /// That call fails, and the server is killed later.
    AfterFailure(&'static str, u32, &'static str, Duration),
}

impl Kill {
    fn random(random: &mut ChaCha8Rng) -> Self {
        // Uniform in the logarithm: as many among the first ten calls as among the first thousand.
        let mut number = || 10_f64.powf(random.random_range(0.0..3.3)) as u32;
        let number = number();
        let time = Duration::from_millis(random.random_range(20..1_500));
        match random.random_range(0..20) {
            0..8 => Self::After(time),
            8..14 => Self::AtCall(WRITE, number),
            14..17 => Self::AtCall(FLUSH, number.div_ceil(4)),
            17 => Self::AfterFailure(FLUSH, number.div_ceil(4), "EIO", time),
            18 => Self::AfterFailure(WRITE, number, "EIO", time),
            _ => Self::AfterFailure(WRITE, number, "ENOSPC", time),
        }
    }

    fn name(&self) -> &'static str {
        match self {
            Self::After(_) => "at a random time",
            Self::AtCall(FLUSH, _) => "at a flush",
            Self::AtCall(..) => "at a write",
            Self::AfterFailure(..) => "after a call that failed",
        }
    }

    /// The server, traced if a call is to be hit.
    pub(super) fn command(&self) -> Command {
        let injection = match self {
            Self::After(_) => return sightfix(),
            Self::AtCall(call, number) => format!("inject={call}:signal=KILL:when={number}"),
            Self::AfterFailure(call, number, error, _) => {
                format!("inject={call}:error={error}:when={number}")
            }
        };
        let mut command = Command::new("strace");
        // -D: the tracer is a child of the server, so that signals meet the server.
        command.args(["-D", "-f", "-qq", "-o", "/dev/null"]);
        command.args(["-e", "trace=pwrite64,fsync,fdatasync", "-e", &injection]);
        command.arg(sightfix().get_program()).current_dir(std::env::temp_dir());
        command
    }

    const fn longest_life(&self) -> Duration {
        match self {
            Self::After(time) | Self::AfterFailure(.., time) => *time,
            Self::AtCall(..) => LONGEST_LIFE,
        }
    }
}

/// Settings under which the database fills up and requests are shed within the test, and runs are claimed
/// again soon.
const SETTINGS: [(&str, &str); 8] = [
    ("SIGHTFIX_LIMITS__MODELS_PER_CAMERA", "5"),
    ("SIGHTFIX_LIMITS__REQUESTS", "10"),
    ("SIGHTFIX_LIMITS__RESERVED_REQUESTS", "4"),
    ("SIGHTFIX_LIMITS__CLIENT_SHARE", "1"),
    ("SIGHTFIX_LIMITS__DATABASE_BYTES", "6291456"),
    ("SIGHTFIX_LIMITS__RESERVE_BYTES", "1048576"),
    ("SIGHTFIX_LIMITS__ENDED_RUNS_PER_CAMERA", "100000"),
    ("SIGHTFIX_TRAINING__LEASE_S", "3"),
];

/// Starts a server; the log of one that ends before it listens.
fn start(mut command: Command, folder: &Path, key: &str) -> Result<TestServer, Vec<Value>> {
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(folder);
    command.envs(SETTINGS).env("SIGHTFIX_ADMIN_KEY", key).stdout(Stdio::null());
    TestServer::try_run(command)
}

/// Starts a server without faults, which must work; the time until it is ready.
pub(super) async fn recover(folder: &Path, key: &str) -> (TestServer, Client, Duration) {
    let began = Instant::now();
    let server = start(sightfix(), folder, key).expect("the server starts");
    let client = Client::new(server.address, key);
    match client.send("GET", "/readyz", "", "").await {
        Reply::Done(_) => {}
        Reply::Refused(status, body) => panic!("not ready: {status} {body}"),
        Reply::Unknown => panic!("the server is gone"),
    }
    (server, client, began.elapsed())
}

/// Waits until the server has ended, or kills it.
pub(super) async fn end(server: &mut TestServer, after: Duration) {
    let deadline = Instant::now() + after;
    while !server.has_ended() && Instant::now() < deadline {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    server.kill_now();
}

/// The sums over all moments.
#[derive(Default)]
struct Totals {
    moments: Vec<&'static str>,
    panics: Vec<String>,
    findings: Findings,
    recovery_s: Vec<f64>,
}

impl Totals {
    fn ended(
        &mut self,
        kind: &'static str,
        server: &Result<TestServer, Vec<Value>>,
        findings: Findings,
        recovery: Duration,
    ) {
        self.moments.push(kind);
        let log = match server {
            Ok(server) => server.log_lines(""),
            Err(log) => log.iter().map(Value::to_string).collect(),
        };
        self.panics.extend(log.into_iter().filter(|line| line.contains("panicked")));
        self.findings.add(findings);
        self.recovery_s.push(recovery.as_secs_f64());
    }

    fn print(&mut self, acknowledged: u64) {
        self.recovery_s.sort_by(f64::total_cmp);
        let (lost, panics) = (self.findings.lost.len(), self.panics.len());
        println!(
            "{} kills: {acknowledged} acknowledged steps, {lost} lost, {} inconsistent, {panics} panics; ready \
             after {:.2} s (median), {:.2} s (longest)",
            self.moments.len(),
            self.findings.inconsistent.len(),
            self.recovery_s[self.recovery_s.len() / 2],
            self.recovery_s[self.recovery_s.len() - 1],
        );
        let mut kinds = self.moments.clone();
        kinds.sort_unstable();
        for kind in kinds.chunk_by(|one, other| one == other) {
            println!("  {:4} {}", kind.len(), kind[0]);
        }
    }
}

/// Kills a server that creates its database, at its n-th write.
async fn kill_creation(random: &mut ChaCha8Rng, key: &str, totals: &mut Totals) {
    let folder = data_folder();
    let kill = match random.random_range(0..4) {
        0 => Kill::AtCall(FLUSH, random.random_range(1..8)),
        _ => Kill::AtCall(WRITE, random.random_range(1..150)),
    };
    let mut ended = start(kill.command(), folder.path(), key);
    if let Ok(server) = &mut ended {
        server.kill_now();
    }
    let (recovered, client, time) = recover(folder.path(), key).await;
    let created = client.json("POST", "/v1/cameras", &json!({"id": "c"})).await;
    assert!(matches!(created, Reply::Done(_)), "the database works");
    drop(recovered);
    totals.ended("while the database is created", &ended, check_database(folder.path()), time);
}

/// `KILL_MOMENTS=300 KILL_SEED=2` for more and others.
#[tokio::test]
#[ignore = "takes a minute and needs strace; .ci/run runs it"]
async fn killed_servers_open_again_with_everything_acknowledged() {
    let moments = setting("KILL_MOMENTS", 20);
    let mut random = ChaCha8Rng::seed_from_u64(setting("KILL_SEED", 1));
    let (folder, mut totals) = (data_folder(), Totals::default());
    let key = run(&["keys", "generate"]).trim().to_owned();
    let (mut server, client, _) = recover(folder.path(), &key).await;
    let mut load = Load::set_up(&client).await;
    server.kill_now();
    for moment in 0..moments {
        if moment % CREATION_EVERY == CREATION_EVERY - 1 {
            kill_creation(&mut random, &key, &mut totals).await;
            continue;
        }
        let kill = Kill::random(&mut random);
        let mut ended = start(kill.command(), folder.path(), &key);
        if let Ok(server) = &mut ended {
            let client = Client::new(server.address, &key);
            tokio::join!(load.run(&client), end(server, kill.longest_life()));
        }
        let (mut recovered, client, time) = recover(folder.path(), &key).await;
        let mut findings = check(folder.path(), &mut load);
        check_revoked(&client, &load, &mut findings).await;
        totals.ended(kill.name(), &ended, findings, time);
        recovered.kill_now();
    }
    totals.print(load.acknowledged());
    assert_eq!(totals.panics, Vec::<String>::new());
    assert_eq!(totals.findings.lost, Vec::<String>::new());
    assert_eq!(totals.findings.inconsistent, Vec::<String>::new());
    assert!(load.acknowledged() > 10 * moments, "the load works: {}", load.acknowledged());
}

/// No key works whose revocation was acknowledged.
pub(super) async fn check_revoked(client: &Client, load: &Load, findings: &mut Findings) {
    for secret in load.writers.iter().flat_map(|writer| writer.revoked.last()) {
        let reply = client.with_key(secret).send("GET", "/v1/cameras", "", "").await;
        if !secret.is_empty() && !matches!(reply, Reply::Refused(401, _)) {
            findings.lost.push("a revocation".to_owned());
        }
    }
}
