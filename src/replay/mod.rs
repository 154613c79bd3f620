//! Recorded items streamed to a server as one or many cameras would: the load tool, and the example
//! of a client that loses nothing on a broken line.
//!
//! Each simulated camera is one task with one stream: it takes [`feed`] items when they are due, keeps
//! them in its [`buffer`] until the server need not see them again, and after a broken line waits
//! ([`backoff`]), opens another stream and sends from the last acknowledgement on. What never happens
//! here: files, flags, unbounded memory, randomness without a seed.
//!
//! [`feed`]: Feed
//! [`buffer`]: Buffer
//! [`backoff`]: Backoff

mod backoff;
mod buffer;
mod camera;
mod faults;
mod feed;
mod latency;
mod recording;
mod report;

use std::num::NonZeroU64;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use jiff::SignedDuration;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio_util::sync::CancellationToken;

use crate::domain::CameraId;
use crate::grpc::client::{ClientError, Connection};
use backoff::Backoff;
use buffer::Buffer;
use camera::{Line, SimulatedCamera};
use faults::Faults;
use feed::{Feed, Turns};

pub use faults::FaultShares;
pub use feed::Pace;
pub use latency::Latencies;
pub use recording::{FixesOf, Recording};
pub use report::{Report, Tally};

/// Streams that share an HTTP/2 connection; servers allow some hundred, 256 by default.
const STREAMS_PER_CONNECTION: usize = 128;

/// What to replay where, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// Address of the server, such as `http://127.0.0.1:8080`.
    pub server: String,
    /// The server's cameras. Simulated ones are dealt to them in turn; where several share one, their
    /// targets get a number behind their id, so that they are others.
    pub camera_ids: Vec<CameraId>,
    /// Simulated cameras, each with a stream of its own.
    pub cameras: usize,
    /// The streams' client names begin with it; the camera's number follows.
    pub client_name: String,
    /// When items are sent.
    pub pace: Pace,
    /// Passes over the recording; each later in time than the one before.
    pub passes: NonZeroU64,
    /// No item is sent after this time; then `passes` no longer counts.
    pub duration: Option<Duration>,
    /// Added to every item's time.
    pub shift: SignedDuration,
    /// Items sent and not answered yet, per camera.
    pub in_flight: usize,
    /// Items kept to be sent again, per camera; when it is full nothing new is sent.
    pub kept: usize,
    /// Whether the items become training samples and must be acknowledged.
    pub store_samples: bool,
    /// What goes wrong on purpose before items are sent.
    pub faults: FaultShares,
    /// Of faults, waits and beginnings.
    pub seed: u64,
    /// Attempts in a row to open a stream again, without an answer in between, until a camera gives up.
    pub attempts: u32,
    /// A server that owes something and is silent for this long counts as gone.
    pub patience: Duration,
}

/// How far all cameras have come, for whoever watches.
#[derive(Debug, Default)]
pub struct Live {
    /// Items sent, each counted once.
    pub items: AtomicU64,
    /// Items answered for the first time.
    pub answered: AtomicU64,
    /// Streams open now.
    pub streams: AtomicU64,
}

impl Live {
    fn add(counter: &AtomicU64, more: u64) {
        counter.fetch_add(more, Ordering::Relaxed);
    }

    fn subtract(counter: &AtomicU64, less: u64) {
        counter.fetch_sub(less, Ordering::Relaxed);
    }
}

/// Replays a recording; ends when every camera has ended. After `stop` nothing new is sent and the
/// streams end in order.
///
/// # Errors
/// An address that is none. All else is in the report.
pub async fn replay(
    recording: Arc<Recording>,
    options: Arc<Options>,
    live: Arc<Live>,
    stop: CancellationToken,
) -> Result<Report, ClientError> {
    let connections = options.cameras.div_ceil(STREAMS_PER_CONNECTION).max(1);
    let connections: Vec<_> =
        (0..connections).map(|_| Connection::to(&options.server)).collect::<Result<_, _>>()?;
    let begin = Instant::now();
    let cameras = (0..options.cameras).map(|number| {
        let line = Line { connection: connections[number % connections.len()].clone(), live: live.clone() };
        let camera = camera(number, recording.clone(), &options, line, begin);
        tokio::spawn(camera.run(stop.clone()))
    });
    let mut tally = Tally::default();
    for ended in join_all(cameras.collect::<Vec<_>>()).await {
        match ended {
            Ok(camera) => tally.add(camera),
            Err(panic) => tally.give_up(&ClientError::broken_line(&panic.to_string())),
        }
    }
    Ok(Report::new(tally, options.cameras, begin.elapsed(), options.store_samples))
}

/// One simulated camera, everything random in it from streams of its own.
fn camera(
    number: usize,
    recording: Arc<Recording>,
    options: &Arc<Options>,
    line: Line,
    begin: Instant,
) -> SimulatedCamera {
    let random = |purpose: u64| {
        let mut random = ChaCha8Rng::seed_from_u64(options.seed);
        random.set_stream(number as u64 * 4 + purpose);
        random
    };
    let passes = if options.duration.is_some() { u64::MAX } else { options.passes.get() };
    let turns = Faults::new(Turns::new(recording.len(), passes), options.faults, random(0));
    // Cameras that begin together would send every item at the same instant, as no real ones do.
    let wait = match options.cameras {
        1 => Duration::ZERO,
        _ => options.pace.first_wait(&recording, &mut random(1)),
    };
    let until = options.duration.map(|duration| begin + duration);
    let feed = Feed::new(recording, turns, options.pace, begin + wait, until);
    let buffer = Buffer::new(options.kept, options.store_samples);
    SimulatedCamera::new(
        number,
        options.clone(),
        feed,
        buffer,
        Backoff::new(options.attempts, random(2)),
        line,
    )
}
