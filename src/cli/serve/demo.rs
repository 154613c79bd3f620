//! The demonstration: a simulated camera, created and trained like a real one, that then streams what it sees through the
//! server's own port.

use std::io::Write as _;
use std::net::SocketAddr;
use std::num::NonZeroU64;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use futures_util::StreamExt as _;
use jiff::Timestamp;
use tokio_util::sync::CancellationToken;

use crate::app::{App, RunRequest};
use crate::cli::progress::Progress;
use crate::doctor::reachable;
use crate::domain::{CameraId, Durability, GnssError, JobState, LiveItem, NewCamera, SigmaM};
use crate::replay::{Counters, FaultShares, Pace, RecordedStream, ReplayOptions, replay};
use crate::simulation::{Options, SimulatedRow, simulate};

const CAMERA: &str = "demo";

/// Targets that walk through the view while the server runs.
const TARGETS: usize = 8;
/// Rows of the walk, which then begins again.
const ROWS: usize = 20_000;
/// Number of targets that carry a phone.
const PHONES: usize = 2;
/// Every so often one phone loses GNSS, and its track goes on by the boxes alone.
const GNSS_LOSS_EVERY_S: i64 = 60;
const GNSS_LOSS_S: i64 = 20;

/// Fills the data folder if it is empty, trains the camera, and prints requests to try.
pub(super) async fn show(app: &App, address: SocketAddr) -> anyhow::Result<()> {
    let id = CameraId::new(CAMERA)?;
    let world = simulate(&Options::demo());
    if app.cameras().list(None, None, 1).await?.items.is_empty() {
        let sigma_m = SigmaM::new(world.gnss_sigma_m)?;
        app.cameras()
            .create(NewCamera {
                display_name: "Demonstration: a simulated square".to_owned(),
                image_size: Some(world.image_size),
                gnss_error: GnssError::Known(sigma_m),
                ..NewCamera::named(id.clone())
            })
            .await?;
        app.store.insert_samples(&id, world.training_samples(), Durability::Synced).await?;
    }
    let camera =
        app.cameras().get(&id).await.context("the data folder holds other cameras; choose an empty one")?;
    if camera.active_model.is_none() {
        train(app, &id).await?;
    }
    let row = world
        .rows
        .iter()
        .find(|row| row.bounding_box.is_some() && row.fix.is_some())
        .context("the simulation has no detected target")?;
    // A closed standard output must not stop the server.
    let _ = writeln!(std::io::stdout(), "{}", requests_to_try(address, row));
    Ok(())
}

async fn train(app: &App, id: &CameraId) -> anyhow::Result<()> {
    let run = app.training().start(id, RunRequest::default(), None).await?;
    let mut progress = Progress::new("training the demonstration {bar:40} {pos}/{len}");
    let mut changes = std::pin::pin!(app.training().watch(id, run.id).await?);
    while let Some(run) = changes.next().await {
        let run = run?;
        progress.set(run.progress.epoch.into(), run.progress.epochs.into(), "epochs of the demonstration");
        anyhow::ensure!(
            !run.state.has_ended() || run.state == JobState::Succeeded,
            "the demonstration's training run ended: {}",
            run.outcome.unwrap_or_default()
        );
    }
    progress.finish();
    Ok(())
}

/// Streams simulated targets to the server in real time, until it ends or its camera is deleted.
///
/// # Errors
/// A recording that is empty, or an address that is none.
pub(super) async fn walk(address: SocketAddr, now: Timestamp) -> anyhow::Result<()> {
    let world = simulate(&Options { targets: TARGETS, ..Options::demo().test(ROWS) });
    let first = world.rows.first().context("the simulation has no rows")?.time;
    let recording = RecordedStream::from_rows(world.rows.iter().filter_map(|row| observed(row, first)))?;
    let options = ReplayOptions {
        server: format!("http://{}", reachable(address)),
        key: None,
        camera_ids: vec![CameraId::new(CAMERA)?],
        cameras: 1,
        client_name: "demonstration".to_owned(),
        pace: Pace::Recorded { speed: 1.0 },
        repetitions: NonZeroU64::MAX,
        duration: None,
        shift: now.duration_since(first),
        in_flight: 64,
        resend_buffer: 1_024,
        store_samples: false,
        faults: FaultShares::NONE,
        seed: 1,
        attempts: 12,
        response_timeout: Duration::from_secs(30),
    };
    let (counters, stop) = (Arc::new(Counters::default()), CancellationToken::new());
    replay(Arc::new(recording), Arc::new(options), counters, stop).await?;
    Ok(())
}

/// The item of a row by camera and phones; `None` if nothing.
fn observed(row: &SimulatedRow, first: Timestamp) -> Option<LiveItem> {
    let elapsed_s = row.time.duration_since(first).as_secs();
    let is_denied = row.target == 0 && elapsed_s % GNSS_LOSS_EVERY_S >= GNSS_LOSS_EVERY_S - GNSS_LOSS_S;
    let fix = row.fix.filter(|_| row.target < PHONES && !is_denied);
    (row.bounding_box.is_some() || fix.is_some()).then(|| LiveItem {
        time: row.time,
        target_id: Some(row.target_id.clone()),
        tracker_id: None,
        receiver_id: None,
        bounding_box: row.bounding_box,
        fix,
        class: Some(row.class.clone()),
        score: None,
    })
}

fn requests_to_try(address: SocketAddr, row: &SimulatedRow) -> String {
    let (Some(bounding_box), Some(fix)) = (row.bounding_box, row.fix) else { return String::new() };
    let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
    let observation = format!(
        r#"{{"time":"{}","bounding_box":{{"left_px":{left_px:.1},"top_px":{top_px:.1},"width_px":{width_px:.1},"height_px":{height_px:.1}}},"fix":{{"longitude_deg":{:.7},"latitude_deg":{:.7}}}}}"#,
        row.time,
        fix.position.longitude_deg(),
        fix.position.latitude_deg(),
    );
    format!(
        "The camera `{CAMERA}` is ready. Three things to try:\n\n\
         1. Fuse a box and a fix:\n\n   \
         curl -s http://{address}/v1/cameras/{CAMERA}/fusions -H \"content-type: application/json\" -d '{observation}'\n\n\
         2. The same over gRPC:\n\n   \
         grpcurl -plaintext -d '{{\"camera_id\":\"{CAMERA}\",\"observations\":[{observation}]}}' {address} \
         sightfix.v1.FusionService/Fuse\n\n\
         3. See its targets move in the operator's console, and the description of the whole interface, in a browser:\n\n   \
         http://{address}/\n   \
         http://{address}/docs\n"
    )
}
