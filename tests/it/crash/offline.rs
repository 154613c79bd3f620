//! Kills of what is no request: the upgrade of an older database, and a backup beside a server at work.

use std::path::Path;
use std::process::{Command, Stdio};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rusqlite::Connection;
use sqlx::ConnectOptions as _;
use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteAutoVacuum, SqliteConnectOptions, SqliteJournalMode};

use super::checks::check_database;
use super::kills::{FLUSH, Kill, WRITE};
use super::setting;
use crate::harness::{TestServer, data_folder};

const MIGRATIONS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/migrations/sqlite");
/// Samples of the older database.
const SAMPLES: i64 = 2_000;
/// The step that brought counts of samples, which are kept by the program.
const COUNTS_STEP: i64 = 6;

/// A database as the release of a step left it, with one camera and its samples.
async fn older_database(folder: &Path, migrator: &Migrator, step: i64) {
    std::fs::create_dir_all(folder).expect("a folder");
    let path = folder.join("sightfix.db");
    let options = SqliteConnectOptions::new()
        .filename(&path)
        .create_if_missing(true)
        .auto_vacuum(SqliteAutoVacuum::Incremental)
        .journal_mode(SqliteJournalMode::Wal);
    let mut connection = options.connect().await.expect("a new database");
    migrator.run_to(step, &mut connection).await.expect("its steps");
    sqlx::Connection::close(connection).await.expect("closed");
    let database = Connection::open(&path).expect("the database opens");
    database
        .execute_batch(&format!(
            "INSERT INTO cameras (id, display_name, recipe, target_classes, labels, revision, created_at_us, \
             updated_at_us) VALUES ('old', 'old', 'projective', '[]', '{{}}', 1, 0, 0);
             WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {SAMPLES})
             INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
             longitude_deg, latitude_deg) SELECT 1, i * 1000000, 'a', 1, 2, 3, 4, 5, 6 FROM n;"
        ))
        .expect("rows of that release");
    if step >= COUNTS_STEP {
        let counts = format!("INSERT INTO sample_counts (camera_key, samples) VALUES (1, {SAMPLES})");
        database.execute_batch(&counts).expect("counts of that release");
    }
}

fn count(database: &Path) -> i64 {
    let database = Connection::open(database).expect("the database opens");
    let check: String =
        database.query_row("PRAGMA integrity_check", [], |row| row.get(0)).expect("it can be checked");
    assert_eq!(check, "ok");
    database.query_row("SELECT count(*) FROM samples", [], |row| row.get(0)).expect("a count")
}

fn random_kill(random: &mut ChaCha8Rng, writes: u32) -> Kill {
    match random.random_range(0..4) {
        0 => Kill::AtCall(FLUSH, random.random_range(1..6)),
        _ => Kill::AtCall(WRITE, random.random_range(1..writes)),
    }
}

/// `KILL_MOMENTS=100 KILL_SEED=2` for more and others.
#[tokio::test]
#[ignore = "takes a minute and needs strace; .ci/run runs it"]
async fn a_killed_upgrade_leaves_the_old_database_or_the_new_one() {
    let moments = setting("KILL_MOMENTS", 20);
    let mut random = ChaCha8Rng::seed_from_u64(setting("KILL_SEED", 1));
    let migrator = Migrator::new(Path::new(MIGRATIONS)).await.expect("the steps");
    let newest = migrator.iter().map(|step| step.version).max().expect("steps");
    let mut killed = 0;
    for moment in 0..moments {
        let folder = data_folder();
        let step = random.random_range(1..newest);
        older_database(folder.path(), &migrator, step).await;
        let kill = random_kill(&mut random, 120);
        let mut command = kill.command();
        command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(folder.path()).stdout(Stdio::null());
        match TestServer::try_run(command) {
            Ok(server) => server.kill(),
            Err(log) => {
                assert!(!log.iter().any(|entry| entry.to_string().contains("panicked")), "{log:?}");
                killed += 1;
            }
        }
        let server = TestServer::start(folder.path());
        let path = "/v1/cameras/old/samples/count";
        assert_eq!(
            server.get(path).await.expect(200).json()["count"],
            SAMPLES,
            "moment {moment}, step {step}"
        );
        server.kill();
        let findings = check_database(folder.path());
        assert_eq!(
            (findings.lost.len(), findings.inconsistent.len()),
            (0, 0),
            "{findings:?} from step {step}"
        );
    }
    println!("{moments} upgrades, {killed} killed before they listened: 0 lost, 0 inconsistent");
    assert!(killed > 0, "no kill was within the upgrade");
}

fn csv(import: u64) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for row in 0..250 {
        let second = i64::try_from(1_600_000_000 + import * 250 + row).expect("in range");
        let time = jiff::Timestamp::from_second(second).expect("in range");
        csv += &format!("{time},person-1,10,20,30,60,103.9,30.6\n");
    }
    csv
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes a minute and needs strace; .ci/run runs it"]
async fn a_killed_backup_leaves_a_whole_file_or_none_and_the_server_as_it_was() {
    let moments = setting("KILL_MOMENTS", 20);
    let mut random = ChaCha8Rng::seed_from_u64(setting("KILL_SEED", 1));
    let (data, target) = (data_folder(), data_folder());
    let server = TestServer::start(data.path());
    server.post("/v1/cameras", &serde_json::json!({"id": "c"})).await.expect(201);
    let (mut acknowledged, mut whole) = (0, 0);
    for moment in 0..moments {
        let file = target.path().join(format!("backup-{moment}.db"));
        let mut command: Command = random_kill(&mut random, 200).command();
        command.arg("backup").arg(&file).arg("--data").arg(data.path());
        let before = acknowledged;
        let backup = tokio::task::spawn_blocking(move || command.output().expect("the binary runs"));
        let headers = [("content-type", "text/csv")];
        server.send("POST", "/v1/cameras/c/samples", &headers, csv(moment)).await.expect(200);
        acknowledged += 250;
        let output = backup.await.expect("no panic");
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!text.contains("panicked"), "{text}");
        assert!(file.exists() || !output.status.success(), "moment {moment}: {text}");
        if file.exists() {
            let stored = count(&file);
            assert!(stored >= before && stored % 250 == 0, "{stored} of {before}");
            whole += 1;
        }
    }
    server.kill();
    assert_eq!(count(&data.path().join("sightfix.db")), acknowledged);
    let findings = check_database(data.path());
    assert_eq!((findings.lost.len(), findings.inconsistent.len()), (0, 0), "{findings:?}");
    println!("{moments} backups, {} killed, {whole} whole; {acknowledged} samples, 0 lost", moments - whole);
    assert!(whole < moments, "no kill was within a backup");
}
