//! The way of a request from its connection to its transport: layers from top to bottom, the same for REST and gRPC.
//! The first one makes the request's [`RequestContext`]; what the others learn and grant is written into it.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use hyper::body::{Body as _, Incoming};
use hyper::header::{CONNECTION, CONTENT_ENCODING, CONTENT_TYPE, EXPECT, X_CONTENT_TYPE_OPTIONS};
use hyper::http::HeaderValue;
use hyper::http::uri::Scheme;
use hyper::{Method, Request, Response, Version};
use tower::util::option_layer;
use tower::{Layer as _, Service, service_fn};
use tower_http::cors::CorsLayer;
use tracing::field::{Empty, display};
use tracing::{Instrument as _, Span};

use super::activity::{Activity, GRPC_STATUS, ObservedBody};
use super::async_layer::async_layer;
use super::credentials::credential;
use super::forward::Forwarder;
use super::host_check::HostCheck;
use super::peer::Peer;
use super::proxies::TrustedProxies;
use super::refused_body::{Discards, read_in_vain};
use super::request_body::{AdmittedBody, RateGuard};
use super::revocable_body::RevocableBody;
use crate::admission::{ClientId, RequestClass};
use crate::app::App;
use crate::app::access::{Caller, Credential, Principal};
use crate::config::Console;
use crate::domain::{Error, ErrorKind, Result};
use crate::request::{RequestContext, RequestHead};
use crate::shutdown::Shutdown;
use crate::telemetry::{Metrics, OTHER_RPC, REQUEST_ID, REQUESTS, RequestId, RpcCall};
use crate::{grpc, http, operations};

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

/// The state that the layers of all connections of a listener share.
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

/// The state that the layers of one connection share.
struct Connection {
    pipeline: Arc<RequestPipeline>,
    peer: Peer,
    activity: Arc<Activity>,
}

/// The body of every response; it holds what the request was granted until its end.
pub(super) type ResponseBody = ObservedBody<RequestContext>;

/// A request below the layer of CORS, with what the layers know of it.
struct Exchange<B> {
    on: Arc<Connection>,
    context: RequestContext,
    request: Request<B>,
}

/// The service below a layer.
trait Next<Q, E>: Service<Q, Response = Response<Body>, Error = E, Future: Send> + Send + 'static {}

impl<S, Q, E> Next<Q, E> for S where
    S: Service<Q, Response = Response<Body>, Error = E, Future: Send> + Send + 'static
{
}

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

    /// The service of one connection, whose requests pass these layers from top to bottom.
    pub(super) fn service(
        self: Arc<Self>,
        peer: Peer,
        activity: Arc<Activity>,
    ) -> impl Service<
        Request<Incoming>,
        Response = Response<ResponseBody>,
        Error = Infallible,
        Future: Send + 'static,
    > + Clone {
        let cors = self.cors.clone();
        let on = Arc::new(Connection { pipeline: self, peer, activity });
        let same = on.clone();
        let layers = (
            async_layer(move |request, next| observe(on.clone(), request, next)),
            option_layer(cors),
            async_layer(move |request, next| explain_refusal(same.clone(), request, next)),
            async_layer(authenticate),
            async_layer(admit),
            async_layer(limit_time),
            async_layer(forward),
        );
        layers.layer(service_fn(transport))
    }
}

/// Gives the request its context and its span, and counts and logs the answer.
async fn observe<S: Next<Request<Incoming>, Infallible>>(
    on: Arc<Connection>,
    mut request: Request<Incoming>,
    mut next: S,
) -> Result<Response<ResponseBody>, Infallible> {
    let (began, open) = (Instant::now(), on.activity.request());
    let metrics = &on.pipeline.app.metrics;
    let context = on.context(&request);
    request.extensions_mut().insert(context.clone());
    let rpc = || operations::rpc_name(request.uri().path()).unwrap_or(OTHER_RPC);
    let call = context.is_grpc().then(|| metrics.call(rpc()));
    let closes = on.peer.refusal.is_some() && request.version() < Version::HTTP_2;
    let span = tracing::debug_span!(
        target: REQUESTS, "request", id = %context.id(), method = %request.method(), path = &*http::shown_path(request.uri().path()), key = Empty
    );
    #[cfg(feature = "otel")]
    crate::telemetry::continue_trace(&span, request.headers());
    let mut response = next.call(request).instrument(span.clone()).await?;
    let headers = response.headers_mut();
    headers.insert(REQUEST_ID, context.id().header().clone());
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    if closes {
        headers.insert(CONNECTION, HeaderValue::from_static("close"));
    }
    let call = span.in_scope(|| count(metrics, call, &response, &context, began.elapsed()));
    Ok(response.map(|body| ObservedBody::new(body, open, call, context)))
}

impl Connection {
    /// The context of a request, by its head.
    fn context(&self, request: &Request<Incoming>) -> RequestContext {
        let RequestPipeline { app, proxies, audience, .. } = &*self.pipeline;
        let sender = proxies.original(&self.peer, request.headers());
        let is_grpc = *audience == Audience::Clients && has_grpc_content(request);
        let path = request.uri().path();
        let head = RequestHead {
            id: request_id(app, request),
            is_grpc,
            class: if is_grpc { grpc::class(path) } else { http::class(request.method(), path) },
            scheme: if sender.is_tls { Scheme::HTTPS } else { Scheme::HTTP },
            address: sender.address,
        };
        RequestContext::new(head, app.quotas.clone())
    }
}

/// The client's own id where it can be logged as it is, else a new one.
fn request_id(app: &App, request: &Request<Incoming>) -> RequestId {
    let own = request.headers().get(REQUEST_ID).filter(|id| {
        (1..=LONGEST_REQUEST_ID).contains(&id.len()) && id.as_bytes().iter().all(u8::is_ascii_graphic)
    });
    let id = own.cloned().unwrap_or_else(|| {
        let uuid = app.randomness.uuid_v7(app.clock.now());
        let mut text = [0; uuid::fmt::Hyphenated::LENGTH];
        let text = uuid.hyphenated().encode_lower(&mut text);
        #[expect(clippy::expect_used, reason = "its form is fixed")]
        HeaderValue::from_str(text).expect("a UUID is ASCII")
    });
    RequestId::new(id)
}

fn has_grpc_content(request: &Request<Incoming>) -> bool {
    let content_type = request.headers().get(CONTENT_TYPE);
    content_type.is_some_and(|content_type| content_type.as_bytes().starts_with(b"application/grpc"))
}

/// Counts and logs an answer. A call of an RPC is counted when it ends.
fn count(
    metrics: &Metrics,
    call: Option<RpcCall>,
    response: &Response<Body>,
    context: &RequestContext,
    time: Duration,
) -> Option<RpcCall> {
    let (client, duration_ms) = (context.address(), time.as_secs_f64() * 1e3);
    let Some(mut call) = call else {
        let (route, status) = (context.route(), response.status().as_u16());
        metrics.answered(route, status, time);
        tracing::debug!(target: REQUESTS, route = route.template, status, %client, duration_ms, "answered");
        return None;
    };
    call.answered(time);
    let grpc_status = response.headers().get(GRPC_STATUS);
    if let Some(grpc_status) = grpc_status {
        call.ended(grpc_status.as_bytes());
    }
    tracing::debug!(target: REQUESTS, ?grpc_status, %client, duration_ms, "answered");
    Some(call)
}

/// Answers what the layers below refuse, in the form of the request's transport.
async fn explain_refusal<S: Next<Exchange<Incoming>, Error>>(
    on: Arc<Connection>,
    request: Request<Incoming>,
    mut next: S,
) -> Result<Response<Body>, Infallible> {
    #[expect(clippy::expect_used, reason = "the first layer inserts it")]
    let context = RequestContext::of(request.extensions()).expect("a context").clone();
    let exchange = Exchange { on: on.clone(), context: context.clone(), request };
    Ok(next.call(exchange).await.unwrap_or_else(|error| {
        if error.kind() == ErrorKind::Overloaded {
            on.pipeline.app.metrics.refused();
        }
        let (is_grpc, id) = (context.is_grpc(), context.id());
        if is_grpc { grpc::refusal(&error, id) } else { http::refusal(&error, id) }
    }))
}

/// Finds out who makes the request, and whether they may. A response that is open for long ends with the caller's key.
async fn authenticate<S: Next<Exchange<Incoming>, Error>>(
    Exchange { on, context, request }: Exchange<Incoming>,
    mut next: S,
) -> Result<Response<Body>> {
    let app = &on.pipeline.app;
    if app.access.is_worth_refresh(&on.credential(&context, &request), app.clock.monotonic())
        && let Err(error) = app.access.refresh(&app.store, &app.clock).await
    {
        tracing::warn!(%error, "cannot look for a new key");
    }
    if let Err(error) = on.identify(&context, &request) {
        on.pipeline.discard_refused(&context, request, &error).await;
        return Err(error);
    }
    let response = next.call(Exchange { on, context: context.clone(), request }).await?;
    if !context.caller().is_revocable() || response.body().size_hint().exact().is_some() {
        return Ok(response);
    }
    Ok(response.map(|body| Body::new(RevocableBody::new(body, context))))
}

impl Connection {
    fn credential<'r>(&'r self, context: &RequestContext, request: &'r Request<Incoming>) -> Credential<'r> {
        let is_tls = *context.scheme() == Scheme::HTTPS;
        credential(request, self.peer.certificate.as_ref(), is_tls, context.is_grpc())
    }

    fn identify(&self, context: &RequestContext, request: &Request<Incoming>) -> Result<()> {
        let RequestPipeline { app, hosts, .. } = &*self.pipeline;
        let is_probe = context.class() == RequestClass::Probe;
        if let Some(Error::Refused(refusal)) = self.peer.refusal.as_deref()
            && !is_probe
        {
            return Err(Error::Refused(refusal.clone()));
        }
        hosts.check(request)?;
        let caller = self.caller(context, request).map_err(|error| {
            // Guesses of keys count for the address that they come from.
            self.pipeline.count_anonymous(context.address().into()).err().unwrap_or(error)
        })?;
        if let Some(key) = caller.actor().key_id {
            Span::current().record("key", display(key));
        }
        context.authenticated(caller);
        let client = context.client();
        match context.caller().principal() {
            _ if is_probe => {}
            Principal::Anonymous => self.pipeline.count_anonymous(client)?,
            _ => app.quotas.request_rate.count(client, tokio::time::Instant::now())?,
        }
        if context.is_grpc() {
            // `http` compares a route's permission itself: it knows the template of the path.
            context.caller().authorize(operations::rpc_permission(request.uri().path()))?;
        }
        Ok(())
    }

    fn caller(&self, context: &RequestContext, request: &Request<Incoming>) -> Result<Caller> {
        let RequestPipeline { app, hosts, audience, .. } = &*self.pipeline;
        if *audience == Audience::Monitoring {
            return Ok(Caller::program("monitoring"));
        }
        let credential = self.credential(context, request);
        if let Credential::Session(_) = credential {
            hosts.check_same_origin(request)?;
        }
        let principal = match app.access.authenticate(credential, app.clock.now(), app.clock.monotonic()) {
            // A probe learns that the server is alive, whatever has become of its key.
            Err(_) if context.class() == RequestClass::Probe => Principal::Anonymous,
            principal => principal?,
        };
        Ok(Caller::new(principal, Some(context.address()), Some(context.id().as_str().into())))
    }
}

impl RequestPipeline {
    /// Counts a request without a credential that works.
    fn count_anonymous(&self, client: ClientId) -> Result<()> {
        let (quotas, now) = (&self.app.quotas, tokio::time::Instant::now());
        quotas.request_rate.count(client, now)?;
        quotas.anonymous_rate.count(client, now)
    }

    /// Reads the body of a request that was refused by its head. That of a stranger counts for the address.
    async fn discard_refused(&self, context: &RequestContext, request: Request<Incoming>, error: &Error) {
        let (bodies, now) = (&self.app.quotas.refused_bodies, tokio::time::Instant::now);
        let address = ClientId::from(context.address());
        let is_stranger = matches!(error.kind(), ErrorKind::Unauthenticated | ErrorKind::PermissionDenied);
        let is_in_debt = is_stranger && bodies.wait(address, now()).is_some();
        // HTTP/2 ends the request's stream without its body.
        let is_read = request.version() < Version::HTTP_2 && !awaits_continue(&request);
        let bytes = self.discards.read((is_read && !is_in_debt).then(|| request.into_body())).await;
        if is_stranger {
            bodies.charge(address, bytes, now());
        }
    }
}

/// True if the client waits for `100 Continue`: it does not send the body of a refused request.
fn awaits_continue<B>(request: &Request<B>) -> bool {
    request.headers().contains_key(EXPECT)
}

/// Grants the request memory, its body a least rate, and a place among the requests at work once the body has come.
async fn admit<S: Next<Exchange<Body>, Error>>(
    Exchange { on, context, request }: Exchange<Incoming>,
    mut next: S,
) -> Result<Response<Body>> {
    let pipeline = &*on.pipeline;
    let has_body = !request.body().is_end_stream();
    let waited = if has_body { pipeline.wait_for_refused(&context).await } else { Ok(()) };
    if let Err(error) = waited.and_then(|()| pipeline.grant(&context, &request)) {
        pipeline.discard_refused(&context, request, &error).await;
        return Err(error);
    }
    let is_encoded = request.headers().contains_key(CONTENT_ENCODING);
    // gRPC ends the request's stream without its body.
    let is_discarded = !context.is_grpc() && !awaits_continue(&request);
    let limits = &pipeline.app.limits;
    // A live stream may be silent for longer, and looks after that itself.
    let pace = (context.class() != RequestClass::LiveStream)
        .then(|| RateGuard::new(limits.body_grace(), limits.body_bytes_per_s));
    let request = request.map(|body| Body::new(AdmittedBody::new(body, context.clone(), pace)));
    let answer = next.call(Exchange { on: on.clone(), context: context.clone(), request }).await;
    let rest = context.end_work().filter(|_| is_discarded);
    let response = answer?;
    // An import stream reports by itself what it has stored of a body that was refused.
    if let Some(error) = context.body_refusal().filter(|_| context.class() != RequestClass::ImportStream) {
        pipeline.discards.read(rest).await;
        return Err(error);
    }
    let is_refused = response.status().is_client_error() || response.status().is_server_error();
    let discarded = pipeline.discards.read(rest.filter(|_| is_refused)).await;
    let in_vain = read_in_vain(&response, context.received_bytes(), discarded, is_encoded, limits);
    let bodies = &pipeline.app.quotas.refused_bodies;
    bodies.charge(context.client(), in_vain, tokio::time::Instant::now());
    Ok(response)
}

impl RequestPipeline {
    /// A client whose bodies were refused is served again after a while; until then it waits for the refusal, or it
    /// would send the next at once.
    async fn wait_for_refused(&self, context: &RequestContext) -> Result<()> {
        if matches!(context.class(), RequestClass::Probe | RequestClass::LiveStream) {
            return Ok(());
        }
        let bodies = &self.app.quotas.refused_bodies;
        let Some(wait) = bodies.wait(context.client(), tokio::time::Instant::now()) else { return Ok(()) };
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

    fn grant(&self, context: &RequestContext, request: &Request<Incoming>) -> Result<()> {
        let limits = &self.app.limits;
        let held_bytes = match context.class() {
            // Spooled, or read message by message, each with limits of its own.
            RequestClass::Import | RequestClass::ImportStream | RequestClass::LiveStream => 0,
            _ if context.is_grpc() => limits.message_bytes,
            _ if request.uri().path().ends_with("/picture") => limits.picture_bytes,
            _ => limits.body_bytes,
        };
        context.open(held_bytes)?;
        if request.headers().contains_key(CONTENT_ENCODING) {
            // Its decoded size is not known before it has been read.
            context.charge_whole_body()?;
        }
        let has_no_body = request.body().is_end_stream()
            || matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE | Method::OPTIONS);
        if has_no_body || context.class() == RequestClass::ImportStream {
            context.begin_work()?;
        }
        Ok(())
    }
}

/// Ends a request that takes too long, whose caller's key was revoked, or that the shutdown does not wait for.
async fn limit_time<S: Next<Exchange<Body>, Error>>(
    exchange: Exchange<Body>,
    mut next: S,
) -> Result<Response<Body>> {
    let (on, context) = (exchange.on.clone(), exchange.context.clone());
    let time = Duration::from_secs(on.pipeline.app.limits.request_s);
    tokio::select! {
        biased;
        answer = tokio::time::timeout(time, next.call(exchange)) => answer.unwrap_or_else(|_| Err(too_slow(time))),
        error = context.caller().ended() => Err(error),
        () = on.pipeline.shutdown.forced() => Err(shutting_down()),
    }
}

fn too_slow(time: Duration) -> Error {
    Error::refused(ErrorKind::Timeout, format!("the request took longer than {} s", time.as_secs()))
}

fn shutting_down() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server shuts down and did not finish the request in time")
}

/// Sends the request on to the node that has its camera, where the settings say so.
async fn forward<S: Next<Exchange<Body>, Infallible>>(
    exchange: Exchange<Body>,
    mut next: S,
) -> Result<Response<Body>> {
    let on = exchange.on.clone();
    let answer = match &on.pipeline.forwarder {
        Some(forwarder) => {
            let Exchange { on, context, request } = exchange;
            let (memory, asked) = (on.pipeline.app.quotas.open_request(context.client()), context.clone());
            let answer_here = |request| next.call(Exchange { on, context, request });
            forwarder.answer(request, &asked, memory, answer_here).await
        }
        None => next.call(exchange).await,
    };
    Ok(answer.unwrap_or_else(|never| match never {}))
}

/// Answers by the transport.
async fn transport(Exchange { on, context, request }: Exchange<Body>) -> Result<Response<Body>, Infallible> {
    if !context.is_grpc() {
        return Ok(on.pipeline.http.answer(request).await);
    }
    let answer = context.clone().scope(on.pipeline.grpc.clone().call(request)).await?;
    Ok(grpc::explain(answer, context.id()))
}
