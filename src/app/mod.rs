//! The use cases, without a transport: both REST and gRPC call these and nothing below them.
//!
//! What never happens here: SQL, status codes, wire formats, reading the wall clock.

mod cameras;
mod evaluations;
mod fusion;
mod live;
mod models;
mod paired_import;
mod recording;
mod registry;
mod samples;
mod training;

use std::sync::Arc;

use tokio::sync::{Notify, Semaphore};

use crate::admission::Quotas;
use crate::clock::{Clock, Randomness};
use crate::config::Limits;
use crate::store::Store;
use crate::telemetry::Metrics;

pub use evaluations::{DEFAULT_TEST_SHARE, EvaluationRequest};
pub use live::{CameraEvent, Followed, LiveStream, Moves, TrackPoint};
pub use models::GnssErrorEstimate;
pub use paired_import::{PairedImport, PairedReport};
pub use recording::{PairingCounts, Part, Recording, RecordingLimits, RejectedParts, of_part};
pub use registry::Registry;
pub use samples::{ImportReport, RejectedRow};
pub use training::RunRequest;

/// The application: everything a request needs, cheap to clone.
#[derive(Clone)]
pub struct App(Arc<Parts>);

/// What an [`App`] is made of.
pub struct Parts {
    /// Everything that lasts.
    pub store: Store,
    /// Profiles and active models, ready to answer.
    pub registry: Registry,
    /// Tracks, streams and the watch on the cameras.
    pub live: live::Live,
    /// What time it is.
    pub clock: Clock,
    /// Ids and seeds.
    pub randomness: Randomness,
    /// What an outside client may make large.
    pub limits: Limits,
    /// How much of each bounded resource clients may hold at a time.
    pub quotas: Quotas,
    /// Counters and times.
    pub metrics: Metrics,
    /// Places for recordings that are paired in memory.
    pub pairings: Semaphore,
    /// Rung when a run was queued, so that a worker need not wait for its next look.
    pub run_queued: Notify,
    /// The same of evaluations.
    pub evaluation_queued: Notify,
}

impl App {
    /// An application over an opened store, its registry filled.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn new(
        store: Store,
        clock: Clock,
        randomness: Randomness,
        limits: Limits,
        metrics: Metrics,
    ) -> crate::domain::Result<Self> {
        let registry = Registry::default();
        registry.refresh(&store).await?;
        let (run_queued, pairings) = (Notify::new(), Semaphore::new(limits.pairings));
        let live = live::Live::default();
        let evaluation_queued = Notify::new();
        let quotas = Quotas::new(&limits);
        let parts = Parts {
            store,
            registry,
            live,
            clock,
            randomness,
            limits,
            quotas,
            metrics,
            pairings,
            run_queued,
            evaluation_queued,
        };
        Ok(Self(Arc::new(parts)))
    }
}

impl std::ops::Deref for App {
    type Target = Parts;

    fn deref(&self) -> &Parts {
        &self.0
    }
}

/// One page of a list, and the cursor behind which the next begins.
#[derive(Debug, Clone)]
pub struct Page<T, C> {
    /// The items, in the list's order.
    pub items: Vec<T>,
    /// Where the next page begins; `None` on the last.
    pub next: Option<C>,
}

/// Cuts a page from one item more than it holds.
fn page_of<T, C>(mut items: Vec<T>, limit: u32, cursor: impl Fn(&T) -> C) -> Page<T, C> {
    let limit = limit as usize;
    let more = items.len() > limit;
    items.truncate(limit);
    let next = if more { items.last().map(cursor) } else { None };
    Page { items, next }
}
