//! One simulated camera: a streaming client that reconnects and resumes after a failure.

use std::future::pending;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::time::{sleep_until, timeout};
use tokio_util::sync::CancellationToken;

use super::nodes::NodeConnections;
use super::options::ReplayOptions;
use super::paced_feed::PacedFeed;
use super::progress::Counters;
use super::report::Counts;
use super::resend_buffer::{Answered, ResendBuffer};
use crate::backoff::Backoff;
use crate::domain::{LiveItem, ReceiverId, TargetId, TrackerId};
use crate::grpc::client::{ClientError, Connection, Event, Events, ItemSender, Opening, SendPermit};
use crate::grpc::proto::stream_answer::Outcome;
use crate::grpc::proto::track_rejection::Reason;
use crate::grpc::proto::{StreamAnswer, TrackRejection};

/// The state that several cameras share.
pub(super) struct Link {
    /// Connection to the server, or to what stands before its nodes.
    pub(super) server: Connection,
    /// Connections to its nodes.
    pub(super) nodes: Arc<NodeConnections>,
    /// Progress of all cameras.
    pub(super) counters: Arc<Counters>,
}

pub(super) struct SimulatedCamera {
    options: Arc<ReplayOptions>,
    opening: Opening,
    /// Appended to ids where several simulated cameras share one camera of the server.
    id_suffix: Option<String>,
    feed: PacedFeed,
    buffer: ResendBuffer,
    backoff: Backoff,
    link: Link,
    /// Where the next stream is opened.
    connection: Connection,
    /// True if nothing was answered since another node was named.
    is_redirected: bool,
    /// Since when nothing has been answered after a failure.
    broken_at: Option<Instant>,
    is_stopped: bool,
    counts: Counts,
}

/// How a stream was closed without an error.
enum StreamEnd {
    /// Everything was sent.
    Complete,
    /// The server requested a reconnect.
    ReconnectRequested,
}

/// The next action on a stream.
enum NextAction {
    /// Send the next item.
    Send,
    /// Wait until the next item is due.
    WaitUntil(Instant),
    /// Wait for the server: the window of items in flight, or the resend buffer, is full.
    WaitForServer,
    /// Half-close: there is nothing more to send.
    HalfClose,
}

/// State of the current stream.
struct StreamState {
    /// The server requested a reconnect, so its close is not an error.
    reconnect_requested: bool,
    /// Answers of this stream that the server has dropped.
    lost_answers: u64,
    /// The latest event, or the first item sent after everything was answered: the response timeout
    /// counts from here.
    last_event_at: Instant,
}

impl SimulatedCamera {
    pub(super) fn new(
        number: usize,
        options: Arc<ReplayOptions>,
        feed: PacedFeed,
        buffer: ResendBuffer,
        backoff: Backoff,
        link: Link,
    ) -> Self {
        let (round, index) = (number / options.camera_ids.len(), number % options.camera_ids.len());
        let opening = Opening {
            camera_id: options.camera_ids[index].clone(),
            client_name: format!("{}-{number}", options.client_name),
            resume_after_seq: 0,
            store_samples: options.store_samples,
        };
        let id_suffix = (round > 0).then(|| format!("@{round}"));
        Self {
            options,
            opening,
            id_suffix,
            feed,
            buffer,
            backoff,
            connection: link.server.clone(),
            link,
            is_redirected: false,
            broken_at: None,
            is_stopped: false,
            counts: Counts::default(),
        }
    }

    /// Streams until all items are done or no attempt is left.
    pub(super) async fn run(mut self, stop: CancellationToken) -> Counts {
        loop {
            let end = self.stream(&stop).await;
            self.buffer.rewind();
            let error = match end {
                Ok(StreamEnd::Complete) if self.buffer.is_empty() => break,
                Ok(StreamEnd::Complete) => {
                    ClientError::broken_line("the server closed the stream before all items were done")
                }
                Ok(StreamEnd::ReconnectRequested) => {
                    self.counts.reconnect_requests += 1;
                    continue;
                }
                Err(error) => error,
            };
            let is_redirected = self.follow(&error);
            if is_redirected && !std::mem::replace(&mut self.is_redirected, true) {
                continue;
            }
            if !is_redirected {
                *self.counts.broken.entry(error.reason.clone()).or_default() += 1;
                self.link.counters.set_fault(Some(error.to_string()));
                self.broken_at.get_or_insert_with(Instant::now);
            }
            let delay = if error.retryable { self.backoff.next_delay() } else { None };
            let Some(delay) = delay else {
                self.counts.record_give_up(&error);
                break;
            };
            tokio::time::sleep(delay).await;
        }
        self.counts.items = self.buffer.assigned();
        self.counts.lost_answers = self.buffer.lost();
        self.counts.unanswered = self.buffer.unanswered();
        self.counts.unacknowledged = self.buffer.unacknowledged();
        self.counts.acknowledged = self.counts.items - self.counts.unacknowledged;
        self.counts.faults = self.feed.counts();
        self.counts
    }

    /// Goes on at the node that an error names; whether it names one.
    fn follow(&mut self, error: &ClientError) -> bool {
        let named = error.owner.as_deref().map(|url| self.link.nodes.to(url, self.options.key.as_ref()));
        // A node that this client cannot reach is reached through the server, if at all.
        let Some(Ok(node)) = named else {
            self.connection = self.link.server.clone();
            return false;
        };
        self.connection = node;
        self.counts.redirects += 1;
        true
    }

    /// Runs one stream from its opening to its end.
    async fn stream(&mut self, stop: &CancellationToken) -> Result<StreamEnd, ClientError> {
        let (sender, mut events) = self.open().await?;
        self.counts.streams += 1;
        self.counts.reconnects += u64::from(self.counts.streams > 1);
        Counters::add(&self.link.counters.streams, 1);
        self.link.counters.set_fault(None);
        let end = self.run_stream(sender, &mut events, stop).await;
        Counters::subtract(&self.link.counters.streams, 1);
        end
    }

    /// Opens a stream and waits until the server confirms it.
    async fn open(&mut self) -> Result<(ItemSender, Events), ClientError> {
        self.opening.resume_after_seq = self.buffer.resume_after();
        let opened = timeout(self.options.response_timeout, async {
            let (sender, mut events) = self.connection.open(&self.opening).await?;
            match events.next().await? {
                Some(Event::Opened { model_version }) => Ok((sender, events, model_version)),
                _ => Err(ClientError::broken_line("the server did not open the stream")),
            }
        });
        let (sender, events, model_version) = opened.await.unwrap_or_else(|_| Err(response_timed_out()))?;
        self.counts.model_versions.extend(model_version);
        Ok((sender, events))
    }

    /// Sends due items and handles events until the server closes the stream.
    async fn run_stream(
        &mut self,
        sender: ItemSender,
        events: &mut Events,
        stop: &CancellationToken,
    ) -> Result<StreamEnd, ClientError> {
        let mut state =
            StreamState { reconnect_requested: false, lost_answers: 0, last_event_at: Instant::now() };
        // `None` after the half-close.
        let mut sender = Some(sender);
        let mut is_broken = false;
        loop {
            let now = Instant::now();
            let action = if state.reconnect_requested || is_broken {
                NextAction::HalfClose
            } else {
                self.next_action(now)
            };
            if matches!(action, NextAction::HalfClose) {
                sender = None;
            }
            let response_is_due = !self.buffer.is_empty() || sender.is_none();
            let deadline = response_is_due.then(|| state.last_event_at + self.options.response_timeout);
            if deadline.is_some_and(|deadline| now >= deadline) {
                return Err(response_timed_out());
            }
            let due = if let NextAction::WaitUntil(due) = action { Some(due) } else { None };
            tokio::select! {
                event = events.next() => match event? {
                    Some(event) => self.handle_event(event, &mut state),
                    None if is_broken => return Err(ClientError::broken_line("the connection broke")),
                    None if state.reconnect_requested => return Ok(StreamEnd::ReconnectRequested),
                    None if sender.is_none() => return Ok(StreamEnd::Complete),
                    None => return Err(ClientError::broken_line("the server closed the stream")),
                },
                permit = reserve(&sender), if matches!(action, NextAction::Send) => match permit {
                    Ok(permit) => self.send_next(permit, &mut state),
                    // The next event carries the reason.
                    Err(_) => is_broken = true,
                },
                () = until(due, deadline) => {}
                () = stop.cancelled(), if !self.is_stopped => self.is_stopped = true,
            }
        }
    }

    fn send_next(&mut self, permit: SendPermit<'_>, state: &mut StreamState) {
        let Some((seq, scheduled)) = self.buffer.next_to_send() else { return };
        let item = self.feed.recording.item(scheduled.row, scheduled.repetition, self.options.shift);
        permit.send(seq, self.with_suffixed_ids(item));
        let now = Instant::now();
        if self.buffer.awaited() == 0 {
            state.last_event_at = now;
        }
        self.counts.resent += u64::from(self.buffer.mark_sent(now));
    }

    /// The next action; takes the next item from the feed if it is due.
    fn next_action(&mut self, now: Instant) -> NextAction {
        if self.buffer.awaited() >= self.options.in_flight {
            return NextAction::WaitForServer;
        }
        if self.buffer.next_to_send().is_some() {
            return NextAction::Send;
        }
        match self.feed.due(now).filter(|_| !self.is_stopped) {
            None => NextAction::HalfClose,
            Some(_) if self.buffer.is_full() => NextAction::WaitForServer,
            Some(due) if due > now => NextAction::WaitUntil(due),
            Some(due) => {
                if let Some(scheduled) = self.feed.take(now) {
                    self.buffer.push(scheduled);
                    Counters::add(&self.link.counters.items, 1);
                    let lag = if self.feed.is_paced() { now - due } else { Duration::ZERO };
                    self.counts.max_lag = self.counts.max_lag.max(lag);
                }
                NextAction::Send
            }
        }
    }

    fn handle_event(&mut self, event: Event, state: &mut StreamState) {
        state.last_event_at = Instant::now();
        match event {
            Event::Opened { .. } => {}
            Event::Answer(answer) => self.handle_answer(&answer, state),
            Event::Acknowledged { seq } => {
                if self.buffer.acknowledge(seq) {
                    self.progressed();
                }
            }
            Event::CameraMoved(_) => self.counts.cameras_moved += 1,
            Event::Reconnect { .. } => state.reconnect_requested = true,
        }
    }

    fn progressed(&mut self) {
        self.backoff.reset();
        self.is_redirected = false;
        if let Some(broken_at) = self.broken_at.take() {
            self.counts.recoveries.record(broken_at.elapsed());
        }
    }

    fn handle_answer(&mut self, answer: &StreamAnswer, state: &mut StreamState) {
        let lost = answer.lost_answers.saturating_sub(state.lost_answers);
        if lost > 0 {
            state.lost_answers = answer.lost_answers;
            self.buffer.drop_answers(lost, answer.seq);
        }
        let Some(Answered { latency, is_first }) = self.buffer.answer(answer.seq, state.last_event_at) else {
            return;
        };
        self.progressed();
        self.counts.latencies.record(latency);
        if let Some(Outcome::Fused(fused)) = &answer.outcome {
            self.counts.model_versions.extend(fused.model_version);
        }
        if !is_first {
            return;
        }
        Counters::add(&self.link.counters.answered, 1);
        match &answer.outcome {
            Some(Outcome::Error(error)) => {
                *self.counts.refused.entry(error.reason.clone()).or_default() += 1;
            }
            _ => {
                self.counts.answered += 1;
                let rejections = answer.track.iter().flat_map(|track| &track.rejections);
                let is_too_late =
                    rejections.map(TrackRejection::reason).any(|reason| reason == Reason::TooLate);
                self.counts.too_late += u64::from(is_too_late);
            }
        }
    }

    /// The item with this camera's suffix on its ids.
    fn with_suffixed_ids(&self, mut item: LiveItem) -> LiveItem {
        if let Some(suffix) = &self.id_suffix {
            let target = |id: TargetId| TargetId::new(&format!("{id}{suffix}")).unwrap_or(id);
            let tracker = |id: TrackerId| TrackerId::new(&format!("{id}{suffix}")).unwrap_or(id);
            let receiver = |id: ReceiverId| ReceiverId::new(&format!("{id}{suffix}")).unwrap_or(id);
            item.target_id = item.target_id.map(target);
            item.receiver_id = item.receiver_id.map(receiver);
            item.tracker_id = item.tracker_id.map(tracker);
        }
        item
    }
}

fn response_timed_out() -> ClientError {
    ClientError {
        reason: "silence".to_owned(),
        ..ClientError::broken_line("the server did not respond in time")
    }
}

async fn reserve(sender: &Option<ItemSender>) -> Result<SendPermit<'_>, ClientError> {
    match sender {
        Some(sender) => sender.reserve().await,
        None => pending().await,
    }
}

/// Waits for the earlier of two instants; never completes without one.
async fn until(one: Option<Instant>, other: Option<Instant>) {
    match one.into_iter().chain(other).min() {
        Some(instant) => sleep_until(instant.into()).await,
        None => pending().await,
    }
}
