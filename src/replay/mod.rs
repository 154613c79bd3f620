//! Replays recorded items to a server as one or many cameras: a load generator, and a reference client
//! that loses nothing when a connection breaks.
//!
//! Each simulated camera is one task with one stream. It takes items from its [`PacedFeed`] when they
//! are due and holds them in its [`ResendBuffer`] until they are done; after a failure it waits
//! ([`Backoff`]), opens another stream, at the node that the server names if it names one, and resumes after the
//! last acknowledgement.
//! Does not use files, flags, unbounded memory or randomness without a seed.

mod fault_injection;
mod latency_histogram;
mod nodes;
mod options;
mod paced_feed;
mod progress;
mod recording;
mod report;
mod resend_buffer;
mod simulated_camera;

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio_util::sync::CancellationToken;

use crate::backoff::Backoff;
use crate::grpc::client::{ClientError, Connection};
use fault_injection::FaultInjector;
use nodes::NodeConnections;
use paced_feed::{PacedFeed, ReplaySchedule};
use report::Counts;
use resend_buffer::ResendBuffer;
use simulated_camera::{Link, SimulatedCamera};

pub use fault_injection::FaultShares;
pub use options::ReplayOptions;
pub use paced_feed::Pace;
pub use progress::Counters;
pub use recording::{FixOwner, RecordedStream};
pub use report::ReplayReport;

/// Streams that share an HTTP/2 connection; servers commonly allow 256 or fewer.
const STREAMS_PER_CONNECTION: usize = 128;

/// Replays a recording; returns when every camera has finished. After `stop` no new item is sent and
/// the streams are closed in order.
///
/// # Errors
/// An invalid address. All other errors are in the report.
pub async fn replay(
    recording: Arc<RecordedStream>,
    options: Arc<ReplayOptions>,
    counters: Arc<Counters>,
    stop: CancellationToken,
) -> Result<ReplayReport, ClientError> {
    let connections = options.cameras.div_ceil(STREAMS_PER_CONNECTION).max(1);
    let connections: Vec<_> = (0..connections)
        .map(|_| {
            let server = Connection::to(&options.server, options.key.as_ref())?;
            Ok((server, Arc::new(NodeConnections::default())))
        })
        .collect::<Result<_, ClientError>>()?;
    let started = Instant::now();
    let cameras = (0..options.cameras).map(|number| {
        let (server, nodes) = connections[number % connections.len()].clone();
        let link = Link { server, nodes, counters: counters.clone() };
        let camera = simulated_camera(number, recording.clone(), &options, link, started);
        tokio::spawn(camera.run(stop.clone()))
    });
    let mut totals = Counts::default();
    for finished in join_all(cameras.collect::<Vec<_>>()).await {
        match finished {
            Ok(counts) => totals.add(counts),
            Err(panic) => totals.record_give_up(&ClientError::broken_line(&panic.to_string())),
        }
    }
    Ok(ReplayReport::new(totals, options.cameras, started.elapsed(), options.store_samples))
}

/// One simulated camera with its own random streams.
fn simulated_camera(
    number: usize,
    recording: Arc<RecordedStream>,
    options: &Arc<ReplayOptions>,
    link: Link,
    started: Instant,
) -> SimulatedCamera {
    let random = |purpose: u64| {
        let mut random = ChaCha8Rng::seed_from_u64(options.seed);
        random.set_stream(number as u64 * 4 + purpose);
        random
    };
    let repetitions = if options.duration.is_some() { u64::MAX } else { options.repetitions.get() };
    let items =
        FaultInjector::new(ReplaySchedule::new(recording.len(), repetitions), options.faults, random(0));
    // Without an initial delay all cameras would send every item at the same instant.
    let delay = match options.cameras {
        1 => Duration::ZERO,
        _ => options.pace.initial_delay(&recording, &mut random(1)),
    };
    let until = options.duration.map(|duration| started + duration);
    let begin = (started + delay).checked_sub(options.head_start).unwrap_or(started);
    let feed = PacedFeed::new(recording, items, options.pace, begin, until);
    let buffer = ResendBuffer::new(options.resend_buffer, options.store_samples);
    SimulatedCamera::new(
        number,
        options.clone(),
        feed,
        buffer,
        Backoff::new(options.attempts, random(2)),
        link,
    )
}
