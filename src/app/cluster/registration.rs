//! How long this process may count on being registered.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::domain::NodeId;

/// A registration of this process. Instants are readings of its monotonic clock.
pub(super) struct Registration {
    pub(super) id: NodeId,
    /// In nanoseconds; from then on another node may have ended the registration.
    valid_until_ns: AtomicU64,
}

impl Registration {
    pub(super) fn new(id: NodeId, valid_until: Duration) -> Self {
        Self { id, valid_until_ns: AtomicU64::new(as_ns(valid_until)) }
    }

    /// True if the node certainly still owns what it owned.
    pub(super) fn is_valid(&self, now: Duration) -> bool {
        as_ns(now) < self.valid_until_ns.load(Ordering::Acquire)
    }

    /// How long it surely lasts without another renewal; `None` once it may have ended.
    pub(super) fn time_left(&self, now: Duration) -> Option<Duration> {
        let left = self.valid_until_ns.load(Ordering::Acquire).checked_sub(as_ns(now))?;
        (left > 0).then(|| Duration::from_nanos(left))
    }

    pub(super) fn extend(&self, valid_until: Duration) {
        self.valid_until_ns.store(as_ns(valid_until), Ordering::Release);
    }

    /// Ends it for good; whether it had not been ended before.
    pub(super) fn invalidate(&self) -> bool {
        self.valid_until_ns.swap(0, Ordering::AcqRel) != 0
    }
}

pub(super) fn as_ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
