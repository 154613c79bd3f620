//! Progress counters of a running replay.

use std::sync::atomic::{AtomicU64, Ordering};

/// Progress of all cameras, readable while a replay runs.
#[derive(Debug, Default)]
pub struct Counters {
    /// Items sent, each counted once.
    pub items: AtomicU64,
    /// Items answered, each counted once.
    pub answered: AtomicU64,
    /// Open streams.
    pub streams: AtomicU64,
}

impl Counters {
    pub(super) fn add(counter: &AtomicU64, increment: u64) {
        counter.fetch_add(increment, Ordering::Relaxed);
    }

    pub(super) fn subtract(counter: &AtomicU64, decrement: u64) {
        counter.fetch_sub(decrement, Ordering::Relaxed);
    }
}
