//! Messages of a live stream for a client that may read slowly.
//!
//! Answers beyond the limit push out the oldest, counted; what must not be lost (acknowledgements,
//! alarms, the end) takes a place each, whatever the client does.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use futures_util::Stream;
use tonic::Status;

use super::proto::stream_response::Kind;
use super::proto::{
    CameraMoved, StreamAcknowledgement, StreamAnswer, StreamOpened, StreamReconnect, StreamResponse,
};

/// The writer's side.
pub(super) struct Outbox(Arc<OutboxState>);

/// The reader's side: the stream of responses that the transport sends.
pub(super) struct Responses(Arc<OutboxState>);

struct OutboxState {
    waiting: Mutex<Waiting>,
    most_answers: usize,
}

#[derive(Default)]
struct Waiting {
    opened: Option<StreamOpened>,
    answers: VecDeque<Box<StreamAnswer>>,
    acknowledged: Option<StreamAcknowledgement>,
    moved: Option<CameraMoved>,
    reconnect: Option<StreamReconnect>,
    end: Option<Option<Status>>,
    lost_answers: u64,
    reader: Option<Waker>,
    reader_gone: bool,
}

/// Both sides of an empty outbox.
pub(super) fn outbox(most_answers: usize) -> (Outbox, Responses) {
    let shared = Arc::new(OutboxState { waiting: Mutex::default(), most_answers: most_answers.max(1) });
    (Outbox(shared.clone()), Responses(shared))
}

impl OutboxState {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, put: impl FnOnce(&mut Waiting)) {
        let reader = {
            let mut waiting = self.lock();
            put(&mut waiting);
            waiting.reader.take()
        };
        if let Some(reader) = reader {
            reader.wake();
        }
    }
}

impl Outbox {
    pub(super) fn opened(&self, opened: StreamOpened) {
        self.0.put(|waiting| waiting.opened = Some(opened));
    }

    /// Says whether an older answer was lost for it. The reader is not woken before
    /// [`Outbox::flush`]: answers go out together.
    pub(super) fn answer(&self, mut answer: Box<StreamAnswer>) -> bool {
        let mut waiting = self.0.lock();
        let lost = waiting.answers.len() >= self.0.most_answers;
        if lost {
            waiting.answers.pop_front();
            waiting.lost_answers += 1;
        }
        answer.lost_answers = waiting.lost_answers;
        waiting.answers.push_back(answer);
        lost
    }

    /// Wakes the reader.
    pub(super) fn flush(&self) {
        self.0.put(|_| {});
    }

    /// An acknowledgement replaces those before it.
    pub(super) fn acknowledge(&self, acknowledgement: StreamAcknowledgement) {
        self.0.put(|waiting| waiting.acknowledged = Some(acknowledgement));
    }

    pub(super) fn moved(&self, moved: CameraMoved) {
        self.0.put(|waiting| waiting.moved = Some(moved));
    }

    pub(super) fn reconnect(&self, reason: &str) {
        self.0.put(|waiting| waiting.reconnect = Some(StreamReconnect { reason: reason.to_owned() }));
    }

    /// Ends the stream once all before was read: well, or with a status.
    pub(super) fn end(&self, status: Option<Status>) {
        self.0.put(|waiting| waiting.end = Some(status));
    }

    /// True if nobody will ever read what is put in.
    pub(super) fn reader_is_gone(&self) -> bool {
        self.0.lock().reader_gone
    }
}

impl Drop for Outbox {
    fn drop(&mut self) {
        // A writer that was dropped in the middle says nothing: the stream must end all the same.
        self.0.put(|waiting| {
            waiting.end.get_or_insert_with(|| Some(Status::cancelled("the stream was dropped")));
        });
    }
}

impl Drop for Responses {
    fn drop(&mut self) {
        let mut waiting = self.0.lock();
        waiting.reader_gone = true;
        waiting.answers = VecDeque::new();
    }
}

impl Stream for Responses {
    type Item = Result<StreamResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let mut waiting = self.0.lock();
        let kind = if let Some(opened) = waiting.opened.take() {
            Kind::Opened(opened)
        } else if let Some(moved) = waiting.moved.take() {
            Kind::CameraMoved(moved)
        } else if let Some(answer) = waiting.answers.pop_front() {
            Kind::Answer(answer)
        } else if let Some(acknowledgement) = waiting.acknowledged.take() {
            Kind::Acknowledgement(acknowledgement)
        } else if let Some(reconnect) = waiting.reconnect.take() {
            Kind::Reconnect(reconnect)
        } else if let Some(end) = &mut waiting.end {
            return Poll::Ready(end.take().map(Err));
        } else {
            waiting.reader = Some(context.waker().clone());
            return Poll::Pending;
        };
        Poll::Ready(Some(Ok(StreamResponse { kind: Some(kind) })))
    }
}

#[cfg(test)]
mod tests {
    use futures_util::StreamExt as _;

    use super::*;

    #[tokio::test]
    async fn one_answer_more_than_the_limit_loses_the_oldest() {
        let (outbox, mut responses) = outbox(2);
        let answer = |seq| Box::new(StreamAnswer { seq, ..StreamAnswer::default() });
        assert!(!outbox.answer(answer(1)) && !outbox.answer(answer(2)), "just allowed");
        assert!(outbox.answer(answer(3)), "the first is lost");
        outbox.end(None);
        let mut read = Vec::new();
        while let Some(Ok(StreamResponse { kind: Some(Kind::Answer(answer)) })) = responses.next().await {
            read.push((answer.seq, answer.lost_answers));
        }
        assert_eq!(read, [(2, 0), (3, 1)]);
    }
}
