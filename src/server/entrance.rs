//! What every request goes through, whatever its transport.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use hyper::body::Incoming;
use hyper::header::CONTENT_TYPE;
use hyper::http::HeaderValue;
use hyper::{Request, Response};
use tokio::sync::Semaphore;
use tower::Service as _;
use tower_http::timeout::TimeoutBody;
use tracing::Instrument as _;

use crate::app::App;
use crate::domain::{Error, ErrorKind};
use crate::shutdown::Shutdown;
use crate::telemetry::{Metrics, REQUEST_ID, RequestId};
use crate::{grpc, http};

/// Longest request id that is taken from a client, in bytes.
const LONGEST_REQUEST_ID: usize = 128;

/// The way in.
pub(super) struct Entrance {
    app: App,
    http: Router,
    grpc: Router,
    places: Arc<Semaphore>,
    request_time: Duration,
    idle_time: Duration,
}

impl Entrance {
    pub(super) fn new(app: App, shutdown: &Shutdown) -> Self {
        Self {
            http: http::router(app.clone(), shutdown.clone()),
            grpc: grpc::router(&app, shutdown).into_axum_router(),
            places: Arc::new(Semaphore::new(app.limits.requests)),
            request_time: Duration::from_secs(app.limits.request_s),
            idle_time: app.limits.idle_time(),
            app,
        }
    }

    pub(super) fn metrics(&self) -> &Metrics {
        &self.app.metrics
    }

    /// Answers a request: id, span, place, time, then the transport.
    pub(super) async fn answer(&self, request: Request<Incoming>) -> Response<Body> {
        let began = Instant::now();
        // A live stream may be silent for longer, and looks after that itself.
        let is_live = request.uri().path() == grpc::LIVE_STREAM;
        let mut request = if is_live {
            request.map(Body::new)
        } else {
            request.map(|body| Body::new(TimeoutBody::new(self.idle_time, body)))
        };
        let id = self.request_id(&request);
        let is_grpc = request
            .headers()
            .get(CONTENT_TYPE)
            .is_some_and(|content_type| content_type.as_bytes().starts_with(b"application/grpc"));
        let span = tracing::debug_span!(
            "request", id = %id, method = %request.method(), path = request.uri().path()
        );
        request.extensions_mut().insert(id.clone());
        let answer = async {
            let Ok(_place) = self.places.try_acquire() else {
                self.app.metrics.refused();
                return refuse(is_grpc, &overloaded(), &id);
            };
            match tokio::time::timeout(self.request_time, self.route(is_grpc, request)).await {
                Ok(response) if is_grpc => grpc::explain(response, &id),
                Ok(response) => response,
                Err(_) => refuse(is_grpc, &too_slow(self.request_time), &id),
            }
        };
        let mut response = answer.instrument(span).await;
        response.headers_mut().insert(REQUEST_ID, id.header().clone());
        let time = began.elapsed();
        self.app.metrics.answered(response.status().as_u16(), time);
        tracing::debug!(id = %id, status = response.status().as_u16(), duration_ms = time.as_secs_f64() * 1e3);
        response
    }

    async fn route(&self, is_grpc: bool, request: Request<Body>) -> Response<Body> {
        let mut transport = if is_grpc { self.grpc.clone() } else { self.http.clone() };
        transport.call(request).await.unwrap_or_else(|never| match never {})
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

fn overloaded() -> Error {
    Error::refused(ErrorKind::Overloaded, "too many requests are in flight; try again in a second")
}

fn too_slow(time: Duration) -> Error {
    Error::refused(ErrorKind::Timeout, format!("the request took longer than {} s", time.as_secs()))
}
