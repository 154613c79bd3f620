//! Progress counters of a running replay.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Progress of all cameras, readable while a replay runs.
#[derive(Debug, Default)]
pub struct Counters {
    /// Items sent, each counted once.
    pub items: AtomicU64,
    /// Items answered, each counted once.
    pub answered: AtomicU64,
    pub streams: AtomicU64,
    /// Why the latest stream broke, or could not be opened; `None` while streams are open.
    fault: Mutex<Option<String>>,
}

impl Counters {
    /// Why the latest stream broke, or could not be opened; `None` once one is open.
    #[must_use]
    pub fn fault(&self) -> Option<String> {
        self.fault.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn set_fault(&self, fault: Option<String>) {
        *self.fault.lock().unwrap_or_else(PoisonError::into_inner) = fault;
    }

    pub(super) fn add(counter: &AtomicU64, increment: u64) {
        counter.fetch_add(increment, Ordering::Relaxed);
    }

    pub(super) fn subtract(counter: &AtomicU64, decrement: u64) {
        counter.fetch_sub(decrement, Ordering::Relaxed);
    }
}
