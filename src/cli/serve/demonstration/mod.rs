//! The demonstration: a simulated harbour whose cameras are created and trained like real ones. Its cameras, phones and
//! ship then send through the server's own port, in real time, and a display receives its events, until somebody ends it.

mod ais;
mod device;
mod display;
mod places;
mod scenes;

use std::collections::BTreeMap;
use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroU64;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use futures_util::StreamExt as _;
use futures_util::future::{BoxFuture, join_all};
use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use self::device::{Source, phone_message, report_forever, ship_message};
use self::display::receive_forever;
use self::scenes::{
    Identities, PERIOD_S, Scene, items, phone_reports, ramp, samples, ship_reports, square, training_site,
    yard,
};
use crate::app::{App, ConnectionRequest, DemonstrationParts, RunRequest};
use crate::cli::progress::Progress;
use crate::clock::Clock;
use crate::doctor::reachable;
use crate::domain::{
    CameraId, ConnectionId, Durability, ErrorKind, GnssError, JobState, LiveItem, NewCamera, NewSite,
    Picture, PictureFormat, PlaceId, Recipe, RunId, SampleFilter, SigmaM, SiteId, StoredSample, TrackScope,
};
use crate::exchange::ConnectionDraft;
use crate::replay::{Counters, FaultShares, Pace, RecordedStream, ReplayOptions, replay};
use crate::simulation::{Still, simulate_site, site_stills};

/// The camera of the requests to try.
const CAMERA: &str = "demo";
const SITE: &str = "demo-square";
const PHONES: &str = "demo-phones";
const SHIP: &str = "demo-ship";
const DISPLAY: &str = "demo-display";

/// Time that the ramp has recorded when the demonstration begins, so that it learns within the next minute.
const RECORDED: Duration = Duration::from_secs(420);

fn scenes() -> [Scene; 3] {
    [square(), yard(), ramp()]
}

/// Fills the data folder if it is empty, lets targets move if `moves`, trains the cameras, and prints requests to try.
pub(super) async fn show(app: &App, address: SocketAddr, moves: bool) -> anyhow::Result<()> {
    if app.cameras().list(None, None, 1).await?.items.is_empty() {
        create(app).await?;
    }
    let id = CameraId::new(CAMERA)?;
    app.cameras().get(&id).await.context("the data folder holds other cameras; choose an empty one")?;
    if moves {
        // Targets with a fix move before the first camera is trained.
        let app = app.clone();
        tokio::spawn(async move {
            if let Err(error) = run(&app, address, Clock::system().now()).await {
                tracing::error!(%error, "the targets of the demonstration do not move");
            }
        });
    }
    train(app).await?;
    let samples = app.samples().list(&id, &SampleFilter::default(), None, 1).await?.items;
    let sample = samples.into_iter().next().context("the camera of the demonstration has no sample")?;
    // A closed standard output must not stop the server.
    let _ = writeln!(std::io::stdout(), "{}", requests_to_try(address, &sample));
    Ok(())
}

/// Creates the cameras with what they are trained on, the site of the square, and the sources of phones and ship.
async fn create(app: &App) -> anyhow::Result<()> {
    let site = SiteId::new(SITE)?;
    app.sites().create(NewSite { display_name: "Square".to_owned(), ..NewSite::named(site.clone()) }).await?;
    for scene in scenes() {
        let is_square = scene.identities == Identities::Phones;
        let seen = training_site(&scene);
        let pictures = site_stills(&scene.options);
        for (((id, name), samples), picture) in scene.cameras.iter().zip(samples(&seen)).zip(pictures) {
            let id = CameraId::new(id)?;
            let camera = NewCamera {
                display_name: (*name).to_owned(),
                image_size: Some(seen.image_size),
                gnss_error: GnssError::Known(SigmaM::new(scene.options.gnss_sigma_m)?),
                location: Some(scene.options.origin),
                recipe: Recipe::Projective,
                labels: BTreeMap::from([("demonstration".to_owned(), "simulated".to_owned())]),
                retrain_when_moved: true,
                site: is_square.then(|| site.clone()),
                ..NewCamera::named(id.clone())
            };
            app.cameras().create(camera).await?;
            app.pictures().set(&id, Some(&Picture::new(PictureFormat::Png, png_file(&picture)?)?)).await?;
            if scene.is_trained {
                app.store.insert_samples(&id, samples, Durability::Synced).await?;
            }
        }
    }
    for (id, settings) in places::of_square(&square().options) {
        app.places().create(PlaceId::new(id)?, TrackScope::Site(site.clone()), &settings).await?;
    }
    let of_square: Vec<&str> = square().cameras.iter().map(|(id, _)| *id).collect();
    create_source(app, PHONES, "Phones", "phone", &of_square).await?;
    // Its site has the ship by one camera; matching it with the boxes of all would cost more than it shows.
    create_source(app, SHIP, "Ship with AIS", "nmea", &of_square[1..2]).await
}

async fn create_source(
    app: &App,
    id: &str,
    display_name: &str,
    format: &str,
    camera_ids: &[&str],
) -> anyhow::Result<()> {
    let source = json!({ "address": "push:", "format": format, "camera_ids": camera_ids });
    create_connection(app, json!({ "id": id, "display_name": display_name, "source": source })).await
}

async fn create_connection(app: &App, draft: Value) -> anyhow::Result<()> {
    let draft: ConnectionDraft = serde_json::from_value(draft)?;
    app.connections().create(ConnectionRequest::try_from(draft)?).await?;
    Ok(())
}

fn png_file(still: &Still) -> anyhow::Result<Vec<u8>> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, still.width_px, still.height_px);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&still.rgb)?;
    writer.finish()?;
    Ok(file)
}

/// Trains the cameras that have no model yet, and do not learn by themselves.
async fn train(app: &App) -> anyhow::Result<()> {
    let mut runs = Vec::new();
    for (id, _) in scenes().iter().filter(|scene| scene.is_trained).flat_map(|scene| scene.cameras) {
        let id = CameraId::new(id)?;
        if app.cameras().get(&id).await?.active_model.is_none() {
            let run = app.training().start(&id, RunRequest::default(), None).await?.id;
            runs.push((id, run));
        }
    }
    let mut progress = Progress::new("training the demonstration {bar:40} {pos}/{len}");
    for (number, (id, run)) in runs.iter().enumerate() {
        progress.set(number as u64, runs.len() as u64, "cameras of the demonstration are trained");
        trained(app, id, *run).await?;
    }
    progress.finish();
    Ok(())
}

/// Waits for a training run.
async fn trained(app: &App, id: &CameraId, run: RunId) -> anyhow::Result<()> {
    let mut changes = std::pin::pin!(app.training().watch(id, run).await?);
    while let Some(run) = changes.next().await {
        let run = run?;
        anyhow::ensure!(
            !run.state.has_ended() || run.state == JobState::Succeeded,
            "the training run of {id} ended: {}",
            run.outcome.unwrap_or_default()
        );
    }
    Ok(())
}

/// Creates the sink of the display, which listens at another port each time.
async fn create_display(app: &App, address: SocketAddr) -> anyhow::Result<()> {
    let id = ConnectionId::new(DISPLAY)?;
    if let Err(error) = app.connections().delete(&id, None).await {
        anyhow::ensure!(error.kind() == ErrorKind::ConnectionNotFound, error);
    }
    let sink =
        json!({ "address": format!("http://{address}"), "content": "place_events", "site_ids": [SITE] });
    create_connection(app, json!({ "id": DISPLAY, "display_name": "Display at the quay", "sink": sink }))
        .await
}

/// Sends what cameras, phones and ship of the simulation measure, in real time, until the demonstration is ended.
///
/// # Errors
/// A recording that is empty, or an address that is none; the display's port or connection cannot be made.
async fn run(app: &App, address: SocketAddr, now: Timestamp) -> anyhow::Result<()> {
    // Phones report whole seconds.
    let now = Timestamp::from_second(now.as_second())?;
    let address = reachable(address);
    let display = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await?;
    create_display(app, display.local_addr()?).await?;
    let mut feeds: Vec<BoxFuture<'_, ()>> = vec![Box::pin(receive_forever(display))];
    for scene in scenes() {
        let site = simulate_site(&scene.options);
        for ((id, _), items) in scene.cameras.iter().zip(items(&scene, &site)) {
            feeds.push(Box::pin(stream(
                address,
                CameraId::new(id)?,
                recording(&scene, items)?,
                scene.identities,
                now,
            )));
        }
        if scene.identities == Identities::Phones {
            let phones = Source { address, connection: ConnectionId::new(PHONES)? };
            feeds.push(Box::pin(report_forever(phones, phone_reports(&scene, &site), now, phone_message)));
            let ship = Source { address, connection: ConnectionId::new(SHIP)? };
            feeds.push(Box::pin(report_forever(ship, ship_reports(&scene), now, ship_message)));
        }
    }
    let stop = app.demonstration.begin(parts()?);
    stop.run_until_cancelled(join_all(feeds)).await;
    Ok(())
}

/// The parts that the end of the demonstration removes.
fn parts() -> anyhow::Result<DemonstrationParts> {
    let cameras = scenes().into_iter().flat_map(|scene| scene.cameras);
    let cameras = cameras.map(|(id, _)| CameraId::new(id)).collect::<Result<_, _>>()?;
    let connections = [PHONES, SHIP, DISPLAY].map(ConnectionId::new).into_iter().collect::<Result<_, _>>()?;
    Ok(DemonstrationParts { cameras, sites: vec![SiteId::new(SITE)?], connections })
}

fn recording(scene: &Scene, items: Vec<LiveItem>) -> anyhow::Result<RecordedStream> {
    let period = SignedDuration::from_secs(PERIOD_S.into());
    let interval = SignedDuration::from_secs_f64(scene.options.frame_interval_s);
    Ok(RecordedStream::periodic(items, scene.options.start, period, interval)?)
}

/// Streams the recording of one camera again and again.
async fn stream(
    address: SocketAddr,
    camera: CameraId,
    recording: RecordedStream,
    identities: Identities,
    begin: Timestamp,
) {
    let head_start = if identities == Identities::Receivers { RECORDED } else { Duration::ZERO };
    let options = ReplayOptions {
        server: format!("http://{address}"),
        key: None,
        camera_ids: vec![camera],
        cameras: 1,
        client_name: "demonstration".to_owned(),
        pace: Pace::Recorded { speed: 1.0 },
        head_start,
        repetitions: NonZeroU64::MAX,
        duration: None,
        shift: begin.duration_since(recording.first())
            - SignedDuration::try_from(head_start).unwrap_or_default(),
        in_flight: 64,
        resend_buffer: 1_024,
        store_samples: identities == Identities::Targets,
        faults: FaultShares::NONE,
        seed: 1,
        attempts: 12,
        response_timeout: Duration::from_secs(30),
    };
    let (counters, stop) = (Arc::new(Counters::default()), CancellationToken::new());
    if let Err(error) = replay(Arc::new(recording), Arc::new(options), counters, stop).await {
        tracing::error!(%error, "a camera of the demonstration does not stream");
    }
}

fn requests_to_try(address: SocketAddr, sample: &StoredSample) -> String {
    let [left_px, top_px, width_px, height_px] = sample.bounding_box.sides_px();
    let fix = sample.fix.map_or_else(String::new, |fix| {
        let position = fix.position;
        format!(
            r#","fix":{{"longitude_deg":{:.7},"latitude_deg":{:.7}}}"#,
            position.longitude_deg(),
            position.latitude_deg()
        )
    });
    let observation = format!(
        r#"{{"time":"{}","bounding_box":{{"left_px":{left_px:.1},"top_px":{top_px:.1},"width_px":{width_px:.1},"height_px":{height_px:.1}}}{fix}}}"#,
        sample.time,
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
