//! A request's body on its way in: at a least rate, within the memory of all requests, and worked on
//! only once a place is free.
//!
//! A slow upload holds memory for what it has sent, never a place among the requests at work: that is
//! taken when the last byte has come.

use std::fmt;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use hyper::body::{Body, Frame, Incoming, SizeHint};
use tokio::time::{Instant, Sleep};

use crate::domain::{Error, ErrorKind, Result};
use crate::request::RequestContext;

/// The body of a request.
pub(super) struct AdmittedBody {
    /// `None` once it has ended.
    body: Option<Incoming>,
    context: RequestContext,
    /// `None` for a body that may be silent.
    pace: Option<RateGuard>,
}

impl AdmittedBody {
    pub(super) const fn new(body: Incoming, context: RequestContext, pace: Option<RateGuard>) -> Self {
        Self { body: Some(body), context, pace }
    }

    /// Counts a frame, the last one of the body or not.
    fn receive(&mut self, frame: &Frame<Bytes>, is_last: bool) -> Result<()> {
        let bytes = frame.data_ref().map_or(0, Bytes::len) as u64;
        if let Some(pace) = &mut self.pace {
            pace.received(bytes);
        }
        // Readers that know the length do not ask for the end.
        self.context.receive(bytes, is_last)
    }

    /// Ends the body with an error, which the context knows.
    fn refuse(&mut self, error: Error) -> Poll<Option<Result<Frame<Bytes>, BodyRefused>>> {
        self.context.refuse_body(&error);
        Poll::Ready(Some(Err(BodyRefused)))
    }
}

impl Body for AdmittedBody {
    type Data = Bytes;
    type Error = BodyRefused;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BodyRefused>>> {
        let this = &mut *self;
        let Some(mut body) = this.body.take() else { return Poll::Ready(None) };
        if let Err(error) = this.context.caller().check_active() {
            return this.refuse(error);
        }
        match Pin::new(&mut body).poll_frame(context) {
            Poll::Ready(Some(Ok(frame))) => match this.receive(&frame, body.is_end_stream()) {
                Ok(()) => {
                    this.body = Some(body);
                    Poll::Ready(Some(Ok(frame)))
                }
                Err(error) => {
                    this.context.leave(body);
                    this.refuse(error)
                }
            },
            Poll::Ready(Some(Err(error))) => {
                let message = format!("the body is incomplete: {error}");
                this.refuse(Error::refused(ErrorKind::Cancelled, message))
            }
            Poll::Ready(None) => match this.context.begin_work() {
                Ok(()) => Poll::Ready(None),
                Err(error) => this.refuse(error),
            },
            Poll::Pending => match this.pace.as_mut().map(|pace| pace.poll_too_slow(context)) {
                Some(Poll::Ready(error)) => this.refuse(error),
                Some(Poll::Pending) | None => {
                    this.body = Some(body);
                    Poll::Pending
                }
            },
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.as_ref().is_none_or(Body::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.body.as_ref().map_or_else(|| SizeHint::with_exact(0), Body::size_hint)
    }
}

/// Leaves the unread rest to the layer that admits requests.
impl Drop for AdmittedBody {
    fn drop(&mut self) {
        if let Some(rest) = self.body.take().filter(|body| !body.is_end_stream()) {
            self.context.leave(rest);
        }
    }
}

/// Tells a reader of the body that it was refused; the context knows why.
#[derive(Debug)]
pub(super) struct BodyRefused;

impl fmt::Display for BodyRefused {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the body was refused")
    }
}

impl std::error::Error for BodyRefused {}

/// Holds a body to a least rate. Only time in which the server waits for the client counts.
pub(super) struct RateGuard {
    rate: LeastRate,
    waiting_since: Option<Instant>,
    deadline: Option<Pin<Box<Sleep>>>,
}

impl RateGuard {
    /// Every `window` of waiting must bring `bytes_per_s` on average.
    pub(super) const fn new(window: Duration, bytes_per_s: u64) -> Self {
        Self { rate: LeastRate::new(window, bytes_per_s), waiting_since: None, deadline: None }
    }

    fn received(&mut self, bytes: u64) {
        if let Some(since) = self.waiting_since.take() {
            self.rate.waited += since.elapsed();
        }
        self.rate.received += bytes;
    }

    /// Ready with a refusal once a window brought too little.
    fn poll_too_slow(&mut self, context: &mut Context<'_>) -> Poll<Error> {
        loop {
            let now = Instant::now();
            if let Some(since) = self.waiting_since.replace(now) {
                self.rate.waited += now.duration_since(since);
            }
            if !self.rate.holds() {
                return Poll::Ready(self.rate.too_slow());
            }
            let end = now + self.rate.remaining();
            let deadline = self.deadline.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(end)));
            if deadline.deadline() != end {
                deadline.as_mut().reset(end);
            }
            ready!(deadline.as_mut().poll(context));
        }
    }
}

/// Bytes per second over one window of waiting after another.
struct LeastRate {
    window: Duration,
    bytes_per_s: u64,
    received: u64,
    waited: Duration,
}

impl LeastRate {
    const fn new(window: Duration, bytes_per_s: u64) -> Self {
        Self { window, bytes_per_s, received: 0, waited: Duration::ZERO }
    }

    /// True if a window that is over brought enough; begins the next one.
    fn holds(&mut self) -> bool {
        if self.waited < self.window {
            return true;
        }
        let holds = self.received >= self.bytes_per_s.saturating_mul(self.window.as_secs()).max(1);
        if holds {
            self.received = 0;
            self.waited = Duration::ZERO;
        }
        holds
    }

    /// Time of waiting until the window is over.
    fn remaining(&self) -> Duration {
        self.window.saturating_sub(self.waited)
    }

    fn too_slow(&self) -> Error {
        let (received, seconds) = (self.received, self.window.as_secs());
        let message = format!(
            "the body came too slowly: {received} bytes in {seconds} s, at least {} per second are needed",
            self.bytes_per_s
        );
        Error::refused(ErrorKind::Timeout, message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: Duration = Duration::from_secs(10);

    /// True if the rate holds when `bytes` bytes come after each of these times of waiting.
    fn holds(bytes: u64, waits_s: &[u64]) -> bool {
        let mut rate = LeastRate::new(WINDOW, 10);
        waits_s.iter().all(|&wait_s| {
            rate.waited += Duration::from_secs(wait_s);
            let holds = rate.holds();
            rate.received += bytes;
            holds
        })
    }

    #[test]
    fn a_body_that_trickles_is_refused_and_a_steady_one_is_not() {
        assert!(holds(60, &[0, 5, 5, 5, 5, 5, 5]), "60 bytes in 5 s");
        assert!(!holds(20, &[0, 5, 5]), "20 bytes in 5 s");
        assert!(!holds(60, &[0, 5, 5, 5, 5, 10]), "silence after a steady begin");
        assert!(holds(1, &[0, 0, 0, 9]), "the first window is not over");
        assert!(!holds(0, &[10]), "nothing at all");
    }
}
