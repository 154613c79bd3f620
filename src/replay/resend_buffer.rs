//! Buffers items until they need not be sent again.
//!
//! Assigns the sequence numbers (seq), from 1 without gaps. An item is done when it is answered; on a
//! stream that stores samples, when it is acknowledged and its answer on this stream has arrived. The
//! buffer never exceeds its limit.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::paced_feed::ScheduledItem;

/// An item that is not done.
#[derive(Debug, Clone, Copy)]
struct BufferedItem {
    item: ScheduledItem,
    /// When it was sent on this stream, until its answer arrives.
    awaited_since: Option<Instant>,
    /// True if it was sent on this or an earlier stream.
    sent: bool,
    /// True if its answer arrived or was dropped, on this or an earlier stream.
    answered: bool,
}

/// The items of one camera that are not done, and the position of the current stream among them.
#[derive(Debug)]
pub(super) struct ResendBuffer {
    items: VecDeque<BufferedItem>,
    limit: usize,
    must_acknowledge: bool,
    /// Seq of the first buffered item.
    first_seq: u64,
    /// Number of items at the front that were sent on this stream.
    sent: usize,
    /// Number of those that await their answer.
    awaited: usize,
    /// Highest acknowledged seq.
    acknowledged: u64,
    /// Items whose answers were dropped.
    lost: u64,
    /// Items that are done without an answer.
    unanswered: u64,
}

/// The effect of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Answered {
    /// Time since the item was sent on this stream.
    pub(super) latency: Duration,
    /// True if it is the item's first answer.
    pub(super) is_first: bool,
}

impl ResendBuffer {
    pub(super) const fn new(limit: usize, must_acknowledge: bool) -> Self {
        Self {
            items: VecDeque::new(),
            limit,
            must_acknowledge,
            first_seq: 1,
            sent: 0,
            awaited: 0,
            acknowledged: 0,
            lost: 0,
            unanswered: 0,
        }
    }

    /// True if all items are done.
    pub(super) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    pub(super) fn is_full(&self) -> bool {
        self.items.len() >= self.limit
    }

    /// Number of items sent on this stream that await their answer.
    pub(super) const fn awaited(&self) -> usize {
        self.awaited
    }

    /// The seq up to which all items are acknowledged, or answered if samples are not stored.
    pub(super) const fn resume_after(&self) -> u64 {
        if self.must_acknowledge { self.acknowledged } else { self.first_seq - 1 }
    }

    /// Number of seqs assigned.
    pub(super) fn assigned(&self) -> u64 {
        self.first_seq - 1 + self.items.len() as u64
    }

    /// Number of items not acknowledged.
    pub(super) fn unacknowledged(&self) -> u64 {
        self.assigned() - self.acknowledged
    }

    /// Number of items whose answers the server dropped.
    pub(super) const fn lost(&self) -> u64 {
        self.lost
    }

    /// Number of items without an answer, done or not.
    pub(super) fn unanswered(&self) -> u64 {
        self.unanswered + self.items.iter().filter(|buffered| !buffered.answered).count() as u64
    }

    /// Appends an item and assigns its seq.
    pub(super) fn push(&mut self, item: ScheduledItem) {
        self.items.push_back(BufferedItem { item, awaited_since: None, sent: false, answered: false });
    }

    /// The next item to send on this stream, with its seq.
    pub(super) fn next_to_send(&mut self) -> Option<(u64, ScheduledItem)> {
        // Without acknowledgements an answered item need not be sent again.
        while !self.must_acknowledge && self.items.get(self.sent).is_some_and(|buffered| buffered.answered) {
            self.sent += 1;
        }
        let buffered = self.items.get(self.sent)?;
        Some((self.first_seq + self.sent as u64, buffered.item))
    }

    /// Marks that item as sent. Returns whether an earlier stream had sent it before.
    pub(super) fn mark_sent(&mut self, now: Instant) -> bool {
        let Some(buffered) = self.items.get_mut(self.sent) else { return false };
        buffered.awaited_since = Some(now);
        self.sent += 1;
        self.awaited += 1;
        std::mem::replace(&mut buffered.sent, true)
    }

    /// Processes an answer. `None` if it is not awaited.
    pub(super) fn answer(&mut self, seq: u64, now: Instant) -> Option<Answered> {
        let buffered = self.items.get_mut(usize::try_from(seq.checked_sub(self.first_seq)?).ok()?)?;
        let since = buffered.awaited_since.take()?;
        let is_first = !std::mem::replace(&mut buffered.answered, true);
        self.awaited -= 1;
        self.evict();
        Some(Answered { latency: now.saturating_duration_since(since), is_first })
    }

    /// Processes a notice that the server dropped that many answers of items before `seq`: the oldest
    /// awaited ones are taken to be those.
    pub(super) fn drop_answers(&mut self, answers: u64, seq: u64) {
        let mut remaining = answers;
        let before = usize::try_from(seq.saturating_sub(self.first_seq)).unwrap_or(usize::MAX);
        for buffered in self.items.iter_mut().take(before).filter(|it| it.awaited_since.is_some()) {
            if remaining == 0 {
                break;
            }
            remaining -= 1;
            buffered.awaited_since = None;
            self.awaited -= 1;
            self.lost += u64::from(!std::mem::replace(&mut buffered.answered, true));
        }
        self.evict();
    }

    /// Processes an acknowledgement up to a seq. Returns whether it is an advance.
    pub(super) fn acknowledge(&mut self, seq: u64) -> bool {
        let seq = seq.min(self.assigned());
        let is_advance = seq > self.acknowledged;
        self.acknowledged = self.acknowledged.max(seq);
        self.evict();
        is_advance
    }

    /// Prepares for the next stream, on which the items that are not done are sent again.
    pub(super) fn rewind(&mut self) {
        for buffered in &mut self.items {
            buffered.awaited_since = None;
        }
        self.sent = 0;
        self.awaited = 0;
        self.evict();
    }

    /// Removes the items at the front that are done.
    fn evict(&mut self) {
        while let Some(front) = self.items.front() {
            let is_done = match self.must_acknowledge {
                // An acknowledged item is not sent again, but its answer may still arrive.
                true => self.first_seq <= self.acknowledged && front.awaited_since.is_none(),
                false => front.answered,
            };
            if !is_done {
                break;
            }
            self.unanswered += u64::from(!front.answered);
            self.items.pop_front();
            self.first_seq += 1;
            self.sent = self.sent.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn scheduled(row: usize) -> ScheduledItem {
        ScheduledItem { row, repetition: 0 }
    }

    /// A buffer with that many items, all sent.
    fn sent(items: usize, must_acknowledge: bool) -> ResendBuffer {
        let mut buffer = ResendBuffer::new(100, must_acknowledge);
        for row in 0..items {
            buffer.push(scheduled(row));
            assert_eq!(buffer.next_to_send(), Some((row as u64 + 1, scheduled(row))));
            assert!(!buffer.mark_sent(Instant::now()));
        }
        buffer
    }

    #[test]
    fn without_stored_samples_an_answer_completes_an_item() {
        let mut buffer = sent(3, false);
        let now = Instant::now();
        assert!(buffer.answer(2, now).expect("awaited").is_first);
        assert_eq!((buffer.resume_after(), buffer.awaited()), (0, 2));
        assert_eq!(buffer.answer(2, now), None, "nobody waits for a second answer");
        assert_eq!(buffer.answer(4, now), None, "nobody sent it");
        assert!(buffer.answer(1, now).expect("awaited").is_first);
        assert_eq!(buffer.resume_after(), 2);
        buffer.rewind();
        assert_eq!(buffer.next_to_send(), Some((3, scheduled(2))));
        assert!(buffer.mark_sent(now), "it was sent before");
        buffer.answer(3, now).expect("awaited");
        assert!(buffer.is_empty());
        assert_eq!((buffer.assigned(), buffer.unanswered(), buffer.lost()), (3, 0, 0));
    }

    #[test]
    fn what_is_not_acknowledged_is_sent_again_though_it_was_answered() {
        let mut buffer = sent(4, true);
        let now = Instant::now();
        for seq in 1..=3 {
            buffer.answer(seq, now).expect("awaited");
        }
        assert!(buffer.acknowledge(1));
        assert!(!buffer.acknowledge(1), "that was known");
        assert_eq!((buffer.resume_after(), buffer.unacknowledged()), (1, 3));
        buffer.rewind();
        assert_eq!(buffer.next_to_send(), Some((2, scheduled(1))));
        assert!(buffer.mark_sent(now), "it was sent before");
        assert!(!buffer.answer(2, now).expect("awaited").is_first);
        assert!(buffer.acknowledge(4));
        assert!(buffer.is_empty(), "4 was acknowledged and is no longer awaited");
        assert_eq!((buffer.assigned(), buffer.unanswered()), (4, 1));
    }

    #[test]
    fn an_acknowledged_item_still_awaits_its_answer_on_this_stream() {
        let mut buffer = sent(2, true);
        assert!(buffer.acknowledge(2));
        assert_eq!((buffer.unacknowledged(), buffer.is_empty()), (0, false));
        buffer.answer(1, Instant::now()).expect("awaited");
        buffer.answer(2, Instant::now()).expect("awaited");
        assert!(buffer.is_empty());
        assert_eq!(buffer.unanswered(), 0);
    }

    #[test]
    fn dropped_answers_free_the_buffer() {
        let mut buffer = sent(5, false);
        buffer.answer(1, Instant::now()).expect("awaited");
        buffer.drop_answers(2, 4);
        assert_eq!((buffer.awaited(), buffer.lost(), buffer.resume_after()), (2, 2, 3));
        buffer.drop_answers(9, 4);
        assert_eq!(buffer.lost(), 2, "there was none left before it");
        assert_eq!(buffer.unanswered(), 2);
    }

    proptest! {
        /// For every valid behaviour of a server, and however often the connection breaks, each item is
        /// sent until it is done, and all counts are consistent.
        #[test]
        fn every_item_is_sent_until_it_is_done(
            must_acknowledge: bool,
            steps in proptest::collection::vec((0..5_u8, 0..8_u64), 1..200),
        ) {
            let mut buffer = ResendBuffer::new(6, must_acknowledge);
            let now = Instant::now();
            let (mut rows, mut answers, mut acknowledged) = (0, 0, 0);
            let mut awaited = std::collections::BTreeSet::new();
            let mut committed = 0;
            for (kind, number) in steps {
                match kind {
                    0 if !buffer.is_full() => { buffer.push(scheduled(rows)); rows += 1; }
                    1 => if let Some((seq, sent)) = buffer.next_to_send() {
                        prop_assert_eq!(sent.row as u64 + 1, seq);
                        prop_assert!(seq > buffer.resume_after() && seq > acknowledged);
                        buffer.mark_sent(now);
                        prop_assert!(awaited.insert(seq));
                        committed = committed.max(seq);
                    },
                    2 => if let Some(seq) = awaited.iter().nth(number as usize % awaited.len().max(1)).copied() {
                        awaited.remove(&seq);
                        answers += u64::from(buffer.answer(seq, now).expect("awaited").is_first);
                    },
                    3 if must_acknowledge => {
                        acknowledged = acknowledged.max(committed.saturating_sub(number));
                        buffer.acknowledge(acknowledged);
                    }
                    4 if number == 0 => {
                        awaited.clear();
                        committed = acknowledged;
                        buffer.rewind();
                    }
                    _ => {}
                }
                prop_assert_eq!(buffer.awaited(), awaited.len());
                prop_assert_eq!(answers + buffer.unanswered(), rows as u64);
                prop_assert_eq!(buffer.assigned(), rows as u64);
                if must_acknowledge {
                    prop_assert_eq!(buffer.unacknowledged(), rows as u64 - acknowledged);
                }
                prop_assert!(buffer.items.len() <= 6);
            }
            // A server that then answers and acknowledges everything empties the buffer.
            buffer.rewind();
            while let Some((seq, _)) = buffer.next_to_send() {
                buffer.mark_sent(now);
                buffer.answer(seq, now);
            }
            buffer.acknowledge(rows as u64);
            prop_assert!(buffer.is_empty());
        }
    }
}
