//! What every request goes through, whatever its transport: id, span, host and origin, admission,
//! deadline, then the transport.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use http_body_util::BodyExt as _;
use hyper::body::{Body as _, Incoming};
use hyper::header::{CONNECTION, CONTENT_TYPE, EXPECT, X_CONTENT_TYPE_OPTIONS};
use hyper::http::HeaderValue;
use hyper::{Method, Request, Response, Version};
use tokio::sync::Semaphore;
use tower::Service as _;
use tracing::Instrument as _;

use super::activity::{ObservedBody, OpenRequest};
use super::host_check::HostCheck;
use super::request_body::{AdmittedBody, RateGuard, Ticket};
use crate::admission::{BodyRefusal, ClientAddress, RequestClass};
use crate::app::App;
use crate::config::Console;
use crate::domain::{Error, ErrorKind, Result};
use crate::shutdown::Shutdown;
use crate::telemetry::{Metrics, REQUEST_ID, RequestId};
use crate::{grpc, http};

/// Longest request id that is taken from a client, in bytes.
const LONGEST_REQUEST_ID: usize = 128;
/// Bodies of refused requests that are read to their end at a time; more clients are answered at once.
const DISCARDED_BODIES: usize = 256;
/// How long the body of a refused request is read.
const DISCARD_TIME: Duration = Duration::from_secs(10);

/// The way from a connection to the transports.
pub(super) struct RequestPipeline {
    app: App,
    http: Router,
    grpc: Router,
    hosts: HostCheck,
    shutdown: Shutdown,
    discards: Semaphore,
}

/// The connection that a request came over.
#[derive(Clone)]
pub(super) struct Peer {
    pub(super) client: ClientAddress,
    /// Why only probes are answered on it, if so.
    pub(super) refusal: Option<Arc<Error>>,
}

/// The body of every response; it holds the request's memory until its end.
pub(super) type ResponseBody = ObservedBody<Option<Ticket>>;

impl RequestPipeline {
    pub(super) fn new(app: App, console: Console, hosts: HostCheck, shutdown: &Shutdown) -> Self {
        Self {
            http: http::router(app.clone(), console, shutdown.clone()),
            grpc: grpc::router(&app, shutdown).into_axum_router(),
            hosts,
            shutdown: shutdown.clone(),
            discards: Semaphore::new(DISCARDED_BODIES),
            app,
        }
    }

    pub(super) fn metrics(&self) -> &Metrics {
        &self.app.metrics
    }

    /// Answers a request.
    pub(super) async fn answer(
        &self,
        request: Request<Incoming>,
        peer: &Peer,
        open: OpenRequest,
    ) -> Response<ResponseBody> {
        let began = Instant::now();
        let is_http_1 = request.version() < Version::HTTP_2;
        let id = self.request_id(&request);
        let is_grpc = request
            .headers()
            .get(CONTENT_TYPE)
            .is_some_and(|content_type| content_type.as_bytes().starts_with(b"application/grpc"));
        let span = tracing::debug_span!(
            "request", id = %id, method = %request.method(), path = request.uri().path()
        );
        let (mut response, ticket) = async {
            match self.admit(request, is_grpc, peer, &id).await {
                Ok((request, ticket)) => (self.route(is_grpc, request, &ticket, &id).await, Some(ticket)),
                Err(error) => {
                    if error.kind() == ErrorKind::Overloaded {
                        self.app.metrics.refused();
                    }
                    (refuse(is_grpc, &error, &id), None)
                }
            }
        }
        .instrument(span)
        .await;
        let headers = response.headers_mut();
        headers.insert(REQUEST_ID, id.header().clone());
        headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
        if peer.refusal.is_some() && is_http_1 {
            headers.insert(CONNECTION, HeaderValue::from_static("close"));
        }
        let time = began.elapsed();
        self.app.metrics.answered(response.status().as_u16(), time);
        tracing::debug!(id = %id, status = response.status().as_u16(), duration_ms = time.as_secs_f64() * 1e3);
        response.map(|body| ObservedBody::new(body, open, ticket))
    }

    /// The request as the transports get it, with what it was granted; the body of a refused one is
    /// read to its end before.
    async fn admit(
        &self,
        request: Request<Incoming>,
        is_grpc: bool,
        peer: &Peer,
        id: &RequestId,
    ) -> Result<(Request<Body>, Ticket)> {
        let path = request.uri().path();
        let class = if is_grpc { grpc::class(path) } else { http::class(request.method(), path) };
        match self.grant(&request, class, is_grpc, peer) {
            Ok(ticket) => {
                let limits = &self.app.limits;
                // A live stream may be silent for longer, and looks after that itself.
                let pace = (class != RequestClass::LiveStream)
                    .then(|| RateGuard::new(limits.body_grace(), limits.body_bytes_per_s));
                let mut request =
                    request.map(|body| Body::new(AdmittedBody::new(body, ticket.clone(), pace)));
                let extensions = request.extensions_mut();
                extensions.insert(id.clone());
                extensions.insert(peer.client);
                if class == RequestClass::ImportStream {
                    extensions.insert(ticket.refusal());
                }
                Ok((request, ticket))
            }
            Err(error) => {
                self.discard(request).await;
                Err(error)
            }
        }
    }

    fn grant(
        &self,
        request: &Request<Incoming>,
        class: RequestClass,
        is_grpc: bool,
        peer: &Peer,
    ) -> Result<Ticket> {
        if let Some(Error::Refused(refusal)) = peer.refusal.as_deref()
            && class != RequestClass::Probe
        {
            return Err(Error::Refused(refusal.clone()));
        }
        self.hosts.check(request)?;
        let limits = &self.app.limits;
        let held_bytes = match class {
            // Spooled, or read message by message, each with limits of its own.
            RequestClass::Import | RequestClass::ImportStream | RequestClass::LiveStream => 0,
            _ if is_grpc => limits.message_bytes,
            _ => limits.body_bytes,
        };
        let ticket = Ticket::open(&self.app, class, peer.client, held_bytes)?;
        let has_no_body = request.body().is_end_stream()
            || matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE | Method::OPTIONS);
        if has_no_body || class == RequestClass::ImportStream {
            ticket.begin_work()?;
        }
        Ok(ticket)
    }

    async fn route(
        &self,
        is_grpc: bool,
        request: Request<Body>,
        ticket: &Ticket,
        id: &RequestId,
    ) -> Response<Body> {
        let time = Duration::from_secs(self.app.limits.request_s);
        // An import stream reports by itself what it has stored of a body that was refused.
        let reports_refusal = request.extensions().get::<BodyRefusal>().is_some();
        let mut transport = if is_grpc { self.grpc.clone() } else { self.http.clone() };
        let answer = tokio::select! {
            biased;
            answer = tokio::time::timeout(time, transport.call(request)) => answer.map_err(|_| too_slow(time)),
            () = self.shutdown.forced() => Err(shutting_down()),
        };
        ticket.end_work();
        let refusal = ticket.refusal().get().filter(|_| !reports_refusal);
        match (answer, refusal) {
            (Err(error), _) | (Ok(_), Some(error)) => {
                if error.kind() == ErrorKind::Overloaded {
                    self.app.metrics.refused();
                }
                refuse(is_grpc, &error, id)
            }
            (Ok(response), None) => {
                let response = response.unwrap_or_else(|never| match never {});
                if is_grpc { grpc::explain(response, id) } else { response }
            }
        }
    }

    /// Reads the body of a refused HTTP/1 request: a client that sends all before it reads a word
    /// would else find a broken connection instead of the refusal. HTTP/2 ends the stream alone.
    async fn discard(&self, request: Request<Incoming>) {
        if request.version() >= Version::HTTP_2 || request.headers().contains_key(EXPECT) {
            return;
        }
        let Ok(_turn) = self.discards.try_acquire() else { return };
        let mut body = request.into_body();
        let reading = async { while let Some(Ok(_)) = body.frame().await {} };
        // Whether all came or not, the answer is the same.
        let _ = tokio::time::timeout(DISCARD_TIME, reading).await;
    }

    /// The client's own id where it can be logged as it is, else a new one.
    fn request_id<B>(&self, request: &Request<B>) -> RequestId {
        let own = request.headers().get(REQUEST_ID).filter(|id| {
            (1..=LONGEST_REQUEST_ID).contains(&id.len()) && id.as_bytes().iter().all(u8::is_ascii_graphic)
        });
        let id = own.cloned().unwrap_or_else(|| {
            let uuid = self.app.randomness.uuid_v7(self.app.clock.now());
            let mut text = [0; uuid::fmt::Hyphenated::LENGTH];
            HeaderValue::from_str(uuid.hyphenated().encode_lower(&mut text)).expect("a UUID is ASCII")
        });
        RequestId::new(id)
    }
}

fn refuse(is_grpc: bool, error: &Error, id: &RequestId) -> Response<Body> {
    if is_grpc { grpc::refusal(error, id) } else { http::refusal(error, id) }
}

fn too_slow(time: Duration) -> Error {
    Error::refused(ErrorKind::Timeout, format!("the request took longer than {} s", time.as_secs()))
}

fn shutting_down() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server shuts down and did not finish the request in time")
}
