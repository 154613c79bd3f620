//! The items of one simulated camera in order, each with the time at which it is due.

use std::iter::Peekable;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{Rng, RngExt as _};

use super::fault_injection::{FaultCounts, FaultInjector};
use super::recording::RecordedStream;

/// When items are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// At the recorded intervals, divided by a speed.
    Recorded {
        /// 1 is real time.
        speed: f64,
    },
    /// At a constant rate per camera, regardless of the recorded times.
    ConstantRate {
        /// Items per second.
        items_per_s: f64,
    },
    /// As fast as the window of items in flight allows.
    Unpaced,
}

impl Pace {
    /// A random delay of up to one interval before the first item.
    pub(super) fn initial_delay(self, recording: &RecordedStream, random: &mut impl Rng) -> Duration {
        let interval_s = match self {
            Self::Recorded { speed } => recording.interval().as_secs_f64() / speed,
            Self::ConstantRate { items_per_s } => items_per_s.recip(),
            Self::Unpaced => 0.0,
        };
        seconds(interval_s * random.random::<f64>())
    }
}

/// A duration in seconds, at least 0.
fn seconds(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(Duration::MAX)
}

/// One item of the recording, in one repetition of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ScheduledItem {
    pub(super) row: usize,
    pub(super) repetition: u64,
}

/// All rows of all repetitions.
#[derive(Debug)]
pub(super) struct ReplaySchedule {
    next: ScheduledItem,
    rows: usize,
    repetitions: u64,
}

impl ReplaySchedule {
    pub(super) const fn new(rows: usize, repetitions: u64) -> Self {
        Self { next: ScheduledItem { row: 0, repetition: 0 }, rows, repetitions }
    }
}

impl Iterator for ReplaySchedule {
    type Item = ScheduledItem;

    fn next(&mut self) -> Option<ScheduledItem> {
        if self.rows == 0 || self.next.repetition >= self.repetitions {
            return None;
        }
        let item = self.next;
        self.next = match item.row + 1 {
            row if row < self.rows => ScheduledItem { row, ..item },
            _ => ScheduledItem { row: 0, repetition: item.repetition + 1 },
        };
        Some(item)
    }
}

/// Items with their due times.
#[derive(Debug)]
pub(super) struct PacedFeed {
    pub(super) recording: Arc<RecordedStream>,
    items: Peekable<CountedFaults>,
    pace: Pace,
    begin: Instant,
    until: Option<Instant>,
    taken: u64,
    /// Delayed items are due with those around them, so due times never decrease.
    last_due: Instant,
    counts: FaultCounts,
}

/// Pairs every item with the faults injected before it.
#[derive(Debug)]
struct CountedFaults(FaultInjector<ReplaySchedule>);

impl Iterator for CountedFaults {
    type Item = (ScheduledItem, FaultCounts);

    fn next(&mut self) -> Option<Self::Item> {
        let item = self.0.next()?;
        Some((item, self.0.counts()))
    }
}

impl PacedFeed {
    pub(super) fn new(
        recording: Arc<RecordedStream>,
        items: FaultInjector<ReplaySchedule>,
        pace: Pace,
        begin: Instant,
        until: Option<Instant>,
    ) -> Self {
        let items = CountedFaults(items).peekable();
        let counts = FaultCounts::default();
        Self { recording, items, pace, begin, until, taken: 0, last_due: begin, counts }
    }

    /// When the next item is due; `None` at the end.
    pub(super) fn due(&mut self, now: Instant) -> Option<Instant> {
        let (item, _) = *self.items.peek()?;
        let after = match self.pace {
            Pace::Recorded { speed } => {
                seconds(self.recording.since_begin(item.row, item.repetition).as_secs_f64() / speed)
            }
            Pace::ConstantRate { items_per_s } => seconds(self.taken as f64 / items_per_s),
            Pace::Unpaced => Duration::ZERO,
        };
        let due = self.begin.checked_add(after)?.max(self.last_due);
        match self.until {
            Some(until) if due >= until || now >= until => None,
            _ => Some(due),
        }
    }

    /// Takes the next item.
    pub(super) fn take(&mut self, now: Instant) -> Option<ScheduledItem> {
        self.last_due = self.due(now)?;
        let (item, counts) = self.items.next()?;
        self.counts = counts;
        self.taken += 1;
        Some(item)
    }

    /// True if items have due times.
    pub(super) fn is_paced(&self) -> bool {
        self.pace != Pace::Unpaced
    }

    /// Faults injected among the items taken so far.
    pub(super) const fn counts(&self) -> FaultCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::super::recording::tests::recording;
    use super::*;
    use crate::replay::FaultShares;

    fn feed(
        pace: Pace,
        shares: FaultShares,
        repetitions: u64,
        begin: Instant,
        until: Option<Instant>,
    ) -> PacedFeed {
        let recording = Arc::new(recording(&[0.0, 1.0, 3.0]));
        let items = FaultInjector::new(
            ReplaySchedule::new(recording.len(), repetitions),
            shares,
            ChaCha8Rng::seed_from_u64(3),
        );
        PacedFeed::new(recording, items, pace, begin, until)
    }

    fn all_due_ms(mut feed: PacedFeed, begin: Instant) -> Vec<u128> {
        std::iter::from_fn(|| {
            let due = feed.due(begin)?;
            feed.take(begin).expect("it is due");
            Some((due - begin).as_millis())
        })
        .collect()
    }

    #[test]
    fn items_are_due_as_recorded_or_at_a_constant_rate_or_at_once() {
        let begin = Instant::now();
        let due = |pace| all_due_ms(feed(pace, FaultShares::NONE, 2, begin, None), begin);
        // The second repetition begins one mean interval (1.5 s) after the last item of the first.
        assert_eq!(due(Pace::Recorded { speed: 2.0 }), [0, 500, 1_500, 2_250, 2_750, 3_750]);
        assert_eq!(due(Pace::ConstantRate { items_per_s: 10.0 }), [0, 100, 200, 300, 400, 500]);
        assert_eq!(due(Pace::Unpaced), [0; 6]);
    }

    #[test]
    fn due_times_of_delayed_items_do_not_decrease() {
        let begin = Instant::now();
        let shares = FaultShares { reorder: 0.5, ..FaultShares::NONE };
        let due = all_due_ms(feed(Pace::Recorded { speed: 1.0 }, shares, 20, begin, None), begin);
        assert_eq!(due.len(), 60);
        assert!(due.is_sorted(), "{due:?}");
    }

    #[test]
    fn a_duration_ends_the_feed() {
        let begin = Instant::now();
        let until = Some(begin + Duration::from_secs(4));
        let due =
            all_due_ms(feed(Pace::Recorded { speed: 1.0 }, FaultShares::NONE, u64::MAX, begin, until), begin);
        assert_eq!(due, [0, 1_000, 3_000]);
    }
}
