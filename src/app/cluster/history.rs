//! The actions of a node when the database continues from an earlier state than it has acknowledged, as after a
//! fail-over to a standby that had not received everything.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use jiff::Timestamp;

use super::Nodes;
use crate::app::live::sync::lock;
use crate::store::HistoryMark;

/// The history of what this process knows, compared with that of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatabaseHistory {
    /// The known state is of the database's history.
    Unbroken,
    /// It may not be, and is read again.
    Reading,
    /// Everything was read again after the history broke at this time.
    BrokenAt(Timestamp),
}

/// The history of the database as the renewals of this node have met it.
pub(super) struct HistoryWatch {
    mark: Mutex<HistoryMark>,
    breaks: AtomicU64,
    /// After how many breaks everything was read again.
    read_after: AtomicU64,
    broke_at: Mutex<Option<Timestamp>>,
}

impl HistoryWatch {
    pub(super) fn new(mark: HistoryMark) -> Self {
        let (breaks, read_after) = (AtomicU64::new(0), AtomicU64::new(0));
        Self { mark: Mutex::new(mark), breaks, read_after, broke_at: Mutex::default() }
    }

    /// Notes where a renewal was stored; whether what was acknowledged before may be lost.
    pub(super) fn observe(&self, nodes: Nodes<'_>, mark: HistoryMark) -> bool {
        let before = std::mem::replace(&mut *lock(&self.mark), mark.clone());
        let Some(reason) = mark.break_since(&before) else { return false };
        tracing::error!(
            reason,
            "the history of the database has changed: without synchronous replication what it acknowledged last is lost; \
             everything is read again"
        );
        nodes.metrics.database_history_broke();
        *lock(&self.broke_at) = Some(nodes.clock.now());
        self.breaks.fetch_add(1, Ordering::AcqRel);
        nodes.access.distrust();
        nodes.site_registry.distrust();
        nodes.registry.distrust();
        true
    }

    /// How often it broke.
    pub(super) fn breaks(&self) -> u64 {
        self.breaks.load(Ordering::Acquire)
    }

    /// Notes that everything was read again after this number of breaks.
    pub(super) fn has_read_after(&self, breaks: u64) {
        self.read_after.store(breaks, Ordering::Release);
    }

    pub(super) fn state(&self) -> DatabaseHistory {
        if self.breaks() != self.read_after.load(Ordering::Acquire) {
            return DatabaseHistory::Reading;
        }
        lock(&self.broke_at).map_or(DatabaseHistory::Unbroken, DatabaseHistory::BrokenAt)
    }
}
