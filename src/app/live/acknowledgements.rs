//! The items that a stream has handed in, and those that are settled: stored, or known not to become a sample.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use tokio::sync::Notify;

use super::sync::lock;
use crate::domain::{Durability, Error, ErrorKind, Result};
use crate::fusion::pairing::ItemOutcome;

/// Why an item of a stream is not part of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotStoredReason {
    /// It names no target.
    NoTarget,
    /// It was answered with an error.
    Refused,
    /// No partner came within the pairing window.
    Unpaired,
    /// It came after the pairing of its instant had been decided.
    TooLate,
    /// A box or fix of the same target and instant was there before.
    Duplicate,
    /// It is a box with only a tracker's id, and its receiver is not sure enough.
    Unmatched,
}

impl NotStoredReason {
    const COUNT: usize = 6;
    const ALL: [Self; Self::COUNT] =
        [Self::NoTarget, Self::Refused, Self::Unpaired, Self::TooLate, Self::Duplicate, Self::Unmatched];
}

/// Items of a stream that are not part of a sample for one reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NotStored {
    pub reason: NotStoredReason,
    /// Number of them since the stream was opened.
    pub count: u64,
    /// The latest of them.
    pub last_seq: u64,
}

/// The acknowledgement of a stream's items.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Acknowledgement {
    /// Every item up to this seq is settled.
    pub seq: u64,
    /// Settled items that are part of a stored sample.
    pub stored: u64,
    /// Settled items that are not, by reason.
    pub not_stored: Vec<NotStored>,
}

/// The items of one stream that are not settled.
#[derive(Default)]
pub(super) struct AckTracker {
    state: Mutex<AckState>,
    changed: Notify,
    /// When the stream's samples are acknowledged.
    durability: Durability,
}

#[derive(Default)]
struct AckState {
    outstanding: BTreeSet<u64>,
    highest: u64,
    failed: Option<ErrorKind>,
    stored: u64,
    /// Count and latest seq, in the order of [`NotStoredReason::ALL`].
    not_stored: [(u64, u64); NotStoredReason::COUNT],
}

impl AckState {
    fn count_not_stored(&mut self, reason: NotStoredReason, seq: u64) {
        let (count, last_seq) = &mut self.not_stored[reason as usize];
        *count += 1;
        *last_seq = seq.max(*last_seq);
    }
}

impl AckTracker {
    pub(super) fn beginning_after(seq: u64, durability: Durability) -> Arc<Self> {
        let state = AckState { highest: seq, ..AckState::default() };
        Arc::new(Self { state: Mutex::new(state), changed: Notify::new(), durability })
    }

    pub(super) const fn durability(&self) -> Durability {
        self.durability
    }

    /// Settles an item of which nothing is stored; leaves one that was handed in already.
    pub(super) fn ack_without_storing(&self, seq: u64, reason: NotStoredReason) {
        let mut state = lock(&self.state);
        if seq > state.highest {
            state.highest = seq;
            state.count_not_stored(reason, seq);
        }
    }

    pub(super) fn pending(self: &Arc<Self>, seq: u64) -> PendingAck {
        let mut state = lock(&self.state);
        state.highest = state.highest.max(seq);
        state.outstanding.insert(seq);
        PendingAck { tracker: self.clone(), seq }
    }

    /// Returns the items that are settled.
    pub(super) fn acknowledgement(&self) -> Acknowledgement {
        let state = lock(&self.state);
        let not_stored = NotStoredReason::ALL.into_iter().zip(state.not_stored);
        Acknowledgement {
            seq: state.outstanding.first().map_or(state.highest, |first| first - 1),
            stored: state.stored,
            not_stored: not_stored
                .filter(|(_, (count, _))| *count > 0)
                .map(|(reason, (count, last_seq))| NotStored { reason, count, last_seq })
                .collect(),
        }
    }

    /// True if nothing is outstanding.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) fn is_settled(&self) -> Result<bool> {
        let state = lock(&self.state);
        match state.failed {
            None => Ok(state.outstanding.is_empty()),
            Some(kind) => Err(not_stored_error(kind)),
        }
    }

    /// Waits for a change since the last wait.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Waits until nothing is outstanding.
    ///
    /// # Errors
    /// The samples could not be committed.
    pub(super) async fn settled(&self) -> Result<()> {
        while !self.is_settled()? {
            self.changed().await;
        }
        Ok(())
    }

    /// Acknowledges nothing more. The first cause is kept.
    pub(super) fn fail(&self, kind: ErrorKind) -> Error {
        let kind = *lock(&self.state).failed.get_or_insert(kind);
        self.changed.notify_one();
        not_stored_error(kind)
    }
}

fn not_stored_error(kind: ErrorKind) -> Error {
    match kind {
        ErrorKind::CameraNotFound => Error::refused(kind, "the camera was deleted"),
        ErrorKind::InsufficientStorage => Error::refused(
            kind,
            "there is no space for more samples; open the stream again after the last acknowledged seq when \
             some has been freed",
        ),
        _ => Error::refused(
            ErrorKind::Overloaded,
            "samples could not be stored; open the stream again after the last acknowledged seq",
        ),
    }
}

/// One item of a stream that is not settled.
pub(super) struct PendingAck {
    tracker: Arc<AckTracker>,
    seq: u64,
}

impl PendingAck {
    /// Settles the item, after the commit of everything decided with it.
    pub(super) fn ack(self, outcome: ItemOutcome) {
        let reason = match outcome {
            ItemOutcome::Paired => None,
            ItemOutcome::Unpaired => Some(NotStoredReason::Unpaired),
            ItemOutcome::TooLate => Some(NotStoredReason::TooLate),
            ItemOutcome::Duplicate => Some(NotStoredReason::Duplicate),
        };
        {
            let mut state = lock(&self.tracker.state);
            state.outstanding.remove(&self.seq);
            match reason {
                None => state.stored += 1,
                Some(reason) => state.count_not_stored(reason, self.seq),
            }
        }
        self.tracker.changed.notify_one();
    }

    pub(super) fn fail(&self, kind: ErrorKind) {
        let _ = self.tracker.fail(kind);
    }

    /// The durability that the item's stream asks for.
    pub(super) fn durability(&self) -> Durability {
        self.tracker.durability
    }

    pub(super) fn belongs_to(&self, tracker: &Arc<AckTracker>) -> bool {
        Arc::ptr_eq(&self.tracker, tracker)
    }
}
