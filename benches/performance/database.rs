//! The PostgreSQL backend: imports compared with COPY by psql, and the rate at which workers claim queued runs.
//!
//! `.ci/postgres -k` starts a server and prints the variable that this part needs.

use std::fmt::Write as _;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use sightfix::domain::{CameraId, Durability, NewCamera, Sample};
use sightfix::simulation::{Options, Scene, simulate};
use sightfix::store::{DatabaseUrl, Location, RunEnd, Store, StoreOptions};

use crate::ratio::{self, in_turn, median};
use crate::served::runtime;
use crate::tables;

const SERVER: &str = "SIGHTFIX_TEST_POSTGRES";
const ROWS: usize = 50_000;
/// Rows of a call, as an import of a file sends them.
const BATCH: usize = 4_096;
const QUEUED_RUNS: usize = 100_000;
const WORKERS: usize = 50;
/// Processes over which the workers are spread, each with a pool of its own.
const PROCESSES: usize = 5;
const CLAIMS_EACH: usize = 100;
/// The workers' time; no lease expires.
const NOW: Timestamp = Timestamp::UNIX_EPOCH;

pub(crate) fn run() {
    let Ok(server) = std::env::var(SERVER) else {
        println!(
            "\n### PostgreSQL: not measured, since {SERVER} is not set; `.ci/postgres -k` starts a server"
        );
        return;
    };
    let url = new_database(&server);
    imports(&url);
    claims(&url);
}

fn imports(url: &str) {
    let runtime = runtime();
    let store = runtime.block_on(open(url));
    let samples = simulate(&Options { samples: ROWS, ..Options::new(Scene::Square) }).training_samples();
    let round = AtomicUsize::new(0);
    let new_camera = || {
        let name = format!("import-{}", round.fetch_add(1, Ordering::Relaxed));
        let id = CameraId::new(&name).expect("a slug");
        let camera = NewCamera::named(id.clone());
        runtime.block_on(store.insert_camera(&camera, Timestamp::UNIX_EPOCH)).expect("a new camera");
        id
    };
    ratio::head("PostgreSQL: import of rows, compared with COPY by psql into the same table", "rows/s");
    for durability in [Durability::Synced, Durability::Relaxed] {
        let ours = || {
            let id = new_camera();
            let began = Instant::now();
            for batch in samples.chunks(BATCH) {
                let stored = store.insert_samples(&id, batch.to_vec(), durability);
                assert_eq!(runtime.block_on(stored).expect("stored").accepted as usize, batch.len());
            }
            samples.len() as f64 / began.elapsed().as_secs_f64()
        };
        let peer = || copy(url, &new_camera(), &samples, durability);
        ratio::row(
            &format!("{} rows in calls of {BATCH}, {durability}", samples.len()),
            &in_turn(ours, peer),
        );
    }
    runtime.block_on(store.close());
}

/// Rows per second of one COPY, with the start of psql.
fn copy(url: &str, camera: &CameraId, samples: &[Sample], durability: Durability) -> f64 {
    let key = psql(url, &format!("SELECT key FROM cameras WHERE id = '{camera}'"), "");
    let mut rows = String::new();
    for sample in samples {
        let [left, top, width, height] = sample.bounding_box.sides_px();
        let (time_us, target, fix) =
            (sample.time.as_microsecond(), sample.target_id.as_str(), sample.fix.position);
        writeln!(
            rows,
            "{key}\t{time_us}\t{target}\t{left}\t{top}\t{width}\t{height}\t{}\t{}",
            fix.longitude_deg(),
            fix.latitude_deg()
        )
        .expect("memory can be written");
    }
    let commit = match durability {
        Durability::Synced => "on",
        Durability::Relaxed => "off",
    };
    let statement = format!(
        "SET synchronous_commit = {commit}; COPY samples (camera_key, time_us, target_id, left_px, top_px, \
         width_px, height_px, longitude_deg, latitude_deg) FROM STDIN"
    );
    let began = Instant::now();
    psql(url, &statement, &rows);
    samples.len() as f64 / began.elapsed().as_secs_f64()
}

fn claims(url: &str) {
    psql(
        url,
        &format!(
            "INSERT INTO cameras (id, profile, learn_automatically, revision, created_at_us, updated_at_us) \
             SELECT 'queued-' || n, '{{}}', false, 1, 0, 0 FROM generate_series(1, {QUEUED_RUNS}) AS n; \
             INSERT INTO training_runs (id, camera_key, recipe, seed, state, priority, created_at_us) \
             SELECT gen_random_uuid(), key, 'hybrid', 0, 'queued', 0, 0 FROM cameras WHERE id LIKE 'queued-%'; \
             ANALYZE"
        ),
        "",
    );
    let runtime = runtime();
    let (took, mut times) = runtime.block_on(async {
        let mut stores = Vec::new();
        for _ in 0..PROCESSES {
            stores.push(open(url).await);
        }
        let stores = Arc::new(stores);
        let began = Instant::now();
        let mut workers = tokio::task::JoinSet::new();
        for worker in 0..WORKERS {
            let stores = stores.clone();
            workers.spawn(async move {
                let mut times = Vec::new();
                for _ in 0..CLAIMS_EACH {
                    let began = Instant::now();
                    let store = &stores[worker % PROCESSES];
                    let claim = store.claim_run::<CameraId>(Duration::from_secs(60), NOW);
                    let claim = claim.await.expect("the database answers").expect("a queued run");
                    times.push(began.elapsed().as_secs_f64() * 1e3);
                    let end = RunEnd::Failed { outcome: "only claimed".to_owned() };
                    let ended = store.finish_run::<CameraId>(claim.job.id, claim.fence, end, NOW);
                    ended.await.expect("the database answers").expect("the lease is held");
                }
                times
            });
        }
        let times: Vec<f64> = workers.join_all().await.into_iter().flatten().collect();
        (began.elapsed(), times)
    });
    let p50 = median(&mut times);
    let p99 = times[times.len() * 99 / 100];
    let title = format!(
        "PostgreSQL: claims by {WORKERS} workers of {PROCESSES} processes, {QUEUED_RUNS} runs queued"
    );
    tables::head(&title, &["claimed and ended", "runs/s", "claim p50 (ms)", "claim p99 (ms)"]);
    let rate = times.len() as f64 / took.as_secs_f64();
    tables::row(times.len(), &[(rate, 0), (p50, 1), (p99, 1)]);
}

async fn open(url: &str) -> Store {
    let location = Location::Database(DatabaseUrl::new(url).expect("a URL"));
    Store::open_at(&location, StoreOptions::default()).await.expect("opens")
}

fn new_database(server: &str) -> String {
    let name = format!("bench_{}", std::process::id());
    psql(server, &format!("CREATE DATABASE {name}"), "");
    let (server, _) = server.rsplit_once('/').expect("a URL with a database");
    format!("{server}/{name}")
}

/// The output of psql.
fn psql(url: &str, statements: &str, input: &str) -> String {
    let mut psql = Command::new("psql");
    psql.args(["-X", "-q", "-A", "-t", "-v", "ON_ERROR_STOP=1", "-d", url]);
    for statement in statements.split("; ") {
        psql.args(["-c", statement]);
    }
    let mut psql =
        psql.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("psql of postgresql-client");
    std::io::Write::write_all(&mut psql.stdin.take().expect("a pipe"), input.as_bytes()).expect("psql reads");
    let output = psql.wait_with_output().expect("psql ends");
    assert!(output.status.success(), "psql: {}", output.status);
    String::from_utf8(output.stdout).expect("text").trim().to_owned()
}
