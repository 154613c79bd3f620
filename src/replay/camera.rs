//! One simulated camera: a client that streams, loses its line, and goes on.

use std::future::pending;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::time::{sleep_until, timeout};
use tokio_util::sync::CancellationToken;

use super::backoff::Backoff;
use super::buffer::{Answered, Buffer};
use super::feed::Feed;
use super::report::Tally;
use super::{Live, Options};
use crate::domain::{LiveItem, ReceiverId, TargetId};
use crate::grpc::client::{ClientError, Connection, Event, Events, ItemSender, Opening};
use crate::grpc::proto::StreamAnswer;
use crate::grpc::proto::stream_answer::Outcome;

/// What cameras share.
pub(super) struct Line {
    /// To the server; shared by some of the cameras.
    pub(super) connection: Connection,
    /// How far all have come.
    pub(super) live: Arc<Live>,
}

/// A client with its place in the feed, what it keeps, and what it has counted.
pub(super) struct SimulatedCamera {
    options: Arc<Options>,
    opening: Opening,
    /// Put behind target ids, where several cameras share one of the server's.
    suffix: Option<String>,
    feed: Feed,
    buffer: Buffer,
    backoff: Backoff,
    line: Line,
    stopped: bool,
    tally: Tally,
}

/// How a stream ended in order.
enum Ended {
    /// Everything was sent.
    Done,
    /// The server has asked for another.
    Invited,
}

/// What to do next on a stream.
enum Step {
    /// Send the next item.
    Send,
    /// The next item is due then.
    WaitUntil(Instant),
    /// There is no room: for an item in flight, or for one more to keep.
    WaitForServer,
    /// There is nothing more to send.
    HalfClose,
}

/// Where one stream stands.
struct StreamState {
    /// The server's end, when it comes, is in order.
    invited: bool,
    /// Answers that this stream has lost so far.
    lost: u64,
    /// When the server last said something, or began to owe something.
    heard: Instant,
}

impl SimulatedCamera {
    pub(super) fn new(
        number: usize,
        options: Arc<Options>,
        feed: Feed,
        buffer: Buffer,
        backoff: Backoff,
        line: Line,
    ) -> Self {
        let (round, place) = (number / options.camera_ids.len(), number % options.camera_ids.len());
        let opening = Opening {
            camera_id: options.camera_ids[place].clone(),
            client_name: format!("{}-{number}", options.client_name),
            resume_after_seq: 0,
            store_samples: options.store_samples,
        };
        let suffix = (round > 0).then(|| format!("@{round}"));
        let tally = Tally::default();
        Self { options, opening, suffix, feed, buffer, backoff, line, stopped: false, tally }
    }

    /// Streams until everything is done, or no attempt is left.
    pub(super) async fn run(mut self, stop: CancellationToken) -> Tally {
        loop {
            let ended = self.stream(&stop).await;
            self.buffer.rewind();
            let error = match ended {
                Ok(Ended::Done) if self.buffer.is_empty() => break,
                Ok(Ended::Done) => ClientError::broken_line("the server ended the stream with items left"),
                Ok(Ended::Invited) => {
                    self.tally.invitations += 1;
                    continue;
                }
                Err(error) => error,
            };
            *self.tally.broken.entry(error.reason.clone()).or_default() += 1;
            let wait = if error.passing { self.backoff.next_wait() } else { None };
            let Some(wait) = wait else {
                self.tally.give_up(&error);
                break;
            };
            tokio::time::sleep(wait).await;
        }
        self.tally.items = self.buffer.dealt();
        self.tally.lost_answers = self.buffer.lost();
        self.tally.unanswered = self.buffer.unanswered();
        self.tally.unacknowledged = self.buffer.unacknowledged();
        self.tally.acknowledged = self.tally.items - self.tally.unacknowledged;
        self.tally.faults = self.feed.counts();
        self.tally
    }

    /// One stream from its opening to its end.
    async fn stream(&mut self, stop: &CancellationToken) -> Result<Ended, ClientError> {
        let (sender, mut events) = self.open().await?;
        self.tally.streams += 1;
        self.tally.reconnects += u64::from(self.tally.streams > 1);
        Live::add(&self.line.live.streams, 1);
        let ended = self.converse(sender, &mut events, stop).await;
        Live::subtract(&self.line.live.streams, 1);
        ended
    }

    /// A stream that the server has said is open.
    async fn open(&mut self) -> Result<(ItemSender, Events), ClientError> {
        self.opening.resume_after_seq = self.buffer.resume_after();
        let opened = timeout(self.options.patience, async {
            let (sender, mut events) = self.line.connection.open(&self.opening).await?;
            match events.next().await? {
                Some(Event::Opened { model_version }) => Ok((sender, events, model_version)),
                _ => Err(ClientError::broken_line("the server did not open the stream")),
            }
        });
        let (sender, events, model_version) = opened.await.unwrap_or_else(|_| Err(silence()))?;
        self.tally.model_versions.extend(model_version);
        Ok((sender, events))
    }

    /// Sends what is due and takes what comes, until the server ends the stream.
    async fn converse(
        &mut self,
        sender: ItemSender,
        events: &mut Events,
        stop: &CancellationToken,
    ) -> Result<Ended, ClientError> {
        let mut state = StreamState { invited: false, lost: 0, heard: Instant::now() };
        // `None` after the half-close.
        let mut sender = Some(sender);
        let mut cut = false;
        loop {
            let now = Instant::now();
            let step = if state.invited || cut { Step::HalfClose } else { self.step(now) };
            if matches!(step, Step::HalfClose) {
                sender = None;
            }
            let owes = !self.buffer.is_empty() || sender.is_none();
            let patience_ends = owes.then(|| state.heard + self.options.patience);
            if patience_ends.is_some_and(|end| now >= end) {
                return Err(silence());
            }
            let due = if let Step::WaitUntil(due) = step { Some(due) } else { None };
            tokio::select! {
                event = events.next() => match event? {
                    Some(event) => self.take(event, &mut state),
                    None if cut => return Err(ClientError::broken_line("the line broke")),
                    None if state.invited => return Ok(Ended::Invited),
                    None if sender.is_none() => return Ok(Ended::Done),
                    None => return Err(ClientError::broken_line("the server ended the stream")),
                },
                room = room(&sender), if matches!(step, Step::Send) => match room {
                    Ok(room) => {
                        if let Some((seq, turn)) = self.buffer.next_to_send() {
                            let item = self.feed.recording.item(turn.row, turn.pass, self.options.shift);
                            room.send(seq, self.own(item));
                            let now = Instant::now();
                            if self.buffer.awaited() == 0 {
                                state.heard = now;
                            }
                            self.tally.resent += u64::from(self.buffer.mark_sent(now));
                        }
                    }
                    // The events will say why.
                    Err(_) => cut = true,
                },
                () = until(due, patience_ends) => {}
                () = stop.cancelled(), if !self.stopped => self.stopped = true,
            }
        }
    }

    /// What to do next, and the next item taken from the feed if it is due.
    fn step(&mut self, now: Instant) -> Step {
        if self.buffer.awaited() >= self.options.in_flight {
            return Step::WaitForServer;
        }
        if self.buffer.next_to_send().is_some() {
            return Step::Send;
        }
        match self.feed.due(now).filter(|_| !self.stopped) {
            None => Step::HalfClose,
            Some(_) if self.buffer.is_full() => Step::WaitForServer,
            Some(due) if due > now => Step::WaitUntil(due),
            Some(due) => {
                if let Some(turn) = self.feed.take(now) {
                    self.buffer.push(turn);
                    Live::add(&self.line.live.items, 1);
                    let behind = if self.feed.is_paced() { now - due } else { Duration::ZERO };
                    self.tally.furthest_behind = self.tally.furthest_behind.max(behind);
                }
                Step::Send
            }
        }
    }

    fn take(&mut self, event: Event, state: &mut StreamState) {
        state.heard = Instant::now();
        match event {
            Event::Opened { .. } => {}
            Event::Answer(answer) => self.take_answer(&answer, state),
            Event::Acknowledged { seq } => {
                if self.buffer.acknowledge(seq) {
                    self.backoff.reset();
                }
            }
            Event::CameraMoved(_) => self.tally.cameras_moved += 1,
            Event::Reconnect { .. } => state.invited = true,
        }
    }

    fn take_answer(&mut self, answer: &StreamAnswer, state: &mut StreamState) {
        let lost = answer.lost_answers.saturating_sub(state.lost);
        if lost > 0 {
            state.lost = answer.lost_answers;
            self.buffer.lose(lost, answer.seq);
        }
        let Some(Answered { after, first }) = self.buffer.answer(answer.seq, state.heard) else { return };
        self.backoff.reset();
        self.tally.latencies.record(after);
        if let Some(Outcome::Fused(fused)) = &answer.outcome {
            self.tally.model_versions.extend(fused.model_version);
        }
        if !first {
            return;
        }
        Live::add(&self.line.live.answered, 1);
        match &answer.outcome {
            Some(Outcome::Error(error)) => {
                *self.tally.refused.entry(error.reason.clone()).or_default() += 1;
            }
            _ => self.tally.answered += 1,
        }
    }

    /// The item with its target's id as this camera spells it.
    fn own(&self, mut item: LiveItem) -> LiveItem {
        if let Some(suffix) = &self.suffix {
            let target = |id: TargetId| TargetId::new(&format!("{id}{suffix}")).unwrap_or(id);
            let receiver = |id: ReceiverId| ReceiverId::new(&format!("{id}{suffix}")).unwrap_or(id);
            item.target_id = item.target_id.map(target);
            item.receiver_id = item.receiver_id.map(receiver);
        }
        item
    }
}

fn silence() -> ClientError {
    ClientError {
        reason: "silence".to_owned(),
        ..ClientError::broken_line("the server owes and says nothing")
    }
}

async fn room(sender: &Option<ItemSender>) -> Result<crate::grpc::client::Room<'_>, ClientError> {
    match sender {
        Some(sender) => sender.room().await,
        None => pending().await,
    }
}

/// Waits for the earlier of two instants; for ever if there is none.
async fn until(one: Option<Instant>, other: Option<Instant>) {
    match one.into_iter().chain(other).min() {
        Some(instant) => sleep_until(instant.into()).await,
        None => pending().await,
    }
}
