//! Requests that another node answers, sent on to it where the setting `camera_on_other_node` is `proxy`.
//!
//! A request is answered here first. If the answer is that another node has the camera, the request goes there: what was
//! read of its body, which is recorded until the answer begins, then the rest. So this file knows no route, and a request
//! that this node answers costs the record alone. Imports are not recorded: any node stores them.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use anyhow::Context as _;
use axum::body::Body;
use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use http_body_util::BodyExt as _;
use hyper::body::{Body as HttpBody, Frame, Incoming};
use hyper::client::conn::http2;
use hyper::header::{CONNECTION, COOKIE, HOST, LOCATION, TE, TRANSFER_ENCODING, UPGRADE};
use hyper::http::request::Parts;
use hyper::http::uri::{PathAndQuery, Scheme};
use hyper::http::{HeaderName, HeaderValue};
use hyper::{HeaderMap, Request, Response, StatusCode, Uri};
use hyper_util::rt::{TokioExecutor, TokioIo};
use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use super::activity::GRPC_STATUS;
use super::forwarded_answer::ForwardedAnswer;
use super::proxies::{X_FORWARDED_FOR, X_FORWARDED_PROTO};
use crate::admission::{Lease, RequestClass};
use crate::domain::Error;
use crate::grpc;
use crate::request::RequestContext;
use crate::shutdown::Shutdown;
use crate::tls_client::{authorities, client_config};

/// Marks a request that was sent on, which no node sends on again.
const FORWARDED: HeaderName = HeaderName::from_static("x-sightfix-forwarded");
/// Headers of one connection (RFC 9110, 7.6.1), or replaced by those of the request to the other node.
const OF_ONE_CONNECTION: [HeaderName; 5] = [CONNECTION, HOST, TE, TRANSFER_ENCODING, UPGRADE];
/// Time to open a connection to another node, its handshakes included.
const OPEN_TIME: Duration = Duration::from_secs(3);

/// Sends requests on to the nodes that answer them.
pub(super) struct Forwarder {
    tls: Arc<ClientConfig>,
    /// Longest part of a body that is recorded, bytes.
    record_bytes: usize,
    shutdown: Shutdown,
}

impl Forwarder {
    /// # Errors
    /// TLS cannot be configured.
    pub(super) fn new(record_bytes: usize, shutdown: &Shutdown) -> anyhow::Result<Self> {
        let mut tls = Arc::unwrap_or_clone(client_config(authorities(None)?, None)?);
        tls.alpn_protocols = vec![b"h2".to_vec()];
        Ok(Self { tls: Arc::new(tls), record_bytes, shutdown: shutdown.clone() })
    }

    /// The answer of this node, or that of the node which it names.
    pub(super) async fn answer<F>(
        &self,
        request: Request<Body>,
        context: &RequestContext,
        memory: Result<Lease, Error>,
        answer_here: impl FnOnce(Request<Body>) -> F,
    ) -> Result<Response<Body>, Infallible>
    where
        F: Future<Output = Result<Response<Body>, Infallible>>,
    {
        // Sessions of browsers are those of one node.
        let is_own = request.headers().contains_key(FORWARDED) || request.headers().contains_key(COOKIE);
        if is_own || matches!(context.class(), RequestClass::Import | RequestClass::ImportStream) {
            return answer_here(request).await;
        }
        let (parts, body) = request.into_parts();
        let is_live = context.class() == RequestClass::LiveStream;
        let record = Record::of(body, self.record_bytes, memory.ok());
        let head = copy_of(&parts, context);
        let recorded = Request::from_parts(parts, Body::new(RecordedBody(record.clone())));
        let here = answer_here(recorded).await?;
        let (here, owner) = owner_of(here, context.is_grpc(), is_live).await;
        let Some(owner) = owner else {
            record.stop();
            return Ok(here);
        };
        let Some(body) = record.replay() else { return Ok(here) };
        let body = if is_live { body.ended_by(self.shutdown.clone()) } else { body };
        match self.send(&owner, head, body).await {
            Ok(answer) => Ok(answer.map(|body| self.passed_on(body, context))),
            Err(error) => {
                tracing::warn!(%owner, error = format!("{error:#}"), "a request could not be sent on to the node that has its camera");
                Ok(here)
            }
        }
    }

    fn passed_on(&self, body: Incoming, context: &RequestContext) -> Body {
        if !context.is_grpc() {
            return Body::new(body);
        }
        let answer = ForwardedAnswer::new(body, context.clone());
        let is_live = context.class() == RequestClass::LiveStream;
        Body::new(if is_live { answer.until_drained(self.shutdown.clone()) } else { answer })
    }

    async fn send(&self, owner: &Uri, head: Parts, body: Replay) -> anyhow::Result<Response<Incoming>> {
        let opened =
            tokio::time::timeout(OPEN_TIME, self.open(owner)).await.context("no connection in time")?;
        let (mut sender, connection) = http2::handshake(TokioExecutor::new(), TokioIo::new(opened?)).await?;
        self.shutdown.spawn(async move {
            // Its end is seen by the response.
            let _ = connection.await;
        });
        let mut uri = owner.clone().into_parts();
        uri.path_and_query = head.uri.path_and_query().cloned();
        let mut request = Request::new(body);
        *request.method_mut() = head.method;
        *request.uri_mut() = Uri::from_parts(uri)?;
        *request.headers_mut() = head.headers;
        Ok(sender.send_request(request).await?)
    }

    async fn open(&self, owner: &Uri) -> anyhow::Result<Box<dyn ByteStream>> {
        let host = owner.host().context("its address has no host")?;
        let is_encrypted = owner.scheme() == Some(&Scheme::HTTPS);
        let port = owner.port_u16().unwrap_or(if is_encrypted { 443 } else { 80 });
        let host = host.trim_matches(['[', ']']);
        let stream = TcpStream::connect((host, port)).await?;
        stream.set_nodelay(true)?;
        if !is_encrypted {
            return Ok(Box::new(stream));
        }
        let name = ServerName::try_from(host.to_owned())?;
        Ok(Box::new(TlsConnector::from(Arc::clone(&self.tls)).connect(name, stream).await?))
    }
}

trait ByteStream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Send + Unpin> ByteStream for S {}

/// The head of a request as another node gets it.
fn copy_of(parts: &Parts, context: &RequestContext) -> Parts {
    let (mut copy, ()) = Request::new(()).into_parts();
    copy.method = parts.method.clone();
    copy.uri = parts.uri.clone();
    copy.headers = parts.headers.clone();
    for name in OF_ONE_CONNECTION {
        copy.headers.remove(name);
    }
    // The other node may trust this one, which is no word for what the client claims.
    copy.headers.remove(X_FORWARDED_FOR);
    copy.headers.remove(X_FORWARDED_PROTO);
    if let Ok(address) = HeaderValue::from_str(&context.address().to_string()) {
        copy.headers.insert(X_FORWARDED_FOR, address);
    }
    if let Ok(scheme) = HeaderValue::from_str(context.scheme().as_str()) {
        copy.headers.insert(X_FORWARDED_PROTO, scheme);
    }
    copy.headers.insert(FORWARDED, HeaderValue::from_static("1"));
    copy.headers.insert(TE, HeaderValue::from_static("trailers"));
    copy
}

/// The answer as it is, and the address of the node that it names. A live stream may end with that in its first frame.
async fn owner_of(response: Response<Body>, is_grpc: bool, is_live: bool) -> (Response<Body>, Option<Uri>) {
    if !is_grpc {
        let is_redirection = response.status() == StatusCode::TEMPORARY_REDIRECT;
        let location = response.headers().get(LOCATION).filter(|_| is_redirection);
        let owner = location.and_then(|location| node_address(location.to_str().ok()?));
        return (response, owner);
    }
    if response.headers().contains_key(GRPC_STATUS) {
        let owner = grpc_owner(response.headers());
        return (response, owner);
    }
    if !is_live {
        return (response, None);
    }
    let (parts, mut body) = response.into_parts();
    let Some(first) = body.frame().await else {
        return (Response::from_parts(parts, body), None);
    };
    let owner = first.as_ref().ok().and_then(Frame::trailers_ref).and_then(grpc_owner);
    let body = Body::new(Replay { read: VecDeque::from([first]), rest: body, end: None, memory: None });
    (Response::from_parts(parts, body), owner)
}

fn grpc_owner(headers: &HeaderMap) -> Option<Uri> {
    node_address(&grpc::owner(headers)?)
}

/// Scheme and host of an absolute address.
fn node_address(address: &str) -> Option<Uri> {
    let mut parts = address.parse::<Uri>().ok()?.into_parts();
    parts.path_and_query = Some(PathAndQuery::from_static("/"));
    Uri::from_parts(parts).ok().filter(|uri| uri.host().is_some() && uri.scheme().is_some())
}

/// A body, and what was read of it.
#[derive(Clone)]
struct Record(Arc<Mutex<Recorded>>);

struct Recorded {
    /// `None` once it belongs to the request to another node.
    rest: Option<Body>,
    /// `None` once more was read than is recorded.
    read: Option<VecDeque<Result<Frame<Bytes>, axum::Error>>>,
    /// How much more may be recorded, bytes.
    room_bytes: usize,
    /// The memory of the recorded bytes, as limits count it.
    memory: Option<Lease>,
}

impl Record {
    /// Records nothing where no memory is granted.
    fn of(body: Body, room_bytes: usize, memory: Option<Lease>) -> Self {
        let read = memory.is_some().then(VecDeque::new);
        Self(Arc::new(Mutex::new(Recorded { rest: Some(body), read, room_bytes, memory })))
    }

    fn lock(&self) -> MutexGuard<'_, Recorded> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Records nothing from now on.
    fn stop(&self) {
        self.lock().stop();
    }

    /// The whole body from its start, unless more was read than is recorded. The reader here gets nothing further of it.
    fn replay(&self) -> Option<Replay> {
        let mut recorded = self.lock();
        let read = recorded.read.take()?;
        let memory = recorded.memory.take();
        Some(Replay { read, rest: recorded.rest.take()?, end: None, memory })
    }
}

impl Recorded {
    fn record(&mut self, frame: &Frame<Bytes>) {
        let (Some(data), Some(read)) = (frame.data_ref(), &mut self.read) else { return };
        let is_counted = |memory: &mut Lease| memory.try_grow(data.len() as u64).is_ok();
        match self.room_bytes.checked_sub(data.len()) {
            Some(room_bytes) if self.memory.as_mut().is_some_and(is_counted) => {
                self.room_bytes = room_bytes;
                read.push_back(Ok(Frame::data(data.clone())));
            }
            _ => self.stop(),
        }
    }

    fn stop(&mut self) {
        self.read = None;
        self.memory = None;
    }
}

/// The body as this node reads it.
struct RecordedBody(Record);

impl HttpBody for RecordedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let mut recorded = self.0.lock();
        let Some(body) = &mut recorded.rest else {
            let gone = io::Error::other("another node answers the request");
            return Poll::Ready(Some(Err(axum::Error::new(gone))));
        };
        let frame = ready!(Pin::new(body).poll_frame(context));
        if let Some(Ok(frame)) = &frame {
            recorded.record(frame);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.0.lock().rest.as_ref().is_none_or(HttpBody::is_end_stream)
    }

    fn size_hint(&self) -> hyper::body::SizeHint {
        self.0.lock().rest.as_ref().map(HttpBody::size_hint).unwrap_or_default()
    }
}

/// A body from its start: what was read of it, then the rest.
struct Replay {
    read: VecDeque<Result<Frame<Bytes>, axum::Error>>,
    rest: Body,
    /// When it ends, whatever the client still sends.
    end: Option<BoxFuture<'static, ()>>,
    /// The memory of the bytes read, as limits count it.
    memory: Option<Lease>,
}

impl Replay {
    /// Ends the body of a live stream once this node drains and the client, which is asked to reconnect, has had time to end
    /// it: the other node then settles the stream and ends it in order.
    fn ended_by(self, shutdown: Shutdown) -> Self {
        let end = async move {
            shutdown.draining().await;
            tokio::time::sleep(grpc::HALF_CLOSE_GRACE).await;
        };
        Self { end: Some(Box::pin(end)), ..self }
    }
}

impl HttpBody for Replay {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if let Some(frame) = self.read.pop_front() {
            return Poll::Ready(Some(frame));
        }
        self.memory = None;
        if self.end.as_mut().is_some_and(|end| end.poll_unpin(context).is_ready()) {
            self.end = None;
            self.rest = Body::empty();
        }
        Pin::new(&mut self.rest).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.read.is_empty() && self.rest.is_end_stream()
    }
}
