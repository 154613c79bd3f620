//! The latest events of one camera, for readers that come back.
//!
//! Events are numbered while somebody listens, and for some time after, so that a reader whose connection broke
//! misses none. What never happens here: a writer waits for readers, memory grows with the time that a reader is
//! away.

use std::collections::VecDeque;
use std::fmt;
use std::str::FromStr;
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use tokio::sync::watch;

use super::sync::lock;

/// Events that a reader may lag behind, or be away for, before it loses some.
const CAPACITY: usize = 1_024;
/// How long events are kept without a reader.
const KEPT_WITHOUT_READER: Duration = Duration::from_secs(60);

/// Name of an event: of its log, and its number there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EventId {
    log: u64,
    number: u64,
}

impl EventId {
    /// The id of no event.
    pub const UNKNOWN: Self = Self { log: 0, number: 0 };
}

impl fmt::Display for EventId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:016x}-{}", self.log, self.number)
    }
}

impl FromStr for EventId {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let (log, number) = text.split_once('-').ok_or(())?;
        let log = u64::from_str_radix(log, 16).map_err(drop)?;
        Ok(Self { log, number: number.parse().map_err(drop)? })
    }
}

/// Events that were lost because the reader was too slow, or away for too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LostEvents {
    /// Their number; `None` where it is not known, since the server was restarted or did not keep them.
    pub count: Option<u64>,
    /// The event before the next one.
    pub id: EventId,
}

/// The latest events.
pub(super) struct EventLog<E> {
    /// Tells the logs of two runs of the server apart.
    id: u64,
    ring: Mutex<Ring<E>>,
    /// The number after that of the latest event.
    end: watch::Sender<u64>,
}

struct Ring<E> {
    /// Number of the oldest event.
    first: u64,
    /// Of the events before this number it is not known how many there were.
    known_from: u64,
    events: VecDeque<E>,
    /// Reading of the monotonic clock up to which events are kept although nobody listens.
    kept_until: Option<Duration>,
}

impl<E: Clone> EventLog<E> {
    pub(super) fn new(id: u64) -> Self {
        let ring = Ring { first: 1, known_from: 1, events: VecDeque::new(), kept_until: None };
        Self { id, ring: Mutex::new(ring), end: watch::channel(1).0 }
    }

    /// Adds an event, which is made only if somebody listens, or may come back.
    pub(super) fn push(&self, now: Duration, event: impl FnOnce() -> E) {
        let mut ring = self.ring();
        if self.end.receiver_count() > 0 {
            ring.kept_until = Some(now + KEPT_WITHOUT_READER);
        }
        if ring.kept_until.is_none_or(|until| until < now) {
            ring.forget();
            return;
        }
        if ring.events.len() == CAPACITY {
            ring.events.pop_front();
            ring.first += 1;
        }
        ring.events.push_back(event());
        self.end.send_replace(ring.end());
    }

    /// A place in the log: behind the last event that the reader has seen, else at the end.
    pub(super) fn reader(&self, last_seen: Option<EventId>) -> EventCursor {
        let ring = self.ring();
        let end = ring.end();
        let next = match last_seen {
            None => Next::Event(end),
            Some(seen) if seen.log == self.id && (seen.number < end) => Next::Event(seen.number + 1),
            Some(_) => Next::Unknown(end),
        };
        EventCursor { next, end: self.end.subscribe() }
    }

    /// The event at a place, and the place behind it; `None` if it has not happened yet.
    pub(super) fn next(&self, cursor: &mut EventCursor) -> Option<Result<(EventId, E), LostEvents>> {
        let ring = self.ring();
        let id = |number| EventId { log: self.id, number };
        let number = match cursor.next {
            Next::Unknown(end) => {
                cursor.next = Next::Event(end.max(ring.first));
                return Some(Err(LostEvents { count: None, id: id(end.max(ring.first) - 1) }));
            }
            Next::Event(number) => number,
        };
        if number < ring.first {
            cursor.next = Next::Event(ring.first);
            let count = (number >= ring.known_from).then(|| ring.first - number);
            return Some(Err(LostEvents { count, id: id(ring.first - 1) }));
        }
        let event = ring.events.get(usize::try_from(number - ring.first).ok()?)?;
        cursor.next = Next::Event(number + 1);
        Some(Ok((id(number), event.clone())))
    }

    fn ring(&self) -> MutexGuard<'_, Ring<E>> {
        lock(&self.ring)
    }
}

impl<E> Ring<E> {
    fn end(&self) -> u64 {
        self.first + self.events.len() as u64
    }

    /// Drops all events. One number stays unused, so that a reader who comes back later learns that it has
    /// missed some.
    fn forget(&mut self) {
        if !self.events.is_empty() {
            self.first = self.end() + 1;
            self.known_from = self.first;
            self.events.clear();
        }
    }
}

/// A reader's place in a log.
pub(super) struct EventCursor {
    next: Next,
    end: watch::Receiver<u64>,
}

#[derive(Clone, Copy)]
enum Next {
    Event(u64),
    /// The reader has seen another log; it goes on with the event of this number.
    Unknown(u64),
}

impl EventCursor {
    /// Waits until there may be another event.
    pub(super) async fn changed(&mut self) {
        if self.end.changed().await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// All that a reader gets now.
    fn read(log: &EventLog<u32>, cursor: &mut EventCursor) -> Vec<Result<u32, Option<u64>>> {
        let next = || log.next(cursor).map(|it| it.map(|(_, event)| event).map_err(|lost| lost.count));
        std::iter::from_fn(next).collect()
    }

    fn last_id(log: &EventLog<u32>, cursor: &mut EventCursor) -> EventId {
        let ids = std::iter::from_fn(|| log.next(cursor)).map(|it| it.expect("not lost").0);
        ids.last().expect("one event or more")
    }

    #[test]
    fn a_reader_that_comes_back_misses_nothing_within_the_ring() {
        let log = EventLog::new(7);
        let mut reader = log.reader(None);
        (0..3).for_each(|event| log.push(SECOND, || event));
        let seen = last_id(&log, &mut reader);
        assert_eq!(seen.to_string(), "0000000000000007-3");
        drop(reader);
        (3..5).for_each(|event| log.push(2 * SECOND, || event));
        let mut again = log.reader(Some(seen));
        assert_eq!(read(&log, &mut again), [Ok(3), Ok(4)]);
        assert_eq!(read(&log, &mut log.reader(None)), [], "who comes anew begins with what happens now");
    }

    #[test]
    fn what_is_lost_is_counted_where_it_can_be() {
        let log = EventLog::new(7);
        let mut reader = log.reader(None);
        log.push(SECOND, || 0);
        let seen = last_id(&log, &mut reader);
        (0..CAPACITY as u32 + 2).for_each(|event| log.push(SECOND, || event));
        let events = read(&log, &mut log.reader(Some(seen)));
        assert_eq!((events[0], events.len()), (Err(Some(2)), CAPACITY + 1));
        let of_another_run = EventId { log: 8, number: 1 };
        assert_eq!(read(&log, &mut log.reader(Some(of_another_run))), [Err(None)]);
        let ahead = EventId { log: 7, number: 1 << 40 };
        assert_eq!(read(&log, &mut log.reader(Some(ahead))), [Err(None)]);
    }

    #[test]
    fn nothing_is_kept_for_long_without_a_reader() {
        let log = EventLog::new(7);
        log.push(SECOND, || unreachable!("nobody has ever listened"));
        let mut reader = log.reader(None);
        log.push(SECOND, || 1);
        let seen = last_id(&log, &mut reader);
        drop(reader);
        log.push(61 * SECOND, || 2);
        log.push(62 * SECOND, || unreachable!("the last reader left a minute ago"));
        assert_eq!(read(&log, &mut log.reader(Some(seen))), [Err(None)]);
    }

    #[test]
    fn what_is_no_id_is_none() {
        for text in ["", "ended", "x-1", "1-", "-1", "0000000000000007-x"] {
            assert!(text.parse::<EventId>().is_err(), "{text}");
        }
    }
}
