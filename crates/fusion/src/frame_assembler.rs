//! From single items of many sources to frames in the order of their times.
//!
//! A frame is what one source reports for one instant. A frame is released when no earlier one can come from the
//! sources that are active: each has reported a later instant, or the frame has waited as long as it may. This is
//! the watermark of stream processing (Akidau et al., The Dataflow Model, 2015) with idle sources left out. A
//! frame older than one that was released is late and dropped, but for sources that set no pace: their items come
//! with delays of their own, and are released out of order while these are short.

use std::collections::{BTreeMap, HashMap};
use std::hash::Hash;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

/// If only late items come for this long, the clock of the sources went back for good: a recording is played
/// again. Frames are then released from there on.
const REWIND_AFTER: Duration = Duration::from_secs(5);

/// How long frames wait, and how much is held.
#[derive(Debug, Clone, Copy)]
pub struct FrameLimits {
    /// Longest time that a frame waits for the rest of its items and for earlier frames; a source without an item
    /// for this long is idle, and no frame waits for it.
    pub wait: Duration,
    /// Time by which an item of a source that sets no pace may be older than the latest frame that was released.
    pub lateness: SignedDuration,
    /// Most frames that wait; beyond, the oldest is released.
    pub frames: usize,
    /// Most items of one frame; beyond, they are dropped.
    pub items_per_frame: usize,
}

/// The outcome of a push.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PushOutcome {
    /// Part of a frame that waits.
    Waiting,
    /// Its frame, or a later one, was released before. A source that sets no pace has the lateness of the limits.
    Late,
    /// Its frame is full.
    FrameFull,
}

/// The items of one source at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct AssembledFrame<S, T> {
    /// The source.
    pub source: S,
    /// The instant.
    pub time: Timestamp,
    /// In the order in which they came; at least one.
    pub items: Vec<T>,
}

/// Frames that wait. Readings of the monotonic clock are handed in.
#[derive(Debug)]
pub struct FrameAssembler<S, T> {
    limits: FrameLimits,
    waiting: BTreeMap<(Timestamp, S), WaitingFrame<T>>,
    /// Sources whose times other frames wait for.
    pacing: HashMap<S, SourceClock>,
    /// Time of the latest frame that was released, and the sources whose frame of that time was.
    released: Option<(Timestamp, Vec<S>)>,
    /// Since when only late items come.
    late_since: Option<Duration>,
}

#[derive(Debug)]
struct WaitingFrame<T> {
    items: Vec<T>,
    since: Duration,
}

#[derive(Debug, Clone, Copy)]
struct SourceClock {
    latest: Timestamp,
    last_item_at: Duration,
}

impl<S: Clone + Ord + Hash, T> FrameAssembler<S, T> {
    /// Without any frame.
    #[must_use]
    pub fn new(limits: FrameLimits) -> Self {
        Self { limits, waiting: BTreeMap::new(), pacing: HashMap::new(), released: None, late_since: None }
    }

    /// Takes an item of a source. Frames of all sources wait for the times of those that are `pacing`: sources
    /// with regular, prompt items.
    pub fn push(
        &mut self,
        source: &S,
        is_pacing: bool,
        time: Timestamp,
        item: T,
        now: Duration,
    ) -> PushOutcome {
        let lateness = if is_pacing { SignedDuration::ZERO } else { self.limits.lateness };
        if self.is_late(source, time, lateness) {
            if now.saturating_sub(*self.late_since.get_or_insert(now)) < REWIND_AFTER {
                return PushOutcome::Late;
            }
            // Frames that wait are of the time before the sources went back.
            *self = Self::new(self.limits);
        }
        self.late_since = None;
        if is_pacing {
            let clock = SourceClock { latest: time, last_item_at: now };
            let clock_of_source = self.pacing.entry(source.clone()).or_insert(clock);
            *clock_of_source = SourceClock { latest: clock_of_source.latest.max(time), last_item_at: now };
        }
        let frame = self
            .waiting
            .entry((time, source.clone()))
            .or_insert_with(|| WaitingFrame { items: Vec::new(), since: now });
        if frame.items.len() >= self.limits.items_per_frame {
            return PushOutcome::FrameFull;
        }
        frame.items.push(item);
        PushOutcome::Waiting
    }

    fn is_late(&self, source: &S, time: Timestamp, lateness: SignedDuration) -> bool {
        self.released.as_ref().is_some_and(|(released, sources)| {
            released.duration_since(time) > lateness || (time == *released && sources.contains(source))
        })
    }

    /// The next frame that waits for nothing any more, in the order of times.
    pub fn release(&mut self, now: Duration) -> Option<AssembledFrame<S, T>> {
        let wait = self.limits.wait;
        self.pacing.retain(|_, clock| now.saturating_sub(clock.last_item_at) < wait);
        let ((time, source), frame) = self.waiting.first_key_value()?;
        let has_passed = |(pacing, clock): (&S, &SourceClock)| {
            // Items of the same frame come one after the other, so a source's own frame is open until its next.
            clock.latest > *time || (clock.latest == *time && pacing != source)
        };
        let has_waited = now.saturating_sub(frame.since) >= wait;
        let is_within_limit = self.waiting.len() <= self.limits.frames;
        if !has_waited && is_within_limit && !self.pacing.iter().all(has_passed) {
            return None;
        }
        let ((time, source), frame) = self.waiting.pop_first()?;
        match &mut self.released {
            Some((released, _)) if *released > time => {}
            Some((released, sources)) if *released == time => sources.push(source.clone()),
            released => *released = Some((time, vec![source.clone()])),
        }
        Some(AssembledFrame { source, time, items: frame.items })
    }

    /// True if no frame waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: FrameLimits = FrameLimits {
        wait: Duration::from_millis(300),
        lateness: SignedDuration::from_secs(1),
        frames: 8,
        items_per_frame: 3,
    };

    type Assembler = FrameAssembler<&'static str, u32>;

    fn at(ms: i64) -> Timestamp {
        Timestamp::from_millisecond(ms).expect("in range")
    }

    fn push(frames: &mut Assembler, source: &'static str, ms: i64, item: u32, now_ms: u64) -> PushOutcome {
        frames.push(&source, true, at(ms), item, Duration::from_millis(now_ms))
    }

    /// Source, time in ms and items of everything that is released.
    fn release(frames: &mut Assembler, now_ms: u64) -> Vec<(&'static str, i64, Vec<u32>)> {
        std::iter::from_fn(|| frames.release(Duration::from_millis(now_ms)))
            .map(|frame| (frame.source, frame.time.as_millisecond(), frame.items))
            .collect()
    }

    #[test]
    fn items_of_one_instant_are_one_frame_which_a_later_item_closes() {
        let mut frames = Assembler::new(LIMITS);
        push(&mut frames, "a", 100, 1, 0);
        push(&mut frames, "a", 100, 2, 1);
        assert!(release(&mut frames, 2).is_empty(), "more may come");
        push(&mut frames, "a", 200, 3, 100);
        assert_eq!(release(&mut frames, 100), [("a", 100, vec![1, 2])]);
        assert!(release(&mut frames, 399).is_empty());
        assert_eq!(release(&mut frames, 400), [("a", 200, vec![3])], "it has waited long enough");
        assert!(frames.is_empty());
    }

    #[test]
    fn a_frame_waits_for_slower_sources_but_not_for_idle_ones() {
        let mut frames = Assembler::new(LIMITS);
        push(&mut frames, "a", 100, 1, 0);
        push(&mut frames, "b", 40, 2, 0);
        push(&mut frames, "a", 200, 3, 100);
        assert!(release(&mut frames, 100).is_empty(), "b may have more of 40 ms");
        push(&mut frames, "b", 140, 4, 110);
        assert_eq!(release(&mut frames, 110), [("b", 40, vec![2]), ("a", 100, vec![1])], "in order of time");
        push(&mut frames, "a", 300, 5, 200);
        push(&mut frames, "a", 400, 6, 411);
        let released = release(&mut frames, 411);
        assert_eq!(released.len(), 3, "b is idle: {released:?}");
    }

    #[test]
    fn late_items_are_dropped_until_only_late_ones_come() {
        let mut frames = Assembler::new(LIMITS);
        push(&mut frames, "a", 10_000, 1, 0);
        assert_eq!(release(&mut frames, 300).len(), 1);
        assert_eq!(push(&mut frames, "a", 10_000, 2, 301), PushOutcome::Late, "its frame is gone");
        assert_eq!(push(&mut frames, "b", 10_000, 3, 301), PushOutcome::Waiting, "another source's is not");
        assert_eq!(push(&mut frames, "a", 500, 4, 400), PushOutcome::Late);
        assert_eq!(push(&mut frames, "a", 600, 5, 5_399), PushOutcome::Late);
        assert_eq!(push(&mut frames, "a", 700, 6, 5_400), PushOutcome::Waiting, "the recording began again");
        assert_eq!(release(&mut frames, 5_700), [("a", 700, vec![6])]);
    }

    #[test]
    fn what_is_held_is_bounded() {
        let mut frames = Assembler::new(LIMITS);
        let outcomes: Vec<_> = (0..4).map(|item| push(&mut frames, "a", 100, item, 0)).collect();
        assert_eq!(outcomes[2..], [PushOutcome::Waiting, PushOutcome::FrameFull]);
        for frame in 0..9 {
            push(&mut frames, "b", 50, 0, 0);
            push(&mut frames, "a", 200 + frame, 0, 0);
        }
        assert_eq!(release(&mut frames, 0)[0], ("b", 50, vec![0, 0, 0]));
        assert!(frames.waiting.len() <= LIMITS.frames);
    }

    #[test]
    fn a_short_delay_of_a_source_that_sets_no_pace_does_no_harm() {
        let mut frames = Assembler::new(LIMITS);
        let fix =
            |frames: &mut Assembler, ms: i64| frames.push(&"receiver", false, at(ms), 9, Duration::ZERO);
        push(&mut frames, "a", 5_000, 1, 0);
        push(&mut frames, "a", 5_200, 2, 0);
        assert_eq!(release(&mut frames, 0), [("a", 5_000, vec![1])]);
        assert_eq!(fix(&mut frames, 4_000), PushOutcome::Waiting);
        assert_eq!(fix(&mut frames, 3_999), PushOutcome::Late);
        assert_eq!(release(&mut frames, 0), [("receiver", 4_000, vec![9])], "at once");
        assert_eq!(push(&mut frames, "b", 4_900, 3, 0), PushOutcome::Late, "cameras stay in order");
    }

    #[test]
    fn a_source_that_does_not_pace_holds_nothing_back() {
        let mut frames = Assembler::new(LIMITS);
        let now = Duration::ZERO;
        frames.push(&"receiver", false, at(50), 1, now);
        push(&mut frames, "a", 100, 2, 0);
        push(&mut frames, "a", 200, 3, 0);
        assert_eq!(release(&mut frames, 0), [("receiver", 50, vec![1]), ("a", 100, vec![2])]);
    }
}
