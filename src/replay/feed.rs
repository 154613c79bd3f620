//! Which item is next, and when it is due.

use std::iter::Peekable;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{Rng, RngExt as _};

use super::faults::{FaultCounts, Faults};
use super::recording::Recording;

/// When items are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// As they were recorded, so many times faster.
    Recorded {
        /// 1 is real time.
        speed: f64,
    },
    /// So many a second and camera, whatever their times say.
    Even {
        /// Items per second.
        items_per_s: f64,
    },
    /// As soon as the window of items in flight has room.
    FastAsItGoes,
}

impl Pace {
    /// A random part of one interval.
    pub(super) fn first_wait(self, recording: &Recording, random: &mut impl Rng) -> Duration {
        let interval_s = match self {
            Self::Recorded { speed } => recording.interval().as_secs_f64() / speed,
            Self::Even { items_per_s } => items_per_s.recip(),
            Self::FastAsItGoes => 0.0,
        };
        seconds(interval_s * random.random::<f64>())
    }
}

/// A duration of that many seconds; nothing for less than none.
fn seconds(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(Duration::MAX)
}

/// One item of the recording in one of the passes over it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Turn {
    pub(super) row: usize,
    pub(super) pass: u64,
}

/// All rows of all passes.
#[derive(Debug)]
pub(super) struct Turns {
    next: Turn,
    rows: usize,
    passes: u64,
}

impl Turns {
    pub(super) const fn new(rows: usize, passes: u64) -> Self {
        Self { next: Turn { row: 0, pass: 0 }, rows, passes }
    }
}

impl Iterator for Turns {
    type Item = Turn;

    fn next(&mut self) -> Option<Turn> {
        if self.rows == 0 || self.next.pass >= self.passes {
            return None;
        }
        let turn = self.next;
        self.next = match turn.row + 1 {
            row if row < self.rows => Turn { row, ..turn },
            _ => Turn { row: 0, pass: turn.pass + 1 },
        };
        Some(turn)
    }
}

/// The items of one camera, each with the instant at which it is due.
#[derive(Debug)]
pub(super) struct Feed {
    pub(super) recording: Arc<Recording>,
    turns: Peekable<Counted>,
    pace: Pace,
    begin: Instant,
    until: Option<Instant>,
    taken: u64,
    /// Late items are due when their turn comes, so due times never fall.
    last_due: Instant,
    counts: FaultCounts,
}

/// Turns that carry along how many faults have happened so far.
#[derive(Debug)]
struct Counted(Faults<Turns>);

impl Iterator for Counted {
    type Item = (Turn, FaultCounts);

    fn next(&mut self) -> Option<Self::Item> {
        let turn = self.0.next()?;
        Some((turn, self.0.counts()))
    }
}

impl Feed {
    pub(super) fn new(
        recording: Arc<Recording>,
        turns: Faults<Turns>,
        pace: Pace,
        begin: Instant,
        until: Option<Instant>,
    ) -> Self {
        let turns = Counted(turns).peekable();
        let counts = FaultCounts::default();
        Self { recording, turns, pace, begin, until, taken: 0, last_due: begin, counts }
    }

    /// When the next item is due; `None` when there is none any more.
    pub(super) fn due(&mut self, now: Instant) -> Option<Instant> {
        let (turn, _) = *self.turns.peek()?;
        let after = match self.pace {
            Pace::Recorded { speed } => {
                seconds(self.recording.since_begin(turn.row, turn.pass).as_secs_f64() / speed)
            }
            Pace::Even { items_per_s } => seconds(self.taken as f64 / items_per_s),
            Pace::FastAsItGoes => Duration::ZERO,
        };
        let due = self.begin.checked_add(after)?.max(self.last_due);
        match self.until {
            Some(until) if due >= until || now >= until => None,
            _ => Some(due),
        }
    }

    /// Takes the next item.
    pub(super) fn take(&mut self, now: Instant) -> Option<Turn> {
        self.last_due = self.due(now)?;
        let (turn, counts) = self.turns.next()?;
        self.counts = counts;
        self.taken += 1;
        Some(turn)
    }

    /// Whether items are due at instants of their own.
    pub(super) fn is_paced(&self) -> bool {
        self.pace != Pace::FastAsItGoes
    }

    /// Faults among the items taken so far.
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

    fn feed(pace: Pace, shares: FaultShares, passes: u64, begin: Instant, until: Option<Instant>) -> Feed {
        let recording = Arc::new(recording(&[0.0, 1.0, 3.0]));
        let turns = Faults::new(Turns::new(recording.len(), passes), shares, ChaCha8Rng::seed_from_u64(3));
        Feed::new(recording, turns, pace, begin, until)
    }

    fn all_due_ms(mut feed: Feed, begin: Instant) -> Vec<u128> {
        std::iter::from_fn(|| {
            let due = feed.due(begin)?;
            feed.take(begin).expect("it is due");
            Some((due - begin).as_millis())
        })
        .collect()
    }

    #[test]
    fn items_are_due_as_recorded_or_evenly_or_at_once() {
        let begin = Instant::now();
        let due = |pace| all_due_ms(feed(pace, FaultShares::NONE, 2, begin, None), begin);
        // The second pass begins one mean interval (1.5 s) after the last item of the first.
        assert_eq!(due(Pace::Recorded { speed: 2.0 }), [0, 500, 1_500, 2_250, 2_750, 3_750]);
        assert_eq!(due(Pace::Even { items_per_s: 10.0 }), [0, 100, 200, 300, 400, 500]);
        assert_eq!(due(Pace::FastAsItGoes), [0; 6]);
    }

    #[test]
    fn late_items_do_not_turn_time_back() {
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
