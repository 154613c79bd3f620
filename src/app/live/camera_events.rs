//! The latest events of one camera, for readers that come back.
//!
//! Events are kept while somebody listens, and for some time after, so that a reader whose connection broke misses
//! none. A writer does not wait for readers, and memory does not grow with the time that a reader is away.

use std::fmt;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use super::event_log::{EventLog, EventReader, NextEvent};
use super::sync::lock;

/// Latest events that are kept; a reader that is away for more events loses the oldest.
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

/// The log of a camera; another one begins whenever events were not kept.
pub(super) struct CameraEventLog<E>(Mutex<Kept<E>>);

struct Kept<E> {
    log: Arc<EventLog<E>>,
    /// Tells logs apart.
    id: u64,
    /// Reading of the monotonic clock up to which events are kept although nobody listens.
    until: Option<Duration>,
}

impl<E> CameraEventLog<E> {
    /// `id` is another number in every run of the server.
    pub(super) fn new(id: u64) -> Self {
        Self(Mutex::new(Kept { log: Arc::new(EventLog::new(CAPACITY)), id, until: None }))
    }

    /// Adds an event, which is made only if somebody listens, or may come back. `now` is a reading of the
    /// monotonic clock.
    pub(super) fn push(&self, now: Duration, event: impl FnOnce() -> E) {
        let mut kept = self.kept();
        if Arc::strong_count(&kept.log) > 1 {
            kept.until = Some(now + KEPT_WITHOUT_READER);
        }
        if kept.until.is_some_and(|until| now <= until) {
            kept.log.push(event());
        } else if kept.log.latest() > 0 {
            kept.log = Arc::new(EventLog::new(CAPACITY));
            kept.id = kept.id.wrapping_add(1);
        }
    }

    /// The place after the last event that the reader has seen, else at the end.
    pub(super) fn reader(&self, last_seen: Option<EventId>) -> CameraEventReader<E> {
        let kept = self.kept();
        let latest = kept.log.latest();
        let known = last_seen.filter(|seen| seen.log == kept.id && seen.number <= latest);
        let after = known.map_or(latest, |seen| seen.number);
        let lost = LostEvents { count: None, id: EventId { log: kept.id, number: after } };
        let unknown = last_seen.is_some() && known.is_none();
        CameraEventReader { reader: kept.log.reader(after), log: kept.id, lost: unknown.then_some(lost) }
    }

    fn kept(&self) -> MutexGuard<'_, Kept<E>> {
        lock(&self.0)
    }
}

/// A place in the events of a camera.
pub(super) struct CameraEventReader<E> {
    reader: EventReader<E>,
    log: u64,
    /// Reported before the first event.
    lost: Option<LostEvents>,
}

impl<E> CameraEventReader<E> {
    /// The next event, or how many were lost before it. Cancelling the wait loses nothing.
    pub(super) async fn next(&mut self) -> Result<(EventId, Arc<E>), LostEvents> {
        if let Some(lost) = self.lost.take() {
            return Err(lost);
        }
        let id = |number| EventId { log: self.log, number };
        match self.reader.next().await {
            NextEvent::Event(number, event) => Ok((id(number), event)),
            NextEvent::Lost(count, last) => Err(LostEvents { count: Some(count), id: id(last) }),
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    /// All that a reader gets now.
    fn read(reader: &mut CameraEventReader<u32>) -> Vec<Result<u32, Option<u64>>> {
        let next = || reader.next().now_or_never();
        std::iter::from_fn(next).map(|it| it.map(|(_, event)| *event).map_err(|lost| lost.count)).collect()
    }

    fn last_id(reader: &mut CameraEventReader<u32>) -> EventId {
        let ids = std::iter::from_fn(|| reader.next().now_or_never()).map(|it| it.expect("not lost").0);
        ids.last().expect("one event or more")
    }

    #[test]
    fn a_reader_that_comes_back_misses_nothing_that_is_kept() {
        let log = CameraEventLog::new(7);
        let mut reader = log.reader(None);
        (0..3).for_each(|event| log.push(SECOND, || event));
        let seen = last_id(&mut reader);
        assert_eq!(seen.to_string(), "0000000000000007-3");
        drop(reader);
        (3..5).for_each(|event| log.push(2 * SECOND, || event));
        assert_eq!(read(&mut log.reader(Some(seen))), [Ok(3), Ok(4)]);
        assert_eq!(read(&mut log.reader(None)), [], "a new reader begins with what happens now");
    }

    #[test]
    fn what_is_lost_is_counted_where_it_can_be() {
        let log = CameraEventLog::new(7);
        let mut reader = log.reader(None);
        log.push(SECOND, || 0);
        let seen = last_id(&mut reader);
        (0..CAPACITY as u32 + 2).for_each(|event| log.push(SECOND, || event));
        let events = read(&mut log.reader(Some(seen)));
        assert_eq!((events[0], events.len()), (Err(Some(2)), CAPACITY + 1));
        for unknown in [EventId { log: 8, number: 1 }, EventId { log: 7, number: 1 << 40 }, EventId::UNKNOWN]
        {
            assert_eq!(read(&mut log.reader(Some(unknown))), [Err(None)]);
        }
    }

    #[test]
    fn nothing_is_kept_for_long_without_a_reader() {
        let log = CameraEventLog::new(7);
        log.push(SECOND, || panic!("nobody has ever listened"));
        let mut reader = log.reader(None);
        log.push(SECOND, || 1);
        let seen = last_id(&mut reader);
        drop(reader);
        log.push(61 * SECOND, || 2);
        log.push(62 * SECOND, || panic!("the last reader left a minute ago"));
        assert_eq!(read(&mut log.reader(Some(seen))), [Err(None)]);
    }

    #[test]
    fn what_is_no_id_is_none() {
        for text in ["", "ended", "x-1", "1-", "-1", "0000000000000007-x"] {
            assert!(text.parse::<EventId>().is_err(), "{text}");
        }
    }
}
