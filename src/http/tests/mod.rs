//! The REST transport, without a port.

mod cameras;
mod description;
mod evaluations;
mod fusions;
mod samples;
mod training_runs;

use std::sync::Arc;

use axum::body::{Body, Bytes};
use http_body_util::BodyExt as _;
use hyper::http::HeaderValue;
use hyper::http::uri::Scheme;
use hyper::{HeaderMap, Request, StatusCode};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::{Transport, class};
use crate::admission::Quotas;
use crate::app::App;
use crate::app::access::{Caller, Principal};
use crate::clock::{Clock, Randomness};
use crate::config::{Console, Limits};
use crate::request::{RequestContext, RequestHead};
use crate::shutdown::Shutdown;
use crate::store::Store;
use crate::telemetry::{Metrics, RequestId};

/// The transport over a store of its own; no worker runs.
struct Rest {
    transport: Transport,
    quotas: Arc<Quotas>,
    shutdown: Shutdown,
    _folder: TempDir,
}

/// A whole answer.
struct Answer {
    status: StatusCode,
    headers: HeaderMap,
    body: Bytes,
}

impl Answer {
    #[track_caller]
    fn expect(self, status: u16) -> Self {
        assert_eq!(self.status.as_u16(), status, "{}", self.text());
        self
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    #[track_caller]
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    #[track_caller]
    fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no header {name}")).to_str().expect("text")
    }

    /// The fields at fault of a problem of that kind.
    #[track_caller]
    fn problem(self, status: u16, kind: &str) -> Vec<String> {
        let answer = self.expect(status);
        assert_eq!(answer.header("content-type"), "application/problem+json");
        let problem = answer.json();
        assert_eq!(problem["type"], format!("urn:sightfix:problem:{kind}"), "{problem}");
        assert_eq!(problem["status"], status, "{problem}");
        assert_eq!(problem["trace_id"], "the-request", "{problem}");
        assert!(problem["detail"].as_str().is_some_and(|detail| !detail.is_empty()), "{problem}");
        let violations = problem["violations"].as_array().into_iter().flatten();
        violations.map(|at| at["field"].as_str().expect("a field").to_owned()).collect()
    }
}

impl Rest {
    async fn new() -> Self {
        Self::with(Limits::default()).await
    }

    async fn with(limits: Limits) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a store");
        let clock = Clock::from_fn(|| "2026-01-01T00:00:00Z".parse().expect("an instant"));
        let app =
            App::new(store, clock, Randomness::seeded(1), limits, Metrics::new()).await.expect("an app");
        let shutdown = Shutdown::new();
        let quotas = app.quotas.clone();
        let transport = Transport::new(app, Console::default(), shutdown.clone());
        Self { transport, quotas, shutdown, _folder: folder }
    }

    /// With a camera `c` of 640 x 480 px.
    async fn with_camera() -> Self {
        let rest = Self::new().await;
        let profile = json!({"id": "c", "image_size": {"width_px": 640, "height_px": 480}});
        rest.post("/v1/cameras", &profile).await.expect(201);
        rest
    }

    async fn open(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: Body,
    ) -> axum::response::Response {
        let mut request = Request::builder().method(method).uri(path);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let mut request = request.body(body).expect("a request");
        let head = RequestHead {
            id: RequestId::new(HeaderValue::from_static("the-request")),
            is_grpc: false,
            class: class(request.method(), path),
            scheme: Scheme::HTTP,
            address: [127, 0, 0, 1].into(),
        };
        let context = RequestContext::new(head, self.quotas.clone());
        context.authenticated(Caller::new(Principal::Everyone, None, None));
        request.extensions_mut().insert(context);
        self.transport.answer(request).await
    }

    async fn send(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: impl Into<Body>,
    ) -> Answer {
        let (head, body) = self.open(method, path, headers, body.into()).await.into_parts();
        let body = body.collect().await.expect("a whole body").to_bytes();
        Answer { status: head.status, headers: head.headers, body }
    }

    async fn get(&self, path: &str) -> Answer {
        self.send("GET", path, &[], Body::empty()).await
    }

    async fn post(&self, path: &str, body: &Value) -> Answer {
        self.send("POST", path, &[("content-type", "application/json")], body.to_string()).await
    }

    async fn csv(&self, path: &str, csv: impl Into<Body>) -> Answer {
        self.send("POST", path, &[("content-type", "text/csv")], csv).await
    }
}
