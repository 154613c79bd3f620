//! Connections: accepted up to a limit, each with a deadline for everything that a client may leave
//! half done, and closed when it is no longer needed.
//!
//! `axum::serve` sets no deadlines: a half-sent header would stay open without end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::{Instant, MissedTickBehavior};
use tower::Service as _;

use super::activity::Activity;
use super::connection_gate::ConnectionGate;
use super::guarded_stream::GuardedStream;
use super::peer::Peer;
use super::pipeline::RequestPipeline;
use super::tls::{HANDSHAKE_RECORD, Tls};
use crate::admission::{ClientId, Quota};
use crate::config::Limits;
use crate::shutdown::Shutdown;
use crate::telemetry::CloseReason;

/// Connections that the system may complete before they are accepted.
const BACKLOG: u32 = 4_096;
/// Connections beyond the limit at a time, which get an answer: probes theirs, all else a refusal.
const EXCESS_CONNECTIONS: usize = 128;
/// hyper cannot work with a smaller buffer.
const SMALLEST_BUFFER: u32 = 8 << 10;
/// Time for the answer to a keep-alive ping.
const PING_TIME: Duration = Duration::from_secs(10);
/// Bytes of one HTTP/2 stream that wait for a client who does not read.
const SEND_BUFFER: usize = 128 << 10;
/// How often a connection is looked at, to close it in time if it is no longer needed.
const LOOKS_PER_IDLE_TIME: u32 = 8;
/// Time for the last bytes of a connection that is dropped by the shutdown.
const LAST_BYTES_TIME: Duration = Duration::from_millis(500);

/// Takes the address.
///
/// # Errors
/// The system's, for an address that is taken or not this machine's.
pub(super) fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
    // A server that is started again finds connections of the one before in TIME_WAIT.
    #[cfg(not(windows))]
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

/// Accepts the connections of one listener.
pub(super) struct Acceptor {
    pub(super) pipeline: Arc<RequestPipeline>,
    pub(super) tls: Option<Arc<Tls>>,
    /// Bounds how often an address connects, where clients do.
    pub(super) gate: Option<Arc<ConnectionGate>>,
}

impl Acceptor {
    /// Accepts connections until the shutdown begins.
    pub(super) async fn accept(self, listener: TcpListener, limits: &Limits, shutdown: &Shutdown) {
        let server = Arc::new(ConnectionServer {
            builder: builder(limits),
            acceptor: self,
            limits: limits.clone(),
            shutdown: shutdown.clone(),
        });
        let connections = Quota::new("connections", limits.connections, limits.client_share);
        let excess = Quota::new("connections", EXCESS_CONNECTIONS, limits.client_share);
        while let Some((stream, address)) = next_connection(&listener, shutdown).await {
            let client = ClientId::from(address.ip());
            let metrics = server.acceptor.pipeline.metrics();
            if let Some(gate) = &server.acceptor.gate
                && let Some(until) = gate.refused_until(address.ip(), Instant::now())
            {
                metrics.connection_refused();
                gate.hold(stream, client, until, shutdown);
                continue;
            }
            let (lease, refusal) = match connections.try_acquire(client, 1) {
                Ok(lease) => (lease, None),
                Err(error) => {
                    metrics.connection_refused();
                    let Ok(lease) = excess.try_acquire(client, 1) else { continue };
                    (lease, Some(Arc::new(error)))
                }
            };
            let server = server.clone();
            shutdown.spawn(async move {
                let peer =
                    Peer { address: address.ip().to_canonical(), certificate: None, is_tls: false, refusal };
                server.serve(stream, peer).await;
                drop(lease);
            });
        }
    }
}

/// The next connection; `None` once the shutdown begins.
async fn next_connection(listener: &TcpListener, shutdown: &Shutdown) -> Option<(TcpStream, SocketAddr)> {
    loop {
        let accepted = tokio::select! {
            () = shutdown.draining() => return None,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok(accepted) => return Some(accepted),
            Err(error) => {
                // Out of file descriptors, mostly: wait until some are given back.
                tracing::warn!(%error, "cannot accept a connection");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
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

/// The state that all connections share.
struct ConnectionServer {
    builder: Builder<TokioExecutor>,
    acceptor: Acceptor,
    limits: Limits,
    shutdown: Shutdown,
}

impl ConnectionServer {
    /// Serves a connection, over TLS where that is set up; plain HTTP is then for this machine alone.
    async fn serve(&self, stream: TcpStream, mut peer: Peer) {
        // Answers are written whole; waiting to fill a packet only delays them.
        let _ = stream.set_nodelay(true);
        let _open = self.acceptor.pipeline.metrics().connection();
        let Some(tls) = &self.acceptor.tls else { return self.serve_http(stream, peer).await };
        let is_tls = async {
            let mut first = [0];
            Ok::<_, std::io::Error>(stream.peek(&mut first).await? > 0 && first[0] == HANDSHAKE_RECORD)
        };
        match self.in_time(is_tls).await {
            Some(true) => {
                let Some((stream, certificate)) = self.in_time(tls.accept(stream)).await else { return };
                peer.certificate = certificate;
                peer.is_tls = true;
                // On the heap: plain connections need no room for what TLS holds.
                Box::pin(self.serve_http(stream, peer)).await;
            }
            Some(false) if is_of_this_machine(&stream, &peer) => self.serve_http(stream, peer).await,
            Some(false) => {
                tracing::debug!(client = %peer.address, "plain HTTP is not served to other machines")
            }
            None => {}
        }
    }

    /// The first bytes of a connection, if they arrive within the time limit of request headers.
    async fn in_time<T>(&self, begin: impl Future<Output = std::io::Result<T>>) -> Option<T> {
        let begun = tokio::select! {
            begun = tokio::time::timeout(self.limits.header_time(), begin) => begun,
            () = self.shutdown.draining() => return None,
        };
        match begun {
            Ok(Ok(begun)) => Some(begun),
            Ok(Err(error)) => {
                tracing::debug!(%error, "a connection could not be begun");
                None
            }
            Err(_) => None,
        }
    }

    async fn serve_http<S>(&self, stream: S, peer: Peer)
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let metrics = self.acceptor.pipeline.metrics();
        let activity = Activity::new();
        let mut closing = Closing::new(&self.limits, peer.refusal.is_some());
        let stream = TokioIo::new(GuardedStream::new(stream, &self.limits, activity.clone()));
        let address = peer.address;
        let layers = self.acceptor.pipeline.clone().service(peer, activity.clone());
        // hyper holds a place as large as this future as long as an HTTP/1 connection is open.
        let service = service_fn(move |request| Box::pin(layers.clone().call(request)));
        let mut connection = std::pin::pin!(self.builder.serve_connection(stream, service));
        let mut looks = tokio::time::interval(self.limits.idle_time() / LOOKS_PER_IDLE_TIME);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut is_draining = false;
        let reason = loop {
            tokio::select! {
                ended = connection.as_mut() => break match ended {
                    Err(error) if is_flood(&*error) => Some(CloseReason::Flooded),
                    // A connection that breaks is the client's affair.
                    _ => closing.reason,
                },
                () = self.shutdown.draining(), if !is_draining => {
                    connection.as_mut().graceful_shutdown();
                    is_draining = true;
                }
                () = self.shutdown.forced() => {
                    let _ = tokio::time::timeout(LAST_BYTES_TIME, connection.as_mut()).await;
                    break Some(CloseReason::Shutdown);
                }
                _ = looks.tick() => match closing.next(&activity) {
                    ConnectionAction::Keep => {}
                    ConnectionAction::Finish => connection.as_mut().graceful_shutdown(),
                    ConnectionAction::Drop => break closing.reason,
                },
            }
        };
        if let Some(reason) = activity.given_up().or(reason) {
            tracing::debug!(?reason, "closed a connection");
            metrics.connection_closed(reason);
            if let (CloseReason::Flooded, Some(gate)) = (reason, &self.acceptor.gate) {
                gate.flooded(address, Instant::now());
            }
        }
    }
}

/// True if the library ended a connection for a flood, such as of streams that are reset at once.
fn is_flood(error: &(dyn std::error::Error + 'static)) -> bool {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes
        .filter_map(|error| error.downcast_ref::<h2::Error>())
        .any(|error| error.is_library() && error.reason() == Some(h2::Reason::ENHANCE_YOUR_CALM))
}

/// True if the client is on this machine, by either of its addresses.
fn is_of_this_machine(stream: &TcpStream, peer: &Peer) -> bool {
    let is_own = |own: SocketAddr| own.ip().to_canonical() == peer.address;
    peer.address.is_loopback() || stream.local_addr().is_ok_and(is_own)
}

/// Decides when a connection is no longer needed.
struct Closing {
    idle_time: Duration,
    bytes_per_s: u64,
    /// Time for the client's part in closing the connection in order.
    finish_time: Duration,
    dropped_at: Option<Instant>,
    reason: Option<CloseReason>,
}

/// The next action for a connection.
enum ConnectionAction {
    Keep,
    /// Let open requests end and take no new ones.
    Finish,
    Drop,
}

impl Closing {
    /// A connection beyond the limit is to end soon in any case.
    fn new(limits: &Limits, is_excess: bool) -> Self {
        let finish_time = limits.header_time();
        Self {
            idle_time: limits.idle_time(),
            bytes_per_s: limits.body_bytes_per_s,
            finish_time,
            dropped_at: is_excess.then(|| Instant::now() + finish_time),
            reason: None,
        }
    }

    fn next(&mut self, activity: &Activity) -> ConnectionAction {
        if self.dropped_at.is_some_and(|at| Instant::now() >= at) {
            return ConnectionAction::Drop;
        }
        match activity.close_reason(self.idle_time, self.bytes_per_s) {
            Some(CloseReason::Idle) if self.reason.is_none() => {
                self.reason = Some(CloseReason::Idle);
                self.dropped_at = Some(Instant::now() + self.finish_time);
                ConnectionAction::Finish
            }
            Some(CloseReason::Stalled) => {
                self.reason = Some(CloseReason::Stalled);
                ConnectionAction::Drop
            }
            _ => ConnectionAction::Keep,
        }
    }
}
