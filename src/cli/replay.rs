//! `sightfix replay`

use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::{Args, value_parser};
use jiff::SignedDuration;
use tokio_util::sync::CancellationToken;

use super::output::print_line;
use super::progress::Progress;
use super::rejected_rows::RejectedRows;
use super::{camera_id, files, receiver_id, runtime, target_id};
use crate::clock::Clock;
use crate::config::{Config, Overrides};
use crate::domain::{CameraId, KeySecret, LiveItem, ReceiverId, TargetId, TimeBounds};
use crate::exchange::{self, RowRules};
use crate::replay::{
    Counters, FaultShares, FixOwner, Pace, RecordedStream, ReplayOptions, ReplayReport, replay,
};

/// Interval of the progress display.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(200);

/// Stream recorded boxes and fixes to a server, as one or many cameras
#[derive(Args)]
pub(super) struct Replay {
    /// Rows with boxes, fixes or both, as CSV, NDJSON or JSON, by file extension; boxes may have a tracker_id and fixes a
    /// receiver_id instead of a target_id
    #[arg(value_name = "FILE", required_unless_present = "detections")]
    file: Option<PathBuf>,
    /// Boxes that were recorded separately from the fixes
    #[arg(long, value_name = "FILE", requires = "fixes", conflicts_with = "file")]
    detections: Option<PathBuf>,
    /// Fixes that were recorded separately, merged with the boxes by time
    #[arg(long, value_name = "FILE", requires = "detections")]
    fixes: Option<PathBuf>,
    /// Target of the fixes that name neither target nor receiver [default: the only target]
    #[arg(long, value_name = "ID", value_parser = target_id, requires = "fixes")]
    fix_target: Option<TargetId>,
    /// Receiver of the fixes that name neither; the camera's profile maps it to a target
    #[arg(long, value_name = "ID", value_parser = receiver_id, requires = "fixes", conflicts_with = "fix_target")]
    receiver: Option<ReceiverId>,
    #[command(flatten)]
    destination: Destination,
    #[command(flatten)]
    pacing: Pacing,
    #[command(flatten)]
    delivery: Delivery,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Server and cameras.
#[derive(Args)]
struct Destination {
    /// Address of the server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080")]
    server: String,
    /// File with the secret of the key to present; or set SIGHTFIX_API_KEY
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
    /// Camera of the server; repeat it for more, simulated cameras are assigned round robin
    #[arg(long = "camera", value_name = "ID", value_parser = camera_id, required_unless_present = "camera_prefix")]
    camera_ids: Vec<CameraId>,
    /// Cameras PREFIX-1, PREFIX-2 and so on of the server, one for each simulated camera
    #[arg(long, value_name = "PREFIX", conflicts_with = "camera_ids")]
    camera_prefix: Option<String>,
    /// Number of simulated cameras, each with its own stream
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = value_parser!(u32).range(1..=100_000))]
    cameras: u32,
    /// Prefix of the streams' client names; the simulated camera's number follows
    #[arg(long, value_name = "NAME", default_value = "replay")]
    client_name: String,
}

/// Timing.
#[derive(Args)]
struct Pacing {
    /// Speed relative to the recorded times, or max: as fast as --in-flight allows
    #[arg(long, value_name = "N", default_value = "1", value_parser = speed)]
    speed: Pace,
    /// Constant rate in items per second and camera, regardless of the recorded times
    #[arg(long, value_name = "N", value_parser = rate, conflicts_with = "speed")]
    rate: Option<Pace>,
    /// Repetitions of the recording, each shifted in time after the one before
    #[arg(long, value_name = "N", default_value = "1")]
    repeat: NonZeroU64,
    /// Repeat the recording for that many seconds
    #[arg(long, value_name = "S", value_parser = value_parser!(u64).range(1..), conflicts_with = "repeat")]
    duration_s: Option<u64>,
    /// Shift all times so that the last item is at the current time
    #[arg(long)]
    shift_to_now: bool,
    /// Largest number of unanswered items per camera
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = value_parser!(u32).range(1..=100_000))]
    in_flight: u32,
}

/// Delivery, retries and injected faults.
#[derive(Args)]
struct Delivery {
    /// Store the items as training samples, and wait for their acknowledgement
    #[arg(long)]
    store_samples: bool,
    /// Capacity per camera of the buffer of items to send again after a failure
    #[arg(long, value_name = "N", default_value_t = 8_192, value_parser = value_parser!(u32).range(1..=10_000_000))]
    keep: u32,
    /// Consecutive attempts to reconnect before giving up
    #[arg(long, value_name = "N", default_value_t = 12)]
    attempts: u32,
    /// Seconds without a due response after which the connection counts as broken
    #[arg(long, alias = "patience-s", value_name = "S", default_value_t = 30, value_parser = value_parser!(u64).range(1..=3_600))]
    response_timeout_s: u64,
    /// Share of items to lose
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    lose: f64,
    /// Share of items to send twice
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    duplicate: f64,
    /// Share of items to send late
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    reorder: f64,
    /// Largest delay of late and duplicated items, in items
    #[arg(long, value_name = "N", default_value_t = FaultShares::NONE.max_delay, value_parser = value_parser!(u32).range(1..=1_000))]
    reorder_by: u32,
    /// Seed of faults, backoff and initial delays
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl Replay {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let now = Clock::system().now();
        let recording = self.recording(TimeBounds::at(now))?;
        let shift = match self.pacing.shift_to_now {
            true => recording.shift_to_end_at(now, self.pacing.repeat.get()),
            false => SignedDuration::ZERO,
        };
        let options = ReplayOptions {
            server: self.destination.server.clone(),
            key: self.destination.key(file)?,
            camera_ids: self.destination.camera_ids()?,
            cameras: self.destination.cameras as usize,
            client_name: self.destination.client_name.clone(),
            pace: self.pacing.rate.unwrap_or(self.pacing.speed),
            head_start: Duration::ZERO,
            repetitions: self.pacing.repeat,
            duration: self.pacing.duration_s.map(Duration::from_secs),
            shift,
            in_flight: self.pacing.in_flight as usize,
            resend_buffer: self.delivery.keep.max(self.pacing.in_flight) as usize,
            store_samples: self.delivery.store_samples,
            faults: self.delivery.faults(),
            seed: self.delivery.seed,
            attempts: self.delivery.attempts,
            response_timeout: Duration::from_secs(self.delivery.response_timeout_s),
        };
        let server = &self.destination.server;
        let report = runtime()?.block_on(replay_with_progress(recording, options))?;
        if self.json {
            print_line(&format_args!("{}", serde_json::to_string_pretty(&report)?))?;
        } else {
            print_line(&format_args!("{}", report.to_string().trim_end()))?;
        }
        anyhow::ensure!(
            report.streams > 0,
            "no stream could be opened at {server}: is a server running there?"
        );
        anyhow::ensure!(report.is_complete(), "not every item was answered and acknowledged by {server}");
        Ok(())
    }

    fn recording(&self, time_bounds: TimeBounds) -> anyhow::Result<RecordedStream> {
        let rules = RowRules { time_bounds, image_size: None };
        if let (Some(detections), Some(fixes)) = (&self.detections, &self.fixes) {
            let target = self.fix_target.clone().map(FixOwner::Target);
            let fix_owner = target.or_else(|| self.receiver.clone().map(FixOwner::Receiver));
            return Ok(RecordedStream::from_detections_and_fixes(
                rows(detections, &rules)?,
                rows(fixes, &rules)?,
                fix_owner,
            )?);
        }
        let file = self.file.as_deref().unwrap_or_else(|| Path::new(""));
        Ok(RecordedStream::from_rows(rows(file, &rules)?)?)
    }
}

impl Destination {
    /// The key of the file, or of the setting `api_key`.
    fn key(&self, settings: Option<&Path>) -> anyhow::Result<Option<KeySecret>> {
        let secret = match &self.key_file {
            Some(path) => Some(
                std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?,
            ),
            None => {
                Config::load(settings, Overrides::default())?.api_key.map(|secret| secret.reveal().to_owned())
            }
        };
        Ok(secret.map(|secret| KeySecret::parse(secret.trim())).transpose()?)
    }

    fn camera_ids(&self) -> anyhow::Result<Vec<CameraId>> {
        match &self.camera_prefix {
            Some(prefix) => {
                (1..=self.cameras).map(|number| Ok(CameraId::new(&format!("{prefix}-{number}"))?)).collect()
            }
            None => Ok(self.camera_ids.clone()),
        }
    }
}

impl Delivery {
    const fn faults(&self) -> FaultShares {
        let Self { lose, duplicate, reorder, reorder_by: max_delay, .. } = *self;
        FaultShares { lose, duplicate, reorder, max_delay }
    }
}

/// The valid rows of a file; the others are reported on standard error and skipped.
fn rows(path: &Path, rules: &RowRules) -> anyhow::Result<Vec<LiveItem>> {
    let (mut valid, mut rejected) = (Vec::new(), RejectedRows::default());
    for row in exchange::read_live_items(files::open_input(path)?, files::format_of(path, None)?, rules)? {
        match row? {
            Ok(row) => valid.push(row),
            Err(row) => rejected.push(row),
        }
    }
    rejected.print(&format!("{}: ", path.display()));
    Ok(valid)
}

/// Replays and shows the progress. A first interrupt closes the streams in order, a second one aborts.
async fn replay_with_progress(
    recording: RecordedStream,
    options: ReplayOptions,
) -> anyhow::Result<ReplayReport> {
    let items = recording.len() as u64 * options.repetitions.get() * options.cameras as u64;
    let (started, duration, server) = (Instant::now(), options.duration, options.server.clone());
    let (counters, stop) = (Arc::new(Counters::default()), CancellationToken::new());
    let mut progress = Progress::new("{bar:40} {msg}");
    let replaying = replay(Arc::new(recording), Arc::new(options), counters.clone(), stop.clone());
    tokio::pin!(replaying);
    loop {
        tokio::select! {
            report = &mut replaying => {
                progress.finish();
                return Ok(report?);
            }
            interrupted = tokio::signal::ctrl_c() => {
                interrupted?;
                anyhow::ensure!(!stop.is_cancelled(), "interrupted");
                stop.cancel();
            }
            () = tokio::time::sleep(PROGRESS_INTERVAL) => {
                let [sent, answered, streams] =
                    [&counters.items, &counters.answered, &counters.streams].map(|count| count.load(Ordering::Relaxed));
                let message = match counters.fault() {
                    None => format!("items, {sent} sent, {answered} answered, {streams} streams"),
                    Some(fault) => format!("items, {answered} answered; trying {server} again: {fault}"),
                };
                match duration {
                    None => progress.set(answered, items, &message),
                    Some(total) => progress.set(started.elapsed().as_secs(), total.as_secs(), &format!("s, {message}")),
                }
            }
        }
    }
}

fn speed(text: &str) -> Result<Pace, String> {
    match text {
        "max" => Ok(Pace::Unpaced),
        _ => positive(text)
            .map(|speed| Pace::Recorded { speed })
            .ok_or_else(|| "must be a number above 0, or max".to_owned()),
    }
}

fn rate(text: &str) -> Result<Pace, String> {
    positive(text)
        .map(|items_per_s| Pace::ConstantRate { items_per_s })
        .ok_or_else(|| "must be a number above 0".to_owned())
}

fn positive(text: &str) -> Option<f64> {
    text.parse().ok().filter(|number| (1e-6..=1e9).contains(number))
}

fn share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=0.95).contains(share));
    share.ok_or_else(|| "must be a share from 0 to 0.95".to_owned())
}
