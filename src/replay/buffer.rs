//! What a client keeps until the server need not see it again.
//!
//! Seqs are dealt here, from 1, without gaps. An item is done when it is answered; on a stream that
//! keeps samples, when it is acknowledged as well. What never happens here: more than the limit kept.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::feed::Turn;

/// An item that is not done.
#[derive(Debug, Clone, Copy)]
struct Kept {
    turn: Turn,
    /// When it was sent on this stream, until its answer comes.
    awaited_since: Option<Instant>,
    /// Whether it was sent at all, on this stream or an earlier one.
    sent: bool,
    /// Whether an answer has come or was given up, on this stream or an earlier one.
    answered: bool,
}

/// The items of one camera that are not done, and where the stream stands among them.
#[derive(Debug)]
pub(super) struct Buffer {
    kept: VecDeque<Kept>,
    limit: usize,
    must_acknowledge: bool,
    /// Seq of the first item kept.
    first: u64,
    /// Items at the front that were sent on this stream.
    sent: usize,
    awaited: usize,
    acknowledged: u64,
    lost: u64,
    unanswered: u64,
}

/// What an answer meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Answered {
    /// Since the item was sent on this stream.
    pub(super) after: Duration,
    /// Whether it is the item's first answer.
    pub(super) first: bool,
}

impl Buffer {
    pub(super) const fn new(limit: usize, must_acknowledge: bool) -> Self {
        Self {
            kept: VecDeque::new(),
            limit,
            must_acknowledge,
            first: 1,
            sent: 0,
            awaited: 0,
            acknowledged: 0,
            lost: 0,
            unanswered: 0,
        }
    }

    /// Everything is done.
    pub(super) fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    pub(super) fn is_full(&self) -> bool {
        self.kept.len() >= self.limit
    }

    /// Items sent on this stream and not answered yet.
    pub(super) const fn awaited(&self) -> usize {
        self.awaited
    }

    /// Seq up to which all is acknowledged, or answered where nothing is acknowledged.
    pub(super) const fn resume_after(&self) -> u64 {
        if self.must_acknowledge { self.acknowledged } else { self.first - 1 }
    }

    /// Items dealt a seq so far.
    pub(super) fn dealt(&self) -> u64 {
        self.first - 1 + self.kept.len() as u64
    }

    /// Items that are not acknowledged yet.
    pub(super) fn unacknowledged(&self) -> u64 {
        self.dealt() - self.acknowledged
    }

    /// Items whose answers the server says it dropped.
    pub(super) const fn lost(&self) -> u64 {
        self.lost
    }

    /// Items that have no answer, done or not.
    pub(super) fn unanswered(&self) -> u64 {
        self.unanswered + self.kept.iter().filter(|kept| !kept.answered).count() as u64
    }

    /// Takes a new item in, to be sent.
    pub(super) fn push(&mut self, turn: Turn) {
        self.kept.push_back(Kept { turn, awaited_since: None, sent: false, answered: false });
    }

    /// The next item to be sent on this stream, with its seq.
    pub(super) fn next_to_send(&mut self) -> Option<(u64, Turn)> {
        // Where only answers count, what is answered need not be sent again.
        while !self.must_acknowledge && self.kept.get(self.sent).is_some_and(|kept| kept.answered) {
            self.sent += 1;
        }
        let kept = self.kept.get(self.sent)?;
        Some((self.first + self.sent as u64, kept.turn))
    }

    /// That item was sent. Says whether it had been sent before, on an earlier stream.
    pub(super) fn mark_sent(&mut self, now: Instant) -> bool {
        let Some(kept) = self.kept.get_mut(self.sent) else { return false };
        kept.awaited_since = Some(now);
        self.sent += 1;
        self.awaited += 1;
        std::mem::replace(&mut kept.sent, true)
    }

    /// An answer came. `None` if nobody waits for it.
    pub(super) fn answer(&mut self, seq: u64, now: Instant) -> Option<Answered> {
        let kept = self.kept.get_mut(usize::try_from(seq.checked_sub(self.first)?).ok()?)?;
        let since = kept.awaited_since.take()?;
        let first = !std::mem::replace(&mut kept.answered, true);
        self.awaited -= 1;
        self.let_go();
        Some(Answered { after: now.saturating_duration_since(since), first })
    }

    /// The server has dropped so many answers, all of items before `seq`: the oldest are given up.
    pub(super) fn lose(&mut self, answers: u64, seq: u64) {
        let mut left = answers;
        let before = usize::try_from(seq.saturating_sub(self.first)).unwrap_or(usize::MAX);
        for kept in self.kept.iter_mut().take(before).filter(|kept| kept.awaited_since.is_some()) {
            if left == 0 {
                break;
            }
            left -= 1;
            kept.awaited_since = None;
            self.awaited -= 1;
            self.lost += u64::from(!std::mem::replace(&mut kept.answered, true));
        }
        self.let_go();
    }

    /// Everything up to a seq need not be sent again. Says whether that is news.
    pub(super) fn acknowledge(&mut self, seq: u64) -> bool {
        let seq = seq.min(self.dealt());
        let news = seq > self.acknowledged;
        self.acknowledged = self.acknowledged.max(seq);
        self.let_go();
        news
    }

    /// The stream is over: what is not done is sent again on the next.
    pub(super) fn rewind(&mut self) {
        for kept in &mut self.kept {
            kept.awaited_since = None;
        }
        self.sent = 0;
        self.awaited = 0;
        self.let_go();
    }

    /// Lets go of what is done at the front.
    fn let_go(&mut self) {
        while let Some(front) = self.kept.front() {
            let done = match self.must_acknowledge {
                // An acknowledged item is never sent again, but its answer may still be under way.
                true => self.first <= self.acknowledged && front.awaited_since.is_none(),
                false => front.answered,
            };
            if !done {
                break;
            }
            self.unanswered += u64::from(!front.answered);
            self.kept.pop_front();
            self.first += 1;
            self.sent = self.sent.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn turn(row: usize) -> Turn {
        Turn { row, pass: 0 }
    }

    /// A buffer of so many items, all sent.
    fn sent(items: usize, must_acknowledge: bool) -> Buffer {
        let mut buffer = Buffer::new(100, must_acknowledge);
        for row in 0..items {
            buffer.push(turn(row));
            assert_eq!(buffer.next_to_send(), Some((row as u64 + 1, turn(row))));
            assert!(!buffer.mark_sent(Instant::now()));
        }
        buffer
    }

    #[test]
    fn answers_alone_are_enough_where_nothing_is_kept_as_a_sample() {
        let mut buffer = sent(3, false);
        let now = Instant::now();
        assert!(buffer.answer(2, now).expect("awaited").first);
        assert_eq!((buffer.resume_after(), buffer.awaited()), (0, 2));
        assert_eq!(buffer.answer(2, now), None, "nobody waits for a second answer");
        assert_eq!(buffer.answer(4, now), None, "nobody sent it");
        assert!(buffer.answer(1, now).expect("awaited").first);
        assert_eq!(buffer.resume_after(), 2);
        buffer.rewind();
        assert_eq!(buffer.next_to_send(), Some((3, turn(2))));
        assert!(buffer.mark_sent(now), "it was sent before");
        buffer.answer(3, now).expect("awaited");
        assert!(buffer.is_empty());
        assert_eq!((buffer.dealt(), buffer.unanswered(), buffer.lost()), (3, 0, 0));
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
        assert_eq!(buffer.next_to_send(), Some((2, turn(1))));
        assert!(buffer.mark_sent(now), "it was sent before");
        assert!(!buffer.answer(2, now).expect("awaited").first);
        assert!(buffer.acknowledge(4));
        assert!(buffer.is_empty(), "4 was acknowledged and is awaited no more");
        assert_eq!((buffer.dealt(), buffer.unanswered()), (4, 1));
    }

    #[test]
    fn an_acknowledged_item_still_waits_for_its_answer_on_this_stream() {
        let mut buffer = sent(2, true);
        assert!(buffer.acknowledge(2));
        assert_eq!((buffer.unacknowledged(), buffer.is_empty()), (0, false));
        buffer.answer(1, Instant::now()).expect("awaited");
        buffer.answer(2, Instant::now()).expect("awaited");
        assert!(buffer.is_empty());
        assert_eq!(buffer.unanswered(), 0);
    }

    #[test]
    fn lost_answers_make_room() {
        let mut buffer = sent(5, false);
        buffer.answer(1, Instant::now()).expect("awaited");
        buffer.lose(2, 4);
        assert_eq!((buffer.awaited(), buffer.lost(), buffer.resume_after()), (2, 2, 3));
        buffer.lose(9, 4);
        assert_eq!(buffer.lost(), 2, "there was none left before it");
        assert_eq!(buffer.unanswered(), 2);
    }

    proptest! {
        /// Whatever a server does within the rules, and however often the line breaks, each item is
        /// sent until it is done, the window is counted rightly and the counts add up.
        #[test]
        fn nothing_is_forgotten(
            must_acknowledge: bool,
            steps in proptest::collection::vec((0..5_u8, 0..8_u64), 1..200),
        ) {
            let mut buffer = Buffer::new(6, must_acknowledge);
            let now = Instant::now();
            let (mut rows, mut answers, mut acknowledged) = (0, 0, 0);
            let mut awaited = std::collections::BTreeSet::new();
            let mut committed = 0;
            for (kind, number) in steps {
                match kind {
                    0 if !buffer.is_full() => { buffer.push(turn(rows)); rows += 1; }
                    1 => if let Some((seq, sent)) = buffer.next_to_send() {
                        prop_assert_eq!(sent.row as u64 + 1, seq);
                        prop_assert!(seq > buffer.resume_after() && seq > acknowledged);
                        buffer.mark_sent(now);
                        prop_assert!(awaited.insert(seq));
                        committed = committed.max(seq);
                    },
                    2 => if let Some(seq) = awaited.iter().nth(number as usize % awaited.len().max(1)).copied() {
                        awaited.remove(&seq);
                        answers += u64::from(buffer.answer(seq, now).expect("awaited").first);
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
                prop_assert_eq!(buffer.dealt(), rows as u64);
                if must_acknowledge {
                    prop_assert_eq!(buffer.unacknowledged(), rows as u64 - acknowledged);
                }
                prop_assert!(buffer.kept.len() <= 6);
            }
            // A server that then does all it should empties the buffer.
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
