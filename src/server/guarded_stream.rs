//! A client's stream, over TLS or not, with a deadline for its first bytes, one for every write that makes no
//! progress, a limit on HTTP/2 control frames, and a close that waits for what the client still sends.

use std::io;
use std::mem::MaybeUninit;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

use super::activity::Activity;
use super::frame_limit::{FrameLimit, PREFACE};
use crate::config::Limits;
use crate::telemetry::CloseReason;

/// How long what the client still sends is read and discarded after the server's last byte. The kernel resets a
/// connection that is closed with unread bytes, and the reset may overtake the last answer (RFC 9112, section 9.6).
const LINGER_TIME: Duration = Duration::from_secs(1);

/// Bytes that are discarded at once.
const DISCARDED_BYTES: usize = 4 << 10;

pub(super) struct GuardedStream<S> {
    stream: S,
    activity: Arc<Activity>,
    frames: FrameLimit,
    /// Bytes missing until HTTP/1 and HTTP/2 can be distinguished. hyper's own timers begin
    /// only then.
    missing: usize,
    first_bytes: Option<Pin<Box<Sleep>>>,
    write_time: Duration,
    /// Runs while the client takes nothing of what is written.
    write: Option<Pin<Box<Sleep>>>,
    /// Runs from the server's last byte.
    linger: Option<Pin<Box<Sleep>>>,
}

impl<S> GuardedStream<S> {
    pub(super) fn new(stream: S, limits: &Limits, activity: Arc<Activity>) -> Self {
        Self {
            stream,
            activity,
            frames: FrameLimit::new(limits.control_frames_per_s),
            missing: PREFACE.len(),
            first_bytes: Some(Box::pin(tokio::time::sleep(limits.header_time()))),
            write_time: limits.idle_time(),
            write: None,
            linger: None,
        }
    }

    fn after_write(
        &mut self,
        context: &mut Context<'_>,
        written: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(written) = written {
            self.write = None;
            if let Ok(bytes) = written {
                self.activity.wrote(bytes);
            }
            return Poll::Ready(written);
        }
        let time = self.write_time;
        let deadline = self.write.get_or_insert_with(|| Box::pin(tokio::time::sleep(time)));
        ready!(deadline.as_mut().poll(context));
        self.activity.give_up(CloseReason::Stalled);
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for GuardedStream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if read.is_pending() {
            let Some(deadline) = &mut self.first_bytes else { return Poll::Pending };
            ready!(deadline.as_mut().poll(context));
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        let bytes = &buffer.filled()[before..];
        if self.first_bytes.is_some() {
            self.missing = self.missing.saturating_sub(bytes.len());
            if self.missing == 0 {
                self.first_bytes = None;
            }
        }
        if !self.frames.allows(bytes) {
            self.activity.give_up(CloseReason::Flooded);
            return Poll::Ready(Err(io::Error::other("too many HTTP/2 control frames")));
        }
        read
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for GuardedStream<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.after_write(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, bytes);
        self.after_write(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    /// Ends the server's side, and waits until the client has ended its own, for at most [`LINGER_TIME`].
    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { stream, linger, .. } = &mut *self;
        if linger.is_none() {
            ready!(Pin::new(&mut *stream).poll_shutdown(context))?;
        }
        let deadline = linger.get_or_insert_with(|| Box::pin(tokio::time::sleep(LINGER_TIME)));
        let mut discarded = [MaybeUninit::uninit(); DISCARDED_BYTES];
        while deadline.as_mut().poll(context).is_pending() {
            let mut buffer = ReadBuf::uninit(&mut discarded);
            let read = ready!(Pin::new(&mut *stream).poll_read(context, &mut buffer));
            if read.is_err() || buffer.filled().is_empty() {
                break;
            }
        }
        Poll::Ready(Ok(()))
    }
}
