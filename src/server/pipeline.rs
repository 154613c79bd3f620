//! What every request goes through, whatever its transport: id, span, host and origin, admission,
//! deadline, then the transport.

use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use http_body_util::BodyExt as _;
use hyper::body::{Body as _, Incoming};
use hyper::header::{CONNECTION, CONTENT_ENCODING, CONTENT_TYPE, EXPECT, X_CONTENT_TYPE_OPTIONS};
use hyper::http::HeaderValue;
use hyper::{Method, Request, Response, Version};
use tokio::sync::Semaphore;
use tower::{Layer as _, Service as _, ServiceExt as _, service_fn};
use tower_http::cors::CorsLayer;
use tracing::field::{Empty, display};
use tracing::{Instrument as _, Span};

use super::activity::{ObservedBody, OpenRequest};
use super::credentials::credential;
use super::host_check::HostCheck;
use super::request_body::{AdmittedBody, RateGuard, Ticket};
use super::revocable_body::RevocableBody;
use crate::admission::{BodyRefusal, ClientAddress, RequestClass};
use crate::app::App;
use crate::app::access::{Caller, CertificateHolder, Credential, Permission, Principal};
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
    http: http::Transport,
    grpc: Router,
    hosts: HostCheck,
    shutdown: Shutdown,
    discards: Semaphore,
    cors: Option<CorsLayer>,
}

/// The connection that a request came over.
#[derive(Clone)]
pub(super) struct Peer {
    /// As limits count it.
    pub(super) client: ClientAddress,
    /// As the audit log names it.
    pub(super) address: IpAddr,
    /// Whose certificate was verified, if one was presented.
    pub(super) certificate: Option<CertificateHolder>,
    /// Why only probes are answered on it, if so.
    pub(super) refusal: Option<Arc<Error>>,
}

/// What a request was granted.
struct Granted {
    ticket: Ticket,
    caller: Caller,
}

/// The body of every response; it holds the request's memory until its end.
pub(super) type ResponseBody = ObservedBody<Option<Ticket>>;

impl RequestPipeline {
    pub(super) fn new(
        app: App,
        console: Console,
        hosts: HostCheck,
        cors: Option<CorsLayer>,
        shutdown: &Shutdown,
    ) -> Self {
        Self {
            http: http::Transport::new(app.clone(), console, shutdown.clone()),
            grpc: grpc::router(&app, shutdown).into_axum_router(),
            hosts,
            cors,
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
            "request", id = %id, method = %request.method(), path = request.uri().path(), key = Empty
        );
        let (mut response, ticket) = self.respond(request, is_grpc, peer, &id).instrument(span).await;
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

    /// The response, and the ticket of a request that was admitted.
    async fn respond(
        &self,
        request: Request<Incoming>,
        is_grpc: bool,
        peer: &Peer,
        id: &RequestId,
    ) -> (Response<Body>, Option<Ticket>) {
        let Some(cors) = &self.cors else { return self.admit_and_route(request, is_grpc, peer, id).await };
        let granted = OnceLock::new();
        let service = service_fn(|request| async {
            let (response, ticket) = self.admit_and_route(request, is_grpc, peer, id).await;
            // The service is called once.
            let _ = granted.set(ticket);
            Ok::<_, Infallible>(response)
        });
        let Ok(response) = cors.layer(service).oneshot(request).await;
        (response, granted.into_inner().flatten())
    }

    async fn admit_and_route(
        &self,
        request: Request<Incoming>,
        is_grpc: bool,
        peer: &Peer,
        id: &RequestId,
    ) -> (Response<Body>, Option<Ticket>) {
        match self.admit(request, is_grpc, peer, id).await {
            Ok((request, granted)) => {
                (self.route(is_grpc, request, &granted, id).await, Some(granted.ticket))
            }
            Err(error) => {
                if error.kind() == ErrorKind::Overloaded {
                    self.app.metrics.refused();
                }
                (refuse(is_grpc, &error, id), None)
            }
        }
    }

    /// The request as the transports get it, with what it was granted; the body of a refused one is
    /// read to its end before.
    async fn admit(
        &self,
        request: Request<Incoming>,
        is_grpc: bool,
        peer: &Peer,
        id: &RequestId,
    ) -> Result<(Request<Body>, Granted)> {
        let path = request.uri().path();
        let class = if is_grpc { grpc::class(path) } else { http::class(request.method(), path) };
        match self.grant(&request, class, is_grpc, peer, id) {
            Ok(Granted { ticket, caller }) => {
                let limits = &self.app.limits;
                // A live stream may be silent for longer, and looks after that itself.
                let pace = (class != RequestClass::LiveStream)
                    .then(|| RateGuard::new(limits.body_grace(), limits.body_bytes_per_s));
                let mut request = request
                    .map(|body| Body::new(AdmittedBody::new(body, ticket.clone(), caller.clone(), pace)));
                let extensions = request.extensions_mut();
                extensions.insert(id.clone());
                extensions.insert(peer.client);
                extensions.insert(caller.clone());
                if class == RequestClass::ImportStream {
                    extensions.insert(ticket.refusal());
                }
                Ok((request, Granted { ticket, caller }))
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
        id: &RequestId,
    ) -> Result<Granted> {
        if let Some(Error::Refused(refusal)) = peer.refusal.as_deref()
            && class != RequestClass::Probe
        {
            return Err(Error::Refused(refusal.clone()));
        }
        self.hosts.check(request)?;
        let caller = self.caller(request, class, is_grpc, peer, id)?;
        if is_grpc {
            // `http` compares a route's permission itself: it knows the template of the path.
            caller.authorize(Permission::of_rpc(request.uri().path()))?;
        }
        let limits = &self.app.limits;
        let held_bytes = match class {
            // Spooled, or read message by message, each with limits of its own.
            RequestClass::Import | RequestClass::ImportStream | RequestClass::LiveStream => 0,
            _ if is_grpc => limits.message_bytes,
            _ => limits.body_bytes,
        };
        let ticket = Ticket::open(&self.app, class, peer.client, held_bytes)?;
        if request.headers().contains_key(CONTENT_ENCODING) {
            // What it decodes to is not known before it has been read.
            ticket.charge(held_bytes as u64)?;
        }
        let has_no_body = request.body().is_end_stream()
            || matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE | Method::OPTIONS);
        if has_no_body || class == RequestClass::ImportStream {
            ticket.begin_work()?;
        }
        Ok(Granted { ticket, caller })
    }

    /// Who makes the request.
    fn caller(
        &self,
        request: &Request<Incoming>,
        class: RequestClass,
        is_grpc: bool,
        peer: &Peer,
        id: &RequestId,
    ) -> Result<Caller> {
        let credential = credential(request, peer.certificate.as_ref(), is_grpc);
        if let Credential::Session(_) = credential {
            self.hosts.check_same_origin(request)?;
        }
        let principal = match self.app.access.authenticate(credential, self.app.clock.now()) {
            // What watches the server learns that it is alive, whatever has become of its key.
            Err(_) if class == RequestClass::Probe => Principal::Anonymous,
            principal => principal?,
        };
        let caller = Caller::new(principal, Some(peer.address), Some(id.as_str().into()));
        if let Some(key) = caller.actor().key_id {
            Span::current().record("key", display(key));
        }
        Ok(caller)
    }

    async fn route(
        &self,
        is_grpc: bool,
        request: Request<Body>,
        granted: &Granted,
        id: &RequestId,
    ) -> Response<Body> {
        let Granted { ticket, caller } = granted;
        let time = Duration::from_secs(self.app.limits.request_s);
        // An import stream reports by itself what it has stored of a body that was refused.
        let reports_refusal = request.extensions().get::<BodyRefusal>().is_some();
        let answer = async {
            if !is_grpc {
                return self.http.answer(request).await;
            }
            let answer = self.grpc.clone().call(request).await;
            answer.unwrap_or_else(|never| match never {})
        };
        let answer = tokio::select! {
            biased;
            answer = tokio::time::timeout(time, answer) => answer.map_err(|_| too_slow(time)),
            error = caller.ended() => Err(error),
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
                let response = if is_grpc { grpc::explain(response, id) } else { response };
                revocable(response, caller, is_grpc.then_some(id))
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

/// A response that may be open for long ends when the key of its request does.
fn revocable(response: Response<Body>, caller: &Caller, id: Option<&RequestId>) -> Response<Body> {
    if !caller.is_revocable() || response.body().size_hint().exact().is_some() {
        return response;
    }
    response.map(|body| Body::new(RevocableBody::new(body, caller.clone(), id.cloned())))
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
