//! Events with numbers, of which the latest are kept: readers continue after any of these, and one that is too
//! slow loses the oldest.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::sync::lock;

/// The latest events of one source.
pub(super) struct EventLog<T> {
    events: Mutex<VecDeque<Arc<T>>>,
    capacity: usize,
    /// Number of the latest event, from 1; 0 before the first.
    latest: watch::Sender<u64>,
}

impl<T> EventLog<T> {
    pub(super) fn new(capacity: usize) -> Self {
        Self { events: Mutex::new(VecDeque::new()), capacity: capacity.max(1), latest: watch::channel(0).0 }
    }

    pub(super) fn push(&self, event: T) {
        let mut events = lock(&self.events);
        if events.len() >= self.capacity {
            events.pop_front();
        }
        events.push_back(Arc::new(event));
        self.latest.send_modify(|latest| *latest += 1);
    }

    /// Number of the latest event; 0 before the first.
    pub(super) fn latest(&self) -> u64 {
        *self.latest.borrow()
    }

    /// A reader after an event; number 0 begins at the oldest that is kept.
    pub(super) fn reader(self: &Arc<Self>, after: u64) -> EventReader<T> {
        let after = after.min(self.latest());
        EventReader { latest: self.latest.subscribe(), log: self.clone(), after }
    }
}

/// The next event of a reader.
pub(super) enum NextEvent<T> {
    /// An event with its number.
    Event(u64, Arc<T>),
    /// Number of events after the reader's place that are not kept any more, and the number of the last of them.
    Lost(u64, u64),
}

/// A place in an [`EventLog`].
pub(super) struct EventReader<T> {
    log: Arc<EventLog<T>>,
    after: u64,
    latest: watch::Receiver<u64>,
}

impl<T> EventReader<T> {
    /// The next event, or how many were lost before it. Cancelling the wait loses nothing.
    pub(super) async fn next(&mut self) -> NextEvent<T> {
        loop {
            if let Some(next) = self.read() {
                return next;
            }
            if self.latest.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    fn read(&mut self) -> Option<NextEvent<T>> {
        let events = lock(&self.log.events);
        // The number changes under the lock, so both fit.
        let latest = *self.latest.borrow_and_update();
        let oldest = latest + 1 - events.len() as u64;
        if self.after >= latest {
            return None;
        }
        let next = self.after + 1;
        if next < oldest {
            self.after = oldest - 1;
            return Some(NextEvent::Lost(oldest - next, oldest - 1));
        }
        let event = events.get((next - oldest) as usize)?.clone();
        self.after = next;
        Some(NextEvent::Event(next, event))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn read(reader: &mut EventReader<u32>) -> (u64, Option<u32>) {
        match reader.next().await {
            NextEvent::Event(number, event) => (number, Some(*event)),
            NextEvent::Lost(lost, _) => (lost, None),
        }
    }

    #[tokio::test]
    async fn a_reader_continues_behind_any_event_that_is_kept_and_is_told_of_others() {
        let log = Arc::new(EventLog::new(3));
        let mut from_the_start = log.reader(0);
        for event in 1..=5 {
            log.push(event * 10);
        }
        assert_eq!(read(&mut from_the_start).await, (2, None), "events 1 and 2 are gone");
        assert_eq!(read(&mut from_the_start).await, (3, Some(30)));
        let mut resumed = log.reader(4);
        assert_eq!(read(&mut resumed).await, (5, Some(50)));
        let mut ahead = log.reader(99);
        log.push(60);
        assert_eq!(read(&mut ahead).await, (6, Some(60)), "a number that was never given is the latest");
        assert_eq!(read(&mut resumed).await, (6, Some(60)));
    }

    #[tokio::test]
    async fn a_waiting_reader_is_woken() {
        let log = Arc::new(EventLog::new(3));
        let mut reader = log.reader(0);
        let pushing = log.clone();
        let (next, ()) = tokio::join!(read(&mut reader), async move { pushing.push(7) });
        assert_eq!(next, (1, Some(7)));
    }
}
