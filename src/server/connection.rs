//! Connections: accepted up to a limit, each with a timer on everything a client may leave half done.
//!
//! `axum::serve` sets no timers: a half-sent header would stay open for ever. hyper's own timer
//! begins when it knows the protocol, so the first bytes have a deadline of their own here.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, Sleep};

use super::entrance::Entrance;
use crate::config::Limits;
use crate::shutdown::Shutdown;

/// hyper cannot work with a smaller buffer.
const SMALLEST_BUFFER: u32 = 8 << 10;
/// Time for the answer to a keep-alive ping.
const PING_TIME: Duration = Duration::from_secs(10);
/// Bytes of one HTTP/2 stream that wait for a client who does not read.
const SEND_BUFFER: usize = 128 << 10;

/// Accepts connections until the shutdown begins.
pub(super) async fn accept(
    listener: TcpListener,
    entrance: Arc<Entrance>,
    limits: &Limits,
    shutdown: &Shutdown,
) {
    let builder = builder(limits);
    let header_time = limits.header_time();
    let places = Arc::new(Semaphore::new(limits.connections));
    loop {
        let place = places.clone().acquire_owned();
        let place = tokio::select! {
            () = shutdown.begun() => return,
            place = place => place.expect("the semaphore is never closed"),
        };
        let stream = tokio::select! {
            () = shutdown.begun() => return,
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => stream,
                Err(error) => {
                    // Out of file descriptors, mostly: wait until some are given back.
                    tracing::warn!(%error, "cannot accept a connection");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                }
            },
        };
        let (builder, entrance, ending) = (builder.clone(), entrance.clone(), shutdown.clone());
        shutdown.spawn(async move {
            serve(stream, &builder, entrance, header_time, &ending).await;
            drop(place);
        });
    }
}

fn builder(limits: &Limits) -> Builder<TokioExecutor> {
    let mut builder = Builder::new(TokioExecutor::new());
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.header_time())
        .max_buf_size(limits.header_bytes.max(SMALLEST_BUFFER) as usize);
    builder
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(limits.idle_time())
        .keep_alive_timeout(PING_TIME)
        .max_concurrent_streams(limits.streams_per_connection)
        .max_send_buf_size(SEND_BUFFER)
        .max_header_list_size(limits.header_bytes);
    builder
}

async fn serve(
    stream: TcpStream,
    builder: &Builder<TokioExecutor>,
    entrance: Arc<Entrance>,
    header_time: Duration,
    shutdown: &Shutdown,
) {
    // Answers are written whole; waiting to fill a packet only delays them.
    let _ = stream.set_nodelay(true);
    let _open = entrance.metrics().connection();
    let service = service_fn(move |request| {
        let entrance = entrance.clone();
        async move { Ok::<_, std::convert::Infallible>(entrance.answer(request).await) }
    });
    let stream = TokioIo::new(Greeted::new(stream, header_time));
    let mut connection = std::pin::pin!(builder.serve_connection(stream, service));
    tokio::select! {
        // A connection that breaks is the client's affair.
        _ = connection.as_mut() => return,
        () = shutdown.begun() => connection.as_mut().graceful_shutdown(),
    }
    tokio::select! {
        _ = connection => {}
        () = shutdown.overdue() => {}
    }
}

/// A stream whose first bytes, enough to tell HTTP/1 from HTTP/2, must come in time.
struct Greeted {
    stream: TcpStream,
    missing: usize,
    deadline: Option<Pin<Box<Sleep>>>,
}

impl Greeted {
    /// Length of HTTP/2's preface.
    const PREFACE: usize = 24;

    fn new(stream: TcpStream, within: Duration) -> Self {
        let deadline = Some(Box::pin(tokio::time::sleep_until(Instant::now() + within)));
        Self { stream, missing: Self::PREFACE, deadline }
    }
}

impl AsyncRead for Greeted {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        let Some(deadline) = &mut self.deadline else { return read };
        if read.is_pending() {
            ready!(deadline.as_mut().poll(context));
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        self.missing = self.missing.saturating_sub(buffer.filled().len() - before);
        if self.missing == 0 {
            self.deadline = None;
        }
        read
    }
}

impl AsyncWrite for Greeted {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
