//! `sightfix replay`

use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use clap::{Args, value_parser};
use jiff::SignedDuration;
use tokio_util::sync::CancellationToken;

use super::progress::Progress;
use super::{camera_id, format_of, open_file, receiver_id, runtime, target_id};
use crate::clock::Clock;
use crate::domain::{CameraId, ReceiverId, TargetId, TimeBounds};
use crate::exchange::{self, ObservedRow, RowRules};
use crate::replay::{FaultShares, FixesOf, Live, Options, Pace, Recording, Report, replay};

/// Between two looks at how far it has come.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Stream recorded boxes and fixes to a server, as one or many cameras
#[derive(Args)]
pub(super) struct Replay {
    /// Rows with boxes, fixes or both, as CSV, NDJSON or JSON, told by the ending
    #[arg(value_name = "FILE", required_unless_present = "detections")]
    file: Option<PathBuf>,
    /// Boxes and fixes recorded apart: the boxes
    #[arg(long, value_name = "FILE", requires = "fixes", conflicts_with = "file")]
    detections: Option<PathBuf>,
    /// ... and the fixes, merged with them by time
    #[arg(long, value_name = "FILE", requires = "detections")]
    fixes: Option<PathBuf>,
    /// Whose the fixes are that name no target; else the only target's
    #[arg(long, value_name = "ID", value_parser = target_id, requires = "fixes")]
    fix_target: Option<TargetId>,
    /// The receiver of the fixes that name no target; the camera's profile says whose it is
    #[arg(long, value_name = "ID", value_parser = receiver_id, requires = "fixes", conflicts_with = "fix_target")]
    receiver: Option<ReceiverId>,
    #[command(flatten)]
    to: To,
    #[command(flatten)]
    pacing: Pacing,
    #[command(flatten)]
    care: Care,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Where to.
#[derive(Args)]
struct To {
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080")]
    server: String,
    /// The server's camera; give it again for more, and simulated ones are dealt to them in turn
    #[arg(long = "camera", value_name = "ID", value_parser = camera_id, required_unless_present = "camera_prefix")]
    camera_ids: Vec<CameraId>,
    /// The server's cameras are PREFIX-1, PREFIX-2 and so on, one for each simulated one
    #[arg(long, value_name = "PREFIX", conflicts_with = "camera_ids")]
    camera_prefix: Option<String>,
    /// Simulated cameras, each with a stream of its own
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = value_parser!(u32).range(1..=100_000))]
    cameras: u32,
    /// What the streams' client names begin with; the camera's number follows
    #[arg(long, value_name = "NAME", default_value = "replay")]
    client_name: String,
}

/// When items are sent.
#[derive(Args)]
struct Pacing {
    /// Times faster than real time, or max: as fast as --in-flight lets it go
    #[arg(long, value_name = "N", default_value = "1", value_parser = speed)]
    speed: Pace,
    /// Items per second and camera instead, whatever their times say
    #[arg(long, value_name = "N", value_parser = rate, conflicts_with = "speed")]
    rate: Option<Pace>,
    /// Passes over the recording, each later in time than the one before
    #[arg(long, value_name = "N", default_value = "1")]
    repeat: NonZeroU64,
    /// Send nothing after so many seconds, and repeat the recording until then
    #[arg(long, value_name = "S", value_parser = value_parser!(u64).range(1..), conflicts_with = "repeat")]
    duration_s: Option<u64>,
    /// Move all times so that the last item's is now
    #[arg(long)]
    shift_to_now: bool,
    /// Items sent and not answered yet, per camera
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = value_parser!(u32).range(1..=100_000))]
    in_flight: u32,
}

/// What is kept, and what goes wrong.
#[derive(Args)]
struct Care {
    /// Have the items kept as training samples, and wait for their acknowledgement
    #[arg(long)]
    store_samples: bool,
    /// Items kept to be sent again after a broken line, per camera
    #[arg(long, value_name = "N", default_value_t = 8_192, value_parser = value_parser!(u32).range(1..=10_000_000))]
    keep: u32,
    /// Attempts in a row to open a stream again before giving up
    #[arg(long, value_name = "N", default_value_t = 12)]
    attempts: u32,
    /// A server that owes an answer and is silent for so many seconds counts as gone
    #[arg(long, value_name = "S", default_value_t = 30, value_parser = value_parser!(u64).range(1..=3_600))]
    patience_s: u64,
    /// Share of items to lose on purpose
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    lose: f64,
    /// Share of items to send twice on purpose
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    duplicate: f64,
    /// Share of items to send late on purpose
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    reorder: f64,
    /// Most items by which late and doubled ones come late
    #[arg(long, value_name = "N", default_value_t = FaultShares::NONE.latest, value_parser = value_parser!(u32).range(1..=1_000))]
    reorder_by: u32,
    /// Seed of all that goes wrong, of waits and of beginnings
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl Replay {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let now = Clock::system().now();
        let recording = self.recording(TimeBounds::at(now))?;
        let shift = match self.pacing.shift_to_now {
            true => recording.shift_to_end_at(now, self.pacing.repeat.get()),
            false => SignedDuration::ZERO,
        };
        let options = Options {
            server: self.to.server.clone(),
            camera_ids: self.to.camera_ids()?,
            cameras: self.to.cameras as usize,
            client_name: self.to.client_name.clone(),
            pace: self.pacing.rate.unwrap_or(self.pacing.speed),
            passes: self.pacing.repeat,
            duration: self.pacing.duration_s.map(Duration::from_secs),
            shift,
            in_flight: self.pacing.in_flight as usize,
            kept: self.care.keep.max(self.pacing.in_flight) as usize,
            store_samples: self.care.store_samples,
            faults: self.care.faults(),
            seed: self.care.seed,
            attempts: self.care.attempts,
            patience: Duration::from_secs(self.care.patience_s),
        };
        let report = runtime()?.block_on(watched(recording, options))?;
        if self.json {
            println!("{}", serde_json::to_string_pretty(&report)?);
        } else {
            print!("{report}");
        }
        anyhow::ensure!(report.is_complete(), "not every item was answered and acknowledged");
        Ok(())
    }

    fn recording(&self, time_bounds: TimeBounds) -> anyhow::Result<Recording> {
        let rules = RowRules { time_bounds, image_size: None };
        if let (Some(detections), Some(fixes)) = (&self.detections, &self.fixes) {
            let target = self.fix_target.clone().map(FixesOf::Target);
            let fixes_of = target.or_else(|| self.receiver.clone().map(FixesOf::Receiver));
            return Ok(Recording::of_both(rows(detections, &rules)?, rows(fixes, &rules)?, fixes_of)?);
        }
        let file = self.file.as_deref().unwrap_or_else(|| Path::new(""));
        Ok(Recording::of_rows(rows(file, &rules)?)?)
    }
}

impl To {
    fn camera_ids(&self) -> anyhow::Result<Vec<CameraId>> {
        match &self.camera_prefix {
            Some(prefix) => {
                (1..=self.cameras).map(|number| Ok(CameraId::new(&format!("{prefix}-{number}"))?)).collect()
            }
            None => Ok(self.camera_ids.clone()),
        }
    }
}

impl Care {
    const fn faults(&self) -> FaultShares {
        let Self { lose, duplicate, reorder, reorder_by: latest, .. } = *self;
        FaultShares { lose, duplicate, reorder, latest }
    }
}

/// The rows of a file; those that are none are told and left out.
fn rows(path: &Path, rules: &RowRules) -> anyhow::Result<Vec<ObservedRow>> {
    let mut good = Vec::new();
    for row in exchange::read_observations(open_file(path)?, format_of(path)?, rules)? {
        match row? {
            Ok(row) => good.push(row),
            Err(row) => eprintln!("{}: line {}: {}: {}", path.display(), row.line, row.field, row.reason),
        }
    }
    Ok(good)
}

/// Replays and shows how far it has come. An interrupt ends the streams in order, a second one at once.
async fn watched(recording: Recording, options: Options) -> anyhow::Result<Report> {
    let items = recording.len() as u64 * options.passes.get() * options.cameras as u64;
    let (begin, duration) = (Instant::now(), options.duration);
    let (live, stop) = (Arc::new(Live::default()), CancellationToken::new());
    let mut progress = Progress::new("{bar:40} {msg}");
    let replaying = replay(Arc::new(recording), Arc::new(options), live.clone(), stop.clone());
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
            () = tokio::time::sleep(LOOK_EVERY) => {
                let [sent, answered, streams] =
                    [&live.items, &live.answered, &live.streams].map(|count| count.load(Ordering::Relaxed));
                let words = format!("items, {sent} sent, {answered} answered, {streams} streams");
                match duration {
                    None => progress.set(answered, items, &words),
                    Some(whole) => progress.set(begin.elapsed().as_secs(), whole.as_secs(), &format!("s, {words}")),
                }
            }
        }
    }
}

fn speed(text: &str) -> Result<Pace, String> {
    match text {
        "max" => Ok(Pace::FastAsItGoes),
        _ => positive(text)
            .map(|speed| Pace::Recorded { speed })
            .ok_or_else(|| "must be a number above 0, or max".to_owned()),
    }
}

fn rate(text: &str) -> Result<Pace, String> {
    positive(text)
        .map(|items_per_s| Pace::Even { items_per_s })
        .ok_or_else(|| "must be a number above 0".to_owned())
}

fn positive(text: &str) -> Option<f64> {
    text.parse().ok().filter(|number| (1e-6..=1e9).contains(number))
}

fn share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=0.95).contains(share));
    share.ok_or_else(|| "must be a share from 0 to 0.95".to_owned())
}
