//! The queue between what reads a peer and what takes its messages: bounded in number and in bytes.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

/// Bytes that a message occupies besides its content.
const OVERHEAD_BYTES: usize = 128;

/// Bytes that one source may hold of what it has read and nobody has taken.
#[derive(Clone)]
pub(super) struct ByteBudget {
    free: Arc<Semaphore>,
    bytes: usize,
}

/// Bytes of a budget, free again when this is dropped.
pub(super) type HeldBytes = OwnedSemaphorePermit;

impl ByteBudget {
    pub(super) fn new(bytes: usize) -> Self {
        let bytes = bytes.clamp(1, u32::MAX as usize);
        Self { free: Arc::new(Semaphore::new(bytes)), bytes }
    }

    /// All of it.
    #[cfg(test)]
    pub(super) const fn bytes(&self) -> usize {
        self.bytes
    }

    /// The charge for a number of bytes: more than the whole budget waits for all of it.
    fn charge(&self, bytes: usize) -> u32 {
        u32::try_from(bytes.min(self.bytes)).unwrap_or(u32::MAX)
    }

    /// Returns the bytes, if that number is free now.
    pub(super) fn try_hold(&self, bytes: usize) -> Option<HeldBytes> {
        self.free.clone().try_acquire_many_owned(self.charge(bytes)).ok()
    }

    /// Returns the bytes, once that number is free.
    async fn hold(&self, bytes: usize) -> Option<HeldBytes> {
        self.free.clone().acquire_many_owned(self.charge(bytes)).await.ok()
    }
}

/// The end of a queue that messages are put into.
pub(super) struct Inlet<T> {
    queue: mpsc::Sender<(T, HeldBytes)>,
    budget: ByteBudget,
}

impl<T> Clone for Inlet<T> {
    fn clone(&self) -> Self {
        Self { queue: self.queue.clone(), budget: self.budget.clone() }
    }
}

impl<T> Inlet<T> {
    pub(super) const fn budget(&self) -> &ByteBudget {
        &self.budget
    }

    /// Puts in a message once there is space; `false` when nobody takes messages any more.
    pub(super) async fn put(&self, message: T, bytes: usize) -> bool {
        match self.budget.hold(bytes.saturating_add(OVERHEAD_BYTES)).await {
            Some(held) => self.queue.send((message, held)).await.is_ok(),
            None => false,
        }
    }

    /// Puts in a message if there is space now.
    pub(super) fn try_put(&self, message: T, bytes: usize) -> bool {
        let held = self.budget.try_hold(bytes.saturating_add(OVERHEAD_BYTES));
        held.is_some_and(|held| self.queue.try_send((message, held)).is_ok())
    }
}

/// The end of a queue that messages are taken from; each with the bytes that it holds.
pub(super) type Outlet<T> = mpsc::Receiver<(T, HeldBytes)>;

/// A queue with a limit of messages and of bytes.
pub(super) fn inbox<T>(messages: usize, bytes: usize) -> (Inlet<T>, Outlet<T>) {
    let (queue, outlet) = mpsc::channel(messages.max(1));
    (Inlet { queue, budget: ByteBudget::new(bytes) }, outlet)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_queue_holds_no_more_bytes_than_its_budget() {
        let (inlet, mut outlet) = inbox(100, 1_000);
        assert!(inlet.put("half", 500 - OVERHEAD_BYTES).await);
        assert!(!inlet.try_put("more than the rest", 501));
        assert!(inlet.try_put("the rest", 500 - OVERHEAD_BYTES));
        assert!(!inlet.try_put("one more", 0));
        let (message, held) = outlet.recv().await.expect("a message");
        assert_eq!(message, "half");
        assert!(!inlet.try_put("one more", 0), "it is held until it is taken");
        drop(held);
        assert!(inlet.try_put("one more", 0));
        // One that is larger than the budget comes alone instead of never.
        drop((outlet.recv().await, outlet.recv().await));
        assert!(inlet.try_put("large", 1 << 40) && !inlet.try_put("small", 1));
        drop(outlet);
        assert!(!inlet.put("nobody takes it", 1).await);
    }

    #[tokio::test]
    async fn a_queue_holds_no_more_messages_than_its_length() {
        let (inlet, _outlet) = inbox(2, 1 << 20);
        assert!(inlet.try_put(1, 1) && inlet.try_put(2, 1) && !inlet.try_put(3, 1));
    }
}
