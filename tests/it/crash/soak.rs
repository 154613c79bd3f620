//! More load than the server takes, while runs train, versions are activated, keys are revoked and the
//! process is killed and started again.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::json;

use super::checks::{Findings, check};
use super::client::{Client, Reply};
use super::kills::{check_revoked, end, recover};
use super::load::Load;
use super::setting;
use crate::harness::{data_folder, run};

/// Time between kills.
const LIFE: Duration = Duration::from_secs(15);
/// Clients that fuse without a pause: more than the server has places for.
const FUSING_CLIENTS: usize = 24;

/// Resident memory of a process in MB, where the system tells.
fn resident_mb(pid: u32) -> Option<f64> {
    let status = std::fs::read_to_string(Path::new("/proc").join(pid.to_string()).join("status")).ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

/// Fuses until the server is gone.
async fn fuse(client: &Client) {
    let fix = json!({"longitude_deg": 103.98678, "latitude_deg": 30.62801});
    let bounding_box = json!({"left_px": 900.0, "top_px": 500.0, "width_px": 40.0, "height_px": 90.0});
    let one = json!({"time": "2026-01-01T00:00:00Z", "fix": fix, "bounding_box": bounding_box});
    let body = json!({"observations": vec![one; 200]});
    loop {
        match client.json("POST", "/v1/cameras/activated/fusions", &body).await {
            Reply::Done(_) => {}
            Reply::Refused(503, _) => tokio::time::sleep(Duration::from_millis(20)).await,
            Reply::Refused(status, body) => panic!("{status} {body}"),
            Reply::Unknown => return,
        }
    }
}

/// Notes the resident memory until the server is killed.
async fn watch(server: &mut crate::harness::TestServer, life: Duration, resident: &mut Vec<f64>) {
    let began = Instant::now();
    while began.elapsed() + Duration::from_secs(1) < life {
        tokio::time::sleep(Duration::from_secs(1)).await;
        resident.extend(resident_mb(server.pid()));
    }
    end(server, life.saturating_sub(began.elapsed())).await;
}

/// `OVERLOAD_S=600` for ten minutes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes half a minute; .ci/run runs it"]
async fn a_server_under_more_load_than_it_takes_loses_nothing_and_fails_never() {
    let deadline = Instant::now() + Duration::from_secs(setting("OVERLOAD_S", 30));
    let (folder, mut findings) = (data_folder(), Findings::default());
    let key = run(&["keys", "generate"]).trim().to_owned();
    let (mut server, mut client, _) = recover(folder.path(), &key).await;
    let mut load = Load::set_up(&client).await;
    let (mut kills, mut statuses, mut memory_mb) = (0, std::collections::BTreeMap::new(), Vec::new());
    while Instant::now() < deadline {
        let (clients, mut resident) = (vec![client.clone(); FUSING_CLIENTS], Vec::new());
        let fusing = futures_util::future::join_all(clients.iter().map(fuse));
        let life = LIFE.min(deadline.saturating_duration_since(Instant::now())).max(Duration::from_secs(2));
        tokio::join!(load.run(&client), fusing, watch(&mut server, life, &mut resident));
        for (status, count) in client.statuses() {
            *statuses.entry(status).or_insert(0) += count;
        }
        assert_eq!(server.log_lines("panicked"), Vec::<String>::new());
        kills += 1;
        memory_mb.push(resident);
        (server, client, _) = recover(folder.path(), &key).await;
        findings.add(check(folder.path(), &mut load));
        check_revoked(&client, &load, &mut findings).await;
    }
    println!("{kills} kills, {} acknowledged steps; answers by status: {statuses:?}", load.acknowledged());
    for resident in &memory_mb {
        let last = resident.len().saturating_sub(1);
        let at = [0, last / 2, last].map(|index| resident.get(index).copied().unwrap_or_default());
        println!("resident memory at the start, in the middle, at the end of a life: {at:.0?} MB");
    }
    assert!(findings.lost.is_empty() && findings.inconsistent.is_empty(), "{findings:?}");
    assert_eq!(statuses.get(&500), None, "{statuses:?}");
    assert!(
        statuses[&200] > 0 && statuses.contains_key(&503),
        "it was loaded beyond its limit: {statuses:?}"
    );
    assert!(server.terminate(), "it ends in order");
}
