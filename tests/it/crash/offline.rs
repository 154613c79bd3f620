//! Kills of what is no request: a backup beside a server at work.

use std::path::Path;
use std::process::Command;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rusqlite::Connection;

use super::checks::check_database;
use super::kills::{FLUSH, Kill, WRITE};
use super::setting;
use crate::harness::{TestServer, data_folder};

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

fn csv(import: u64) -> String {
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    for row in 0..250 {
        let second = i64::try_from(1_600_000_000 + import * 250 + row).expect("in range");
        let time = jiff::Timestamp::from_second(second).expect("in range");
        csv += &format!("{time},person-1,10,20,30,60,103.9,30.6\n");
    }
    csv
}

/// `KILL_MOMENTS=100 KILL_SEED=2` for more and others.
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
