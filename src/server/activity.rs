//! The activity of one connection, so that an unused one can be closed.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::Instant;

use crate::telemetry::{CloseReason, RpcCall};

/// Header and trailer with the status of an RPC.
pub(super) const GRPC_STATUS: &str = "grpc-status";

/// Requests, responses and written bytes of one connection.
pub(super) struct Activity {
    opened_at: Instant,
    written_bytes: AtomicU64,
    /// Why the stream gave up, if it did.
    given_up: OnceLock<CloseReason>,
    open: Mutex<OpenRequests>,
}

struct OpenRequests {
    requests: usize,
    /// When the last request ended, or the connection was opened.
    idle_since: Instant,
    next_response: u64,
    /// Responses whose bodies are still being produced.
    responses: HashMap<u64, Arc<ResponseProgress>>,
}

/// A part of a response that the connection has not sent yet, if there is one.
#[derive(Default)]
struct ResponseProgress {
    is_held_back: AtomicBool,
    /// Milliseconds from the opening of the connection until the part was handed over.
    since_ms: AtomicU64,
    /// Bytes that the connection had written by then.
    written_bytes: AtomicU64,
}

impl Activity {
    pub(super) fn new() -> Arc<Self> {
        let now = Instant::now();
        let open = OpenRequests { requests: 0, idle_since: now, next_response: 0, responses: HashMap::new() };
        Arc::new(Self {
            opened_at: now,
            written_bytes: AtomicU64::new(0),
            given_up: OnceLock::new(),
            open: Mutex::new(open),
        })
    }

    fn lock(&self) -> MutexGuard<'_, OpenRequests> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn wrote(&self, bytes: usize) {
        self.written_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// The stream breaks the connection off.
    pub(super) fn give_up(&self, reason: CloseReason) {
        let _ = self.given_up.set(reason);
    }

    /// Why the stream broke the connection off, if it did.
    pub(super) fn given_up(&self) -> Option<CloseReason> {
        self.given_up.get().copied()
    }

    /// A request begins; it is open until the value is dropped.
    pub(super) fn request(self: &Arc<Self>) -> OpenRequest {
        self.lock().requests += 1;
        OpenRequest { activity: self.clone(), response: None }
    }

    /// Why the connection should be closed, if it should: no request for `idle_time`, or a response of
    /// which the client took less than `bytes_per_s` over at least `idle_time`.
    pub(super) fn close_reason(&self, idle_time: Duration, bytes_per_s: u64) -> Option<CloseReason> {
        let open = self.lock();
        if open.requests == 0 {
            return (open.idle_since.elapsed() >= idle_time).then_some(CloseReason::Idle);
        }
        let now_ms = self.elapsed_ms();
        let written_bytes = self.written_bytes.load(Ordering::Relaxed);
        let is_stalled = open.responses.values().any(|progress| {
            let waited_ms = now_ms.saturating_sub(progress.since_ms.load(Ordering::Relaxed));
            let taken_bytes = written_bytes.saturating_sub(progress.written_bytes.load(Ordering::Relaxed));
            progress.is_held_back.load(Ordering::Acquire)
                && Duration::from_millis(waited_ms) >= idle_time
                && taken_bytes.saturating_mul(1_000) < bytes_per_s.saturating_mul(waited_ms)
        });
        is_stalled.then_some(CloseReason::Stalled)
    }

    fn elapsed_ms(&self) -> u64 {
        u64::try_from(self.opened_at.elapsed().as_millis()).unwrap_or(u64::MAX)
    }
}

/// A request from its header to the end of its response.
pub(super) struct OpenRequest {
    activity: Arc<Activity>,
    response: Option<(u64, Arc<ResponseProgress>)>,
}

impl OpenRequest {
    /// A response whose body comes part by part; the connection may be slow to take them.
    fn streams(&mut self) {
        let progress = Arc::new(ResponseProgress::default());
        let mut open = self.activity.lock();
        let number = open.next_response;
        open.next_response += 1;
        open.responses.insert(number, progress.clone());
        drop(open);
        self.response = Some((number, progress));
        self.handed_over();
    }

    /// The connection has a part to send.
    fn handed_over(&self) {
        let Some((_, progress)) = &self.response else { return };
        progress.since_ms.store(self.activity.elapsed_ms(), Ordering::Relaxed);
        let written_bytes = self.activity.written_bytes.load(Ordering::Relaxed);
        progress.written_bytes.store(written_bytes, Ordering::Relaxed);
        progress.is_held_back.store(true, Ordering::Release);
    }

    /// The connection asks for the next part: it has sent the one before.
    fn asked_for_more(&self) {
        if let Some((_, progress)) = &self.response {
            progress.is_held_back.store(false, Ordering::Release);
        }
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        let mut open = self.activity.lock();
        open.requests -= 1;
        if open.requests == 0 {
            open.idle_since = Instant::now();
        }
        if let Some((number, _)) = &self.response {
            open.responses.remove(number);
        }
    }
}

/// A response's body that tells the connection's [`Activity`] how it is taken.
pub(super) struct ObservedBody<G> {
    body: Body,
    request: OpenRequest,
    /// Counted by the status in the trailers.
    call: Option<RpcCall>,
    /// The grants that the request holds until its response has ended.
    _held: G,
}

impl<G> ObservedBody<G> {
    pub(super) fn new(body: Body, mut request: OpenRequest, call: Option<RpcCall>, held: G) -> Self {
        // A body of known length is handed over at once; the deadline of writes covers it.
        if body.size_hint().exact().is_none() {
            request.streams();
        }
        Self { body, request, call, _held: held }
    }
}

impl<G: Unpin> HttpBody for ObservedBody<G> {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        self.request.asked_for_more();
        let polled = Pin::new(&mut self.body).poll_frame(context);
        if polled.is_ready() {
            self.request.handed_over();
        }
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(status) = frame.trailers_ref().and_then(|trailers| trailers.get(GRPC_STATUS))
            && let Some(call) = &mut self.call
        {
            call.ended(status.as_bytes());
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
