//! The pipeline of every request, whatever its transport: id, span, host and origin, admission,
//! deadline, then the transport.

use std::convert::Infallible;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use hyper::body::{Body as _, Incoming};
use hyper::header::{CONNECTION, CONTENT_ENCODING, CONTENT_TYPE, EXPECT, X_CONTENT_TYPE_OPTIONS};
use hyper::http::HeaderValue;
use hyper::http::uri::Scheme;
use hyper::{Method, Request, Response, Version};
use tower::{Layer as _, Service as _, ServiceExt as _, service_fn};
use tower_http::cors::CorsLayer;
use tracing::field::{Empty, display};
use tracing::{Instrument as _, Span};

use super::activity::{GRPC_STATUS, ObservedBody, OpenRequest};
use super::credentials::credential;
use super::forward::Forwarder;
use super::host_check::HostCheck;
use super::peer::Peer;
use super::proxies::TrustedProxies;
use super::refused_body::{Discards, read_in_vain};
use super::request_body::{AdmittedBody, RateGuard, Ticket};
use super::revocable_body::RevocableBody;
use crate::admission::{BodyRefusal, ClientId, RequestClass};
use crate::app::App;
use crate::app::access::{Caller, Credential, Permission, Principal};
use crate::config::Console;
use crate::domain::{Error, ErrorKind, Result};
use crate::shutdown::Shutdown;
use crate::telemetry::{MatchedRoute, Metrics, OTHER_RPC, REQUEST_ID, REQUESTS, RequestId, RpcCall};
use crate::{grpc, http};

/// Longest request id that is taken from a client, in bytes.
const LONGEST_REQUEST_ID: usize = 128;
/// Longest time for which the refusal of a client waits whose bodies were refused before.
const REFUSED_WAIT: Duration = Duration::from_secs(1);

/// Whom a listener serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Audience {
    /// Clients, each with what its credential allows.
    Clients,
    /// All clients of the address `metrics_listen`, which serves probes and metrics alone.
    Monitoring,
}

/// How a request is counted.
enum Counted {
    Http(MatchedRoute),
    Grpc(RpcCall),
}

impl Counted {
    const fn is_grpc(&self) -> bool {
        matches!(self, Self::Grpc(_))
    }
}

/// The way from a connection to the transports.
pub(super) struct RequestPipeline {
    app: App,
    http: http::Transport,
    grpc: Router,
    /// `None` where clients are redirected.
    forwarder: Option<Forwarder>,
    hosts: HostCheck,
    proxies: TrustedProxies,
    shutdown: Shutdown,
    discards: Discards,
    audience: Audience,
    cors: Option<CorsLayer>,
}

/// The grants of a request.
struct Granted {
    ticket: Ticket,
    caller: Caller,
    /// As limits count the caller.
    client: ClientId,
    class: RequestClass,
}

/// The body of every response; it holds the request's memory until its end.
pub(super) type ResponseBody = ObservedBody<Option<Ticket>>;

impl RequestPipeline {
    pub(super) fn new(
        app: App,
        console: Console,
        hosts: HostCheck,
        proxies: TrustedProxies,
        cors: Option<CorsLayer>,
        forwarder: Option<Forwarder>,
        shutdown: &Shutdown,
    ) -> Self {
        Self {
            forwarder,
            http: http::Transport::new(app.clone(), console, shutdown.clone()),
            grpc: grpc::router(&app, shutdown).into_axum_router(),
            hosts,
            proxies,
            cors,
            shutdown: shutdown.clone(),
            discards: Discards::default(),
            audience: Audience::Clients,
            app,
        }
    }

    /// Probes and metrics alone, without keys.
    pub(super) fn monitoring(app: App, hosts: HostCheck, shutdown: &Shutdown) -> Self {
        Self {
            http: http::Transport::monitoring(app.clone(), shutdown.clone()),
            grpc: Router::new(),
            forwarder: None,
            hosts,
            proxies: TrustedProxies::default(),
            cors: None,
            shutdown: shutdown.clone(),
            discards: Discards::default(),
            audience: Audience::Monitoring,
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
        let peer = &*self.proxies.original(peer, request.headers());
        let is_http_1 = request.version() < Version::HTTP_2;
        let id = self.request_id(&request);
        let counted = self.begin_count(&request);
        let span = tracing::debug_span!(
            target: REQUESTS, "request", id = %id, method = %request.method(), path = &*http::shown_path(request.uri().path()), key = Empty
        );
        #[cfg(feature = "otel")]
        crate::telemetry::continue_trace(&span, request.headers());
        let (mut response, ticket) =
            self.respond(request, &counted, peer, &id).instrument(span.clone()).await;
        let headers = response.headers_mut();
        headers.insert(REQUEST_ID, id.header().clone());
        headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
        if peer.refusal.is_some() && is_http_1 {
            headers.insert(CONNECTION, HeaderValue::from_static("close"));
        }
        let call = span.in_scope(|| self.count(counted, &response, peer, began.elapsed()));
        response.map(|body| ObservedBody::new(body, open, call, ticket))
    }

    /// Which transport a request is for, and how it is counted.
    fn begin_count(&self, request: &Request<Incoming>) -> Counted {
        if self.audience == Audience::Clients && has_grpc_content(request) {
            let rpc = Permission::named_rpc(request.uri().path()).unwrap_or(OTHER_RPC);
            Counted::Grpc(self.app.metrics.call(rpc))
        } else {
            Counted::Http(MatchedRoute::default())
        }
    }

    /// Counts and logs an answer. A call of an RPC is counted when it ends.
    fn count(
        &self,
        counted: Counted,
        response: &Response<Body>,
        peer: &Peer,
        time: Duration,
    ) -> Option<RpcCall> {
        let (status, duration_ms, client) =
            (response.status().as_u16(), time.as_secs_f64() * 1e3, peer.address);
        match counted {
            Counted::Http(matched) => {
                let route = matched.get();
                self.app.metrics.answered(route, status, time);
                tracing::debug!(target: REQUESTS, route = route.template, status, %client, duration_ms, "answered");
                None
            }
            Counted::Grpc(mut call) => {
                call.answered(time);
                let grpc_status = response.headers().get(GRPC_STATUS);
                if let Some(grpc_status) = grpc_status {
                    call.ended(grpc_status.as_bytes());
                }
                tracing::debug!(target: REQUESTS, ?grpc_status, %client, duration_ms, "answered");
                Some(call)
            }
        }
    }

    /// The response, and the ticket of a request that was admitted.
    async fn respond(
        &self,
        request: Request<Incoming>,
        counted: &Counted,
        peer: &Peer,
        id: &RequestId,
    ) -> (Response<Body>, Option<Ticket>) {
        let Some(cors) = &self.cors else { return self.admit_and_route(request, counted, peer, id).await };
        let granted = OnceLock::new();
        let service = service_fn(|request| async {
            let (response, ticket) = self.admit_and_route(request, counted, peer, id).await;
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
        counted: &Counted,
        peer: &Peer,
        id: &RequestId,
    ) -> (Response<Body>, Option<Ticket>) {
        let is_grpc = counted.is_grpc();
        match self.admit(request, counted, peer, id).await {
            Ok((request, granted)) => {
                let response = self.route(is_grpc, request, &granted, id).await;
                (response, Some(granted.ticket))
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
        counted: &Counted,
        peer: &Peer,
        id: &RequestId,
    ) -> Result<(Request<Body>, Granted)> {
        let path = request.uri().path();
        let is_grpc = counted.is_grpc();
        let class = if is_grpc { grpc::class(path) } else { http::class(request.method(), path) };
        let has_body = !request.body().is_end_stream();
        let presented = credential(&request, peer.certificate.as_ref(), peer.is_tls, is_grpc);
        let (access, clock) = (&self.app.access, &self.app.clock);
        if access.is_worth_refresh(presented, clock.monotonic())
            && let Err(error) = access.refresh(&self.app.store, clock).await
        {
            tracing::warn!(%error, "cannot look for a new key");
        }
        let granted = match self.grant(&request, class, is_grpc, peer, id) {
            Ok(granted) if has_body => self.wait_for_refused(class, granted).await,
            Ok(granted) => Ok(granted),
            Err(error) => Err(error),
        };
        match granted {
            Ok(granted) => {
                let Granted { ticket, caller, client, .. } = &granted;
                let limits = &self.app.limits;
                // A live stream may be silent for longer, and looks after that itself.
                let pace = (class != RequestClass::LiveStream)
                    .then(|| RateGuard::new(limits.body_grace(), limits.body_bytes_per_s));
                let mut request = request
                    .map(|body| Body::new(AdmittedBody::new(body, ticket.clone(), caller.clone(), pace)));
                let extensions = request.extensions_mut();
                extensions.insert(id.clone());
                extensions.insert(*client);
                extensions.insert(caller.clone());
                extensions.insert(if peer.is_tls { Scheme::HTTPS } else { Scheme::HTTP });
                if let Counted::Http(matched) = counted {
                    extensions.insert(matched.clone());
                }
                if class == RequestClass::ImportStream {
                    extensions.insert(ticket.refusal());
                }
                Ok((request, granted))
            }
            Err(error) => {
                // HTTP/2 ends the stream alone.
                self.discard_refused(request, &error, peer).await;
                Err(error)
            }
        }
    }

    /// Reads the body of a request that was refused by its head. That of a stranger counts for the address.
    async fn discard_refused(&self, request: Request<Incoming>, error: &Error, peer: &Peer) {
        let (bodies, now) = (&self.app.quotas.refused_bodies, tokio::time::Instant::now);
        let is_stranger = matches!(error.kind(), ErrorKind::Unauthenticated | ErrorKind::PermissionDenied);
        let is_in_debt = is_stranger && bodies.wait(peer.client, now()).is_some();
        // HTTP/2 ends the stream alone, and one that waits for `100 Continue` sends no more.
        let is_read = request.version() < Version::HTTP_2 && !request.headers().contains_key(EXPECT);
        let bytes = self.discards.read((is_read && !is_in_debt).then(|| request.into_body())).await;
        if is_stranger {
            bodies.charge(peer.client, bytes, now());
        }
    }

    /// A client whose bodies were refused is served again after a while; until then it waits for the refusal, or it
    /// would send the next at once.
    async fn wait_for_refused(&self, class: RequestClass, granted: Granted) -> Result<Granted> {
        if matches!(class, RequestClass::Probe | RequestClass::LiveStream) {
            return Ok(granted);
        }
        let bodies = &self.app.quotas.refused_bodies;
        let Some(wait) = bodies.wait(granted.client, tokio::time::Instant::now()) else { return Ok(granted) };
        drop(granted);
        tokio::select! {
            () = tokio::time::sleep(wait.min(REFUSED_WAIT)) => {}
            () = self.shutdown.forced() => return Err(shutting_down()),
        }
        let message = format!(
            "bodies of this client were refused faster than the limit refused_bytes_per_s allows; try again in {} s",
            wait.as_secs() + 1
        );
        Err(Error::refused(ErrorKind::RateLimited, message))
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
        let caller = self.caller(request, class, is_grpc, peer, id).map_err(|error| {
            // Guesses of keys count for the address that they come from.
            self.count_anonymous(peer.client).err().unwrap_or(error)
        })?;
        let client = caller.actor().key_id.map_or(peer.client, ClientId::Key);
        match caller.principal() {
            _ if class == RequestClass::Probe => {}
            Principal::Anonymous => self.count_anonymous(client)?,
            _ => self.app.quotas.request_rate.count(client, tokio::time::Instant::now())?,
        }
        if is_grpc {
            // `http` compares a route's permission itself: it knows the template of the path.
            caller.authorize(Permission::of_rpc(request.uri().path()))?;
        }
        let limits = &self.app.limits;
        let held_bytes = match class {
            // Spooled, or read message by message, each with limits of its own.
            RequestClass::Import | RequestClass::ImportStream | RequestClass::LiveStream => 0,
            _ if is_grpc => limits.message_bytes,
            _ if request.uri().path().ends_with("/picture") => limits.picture_bytes,
            _ => limits.body_bytes,
        };
        let ticket = Ticket::open(&self.app, class, client, held_bytes)?;
        if request.headers().contains_key(CONTENT_ENCODING) {
            // Its decoded size is not known before it has been read.
            ticket.charge(held_bytes as u64)?;
        }
        let has_no_body = request.body().is_end_stream()
            || matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE | Method::OPTIONS);
        if has_no_body || class == RequestClass::ImportStream {
            ticket.begin_work()?;
        }
        Ok(Granted { ticket, caller, client, class })
    }

    /// Counts a request without a credential that works.
    fn count_anonymous(&self, client: ClientId) -> Result<()> {
        let (quotas, now) = (&self.app.quotas, tokio::time::Instant::now());
        quotas.request_rate.count(client, now)?;
        quotas.anonymous_rate.count(client, now)
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
        if self.audience == Audience::Monitoring {
            return Ok(Caller::program("monitoring"));
        }
        let credential = credential(request, peer.certificate.as_ref(), peer.is_tls, is_grpc);
        if let Credential::Session(_) = credential {
            self.hosts.check_same_origin(request)?;
        }
        let clock = &self.app.clock;
        let principal = match self.app.access.authenticate(credential, clock.now(), clock.monotonic()) {
            // A probe learns that the server is alive, whatever has become of its key.
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
        let Granted { ticket, caller, class, .. } = granted;
        let time = Duration::from_secs(self.app.limits.request_s);
        // An import stream reports by itself what it has stored of a body that was refused.
        let reports_refusal = request.extensions().get::<BodyRefusal>().is_some();
        let is_encoded = request.headers().contains_key(CONTENT_ENCODING);
        // HTTP/2 ends the stream alone, and one that waits for `100 Continue` sends no more.
        let is_discarded = !is_grpc && !request.headers().contains_key(EXPECT);
        let answer_here = |request| async move {
            if !is_grpc {
                return self.http.answer(request).await;
            }
            let memory = self.app.quotas.decoded_memory(granted.client, ticket.refusal());
            let answer = memory.scope(self.grpc.clone().call(request)).await;
            answer.unwrap_or_else(|never| match never {})
        };
        let answer = async {
            match &self.forwarder {
                Some(forwarder) => {
                    let memory = self.app.quotas.open_request(granted.client);
                    forwarder.answer(request, *class, is_grpc, memory, answer_here).await
                }
                None => answer_here(request).await,
            }
        };
        let answer = tokio::select! {
            biased;
            answer = tokio::time::timeout(time, answer) => answer.map_err(|_| too_slow(time)),
            error = caller.ended() => Err(error),
            () = self.shutdown.forced() => Err(shutting_down()),
        };
        let rest = ticket.end_work().filter(|_| is_discarded);
        let refusal = ticket.refusal().get().filter(|_| !reports_refusal);
        match (answer, refusal) {
            (Err(error), _) => self.refuse_admitted(is_grpc, &error, id),
            (Ok(_), Some(error)) => {
                self.discards.read(rest).await;
                self.refuse_admitted(is_grpc, &error, id)
            }
            (Ok(response), None) => {
                let is_refused = response.status().is_client_error() || response.status().is_server_error();
                let discarded = self.discards.read(rest.filter(|_| is_refused)).await;
                let response = if is_grpc { grpc::explain(response, id) } else { response };
                let received = ticket.received_bytes();
                let in_vain = read_in_vain(&response, received, discarded, is_encoded, &self.app.limits);
                let bodies = &self.app.quotas.refused_bodies;
                bodies.charge(granted.client, in_vain, tokio::time::Instant::now());
                revocable(response, caller, is_grpc.then_some(id))
            }
        }
    }

    fn refuse_admitted(&self, is_grpc: bool, error: &Error, id: &RequestId) -> Response<Body> {
        if error.kind() == ErrorKind::Overloaded {
            self.app.metrics.refused();
        }
        refuse(is_grpc, error, id)
    }

    /// The client's own id where it can be logged as it is, else a new one.
    fn request_id<B>(&self, request: &Request<B>) -> RequestId {
        let own = request.headers().get(REQUEST_ID).filter(|id| {
            (1..=LONGEST_REQUEST_ID).contains(&id.len()) && id.as_bytes().iter().all(u8::is_ascii_graphic)
        });
        let id = own.cloned().unwrap_or_else(|| {
            let uuid = self.app.randomness.uuid_v7(self.app.clock.now());
            let mut text = [0; uuid::fmt::Hyphenated::LENGTH];
            let text = uuid.hyphenated().encode_lower(&mut text);
            #[expect(clippy::expect_used, reason = "its form is fixed")]
            HeaderValue::from_str(text).expect("a UUID is ASCII")
        });
        RequestId::new(id)
    }
}

fn has_grpc_content(request: &Request<Incoming>) -> bool {
    let content_type = request.headers().get(CONTENT_TYPE);
    content_type.is_some_and(|content_type| content_type.as_bytes().starts_with(b"application/grpc"))
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
