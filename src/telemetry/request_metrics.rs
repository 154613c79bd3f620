//! Requests by route or RPC. Labels come from tables of the program, never from a client, so that nobody can
//! make their number grow.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use std::time::Duration;

use metrics::{Counter, Histogram};

use super::registry::Registry;

/// A REST route as metrics name it: the method, and the template of the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Route {
    /// `GET`.
    pub method: &'static str,
    /// `/v1/cameras/{camera}`.
    pub template: &'static str,
}

impl Route {
    /// Requests for files of the console and the description, and those that match no route.
    pub const OTHER: Self = Self { method: "other", template: "other" };
}

/// The RPC of requests that name none.
pub const OTHER_RPC: &str = "other";

/// Names of the status codes of gRPC, by number.
const RPC_CODES: [&str; 17] = [
    "OK",
    "CANCELLED",
    "UNKNOWN",
    "INVALID_ARGUMENT",
    "DEADLINE_EXCEEDED",
    "NOT_FOUND",
    "ALREADY_EXISTS",
    "PERMISSION_DENIED",
    "RESOURCE_EXHAUSTED",
    "FAILED_PRECONDITION",
    "ABORTED",
    "OUT_OF_RANGE",
    "UNIMPLEMENTED",
    "INTERNAL",
    "UNAVAILABLE",
    "DATA_LOSS",
    "UNAUTHENTICATED",
];
const CANCELLED: usize = 1;
const UNKNOWN: usize = 2;

/// Counts and durations of requests. Clones share it.
#[derive(Clone)]
pub(super) struct RequestMetrics(Arc<State>);

struct State {
    registry: Arc<Registry>,
    routes: RwLock<HashMap<Route, Arc<RouteMetrics>>>,
    rpcs: RwLock<HashMap<&'static str, Arc<RpcMetrics>>>,
}

struct RouteMetrics {
    /// By class of status, 1xx to 5xx.
    answered: [Counter; 5],
    duration_s: Histogram,
}

struct RpcMetrics {
    registry: Arc<Registry>,
    rpc: &'static str,
    ended: [OnceLock<Counter>; RPC_CODES.len()],
    duration_s: Histogram,
}

impl RequestMetrics {
    pub(super) fn new(registry: &Arc<Registry>) -> Self {
        let registry = Arc::clone(registry);
        Self(Arc::new(State { registry, routes: RwLock::default(), rpcs: RwLock::default() }))
    }

    /// A REST request was answered.
    pub(super) fn answered(&self, route: Route, status: u16, time: Duration) {
        let metrics =
            get_or_insert(&self.0.routes, route, || RouteMetrics::register(&self.0.registry, route));
        let class = usize::from(status / 100).clamp(1, 5) - 1;
        metrics.answered[class].increment(1);
        metrics.duration_s.record(time.as_secs_f64());
    }

    /// A call of an RPC begins.
    pub(super) fn call(&self, rpc: &'static str) -> RpcCall {
        let metrics = get_or_insert(&self.0.rpcs, rpc, || RpcMetrics::register(&self.0.registry, rpc));
        RpcCall { metrics, code: None }
    }
}

fn get_or_insert<K: Copy + Eq + std::hash::Hash, V>(
    table: &RwLock<HashMap<K, Arc<V>>>,
    key: K,
    make: impl FnOnce() -> V,
) -> Arc<V> {
    if let Some(found) = table.read().unwrap_or_else(PoisonError::into_inner).get(&key) {
        return found.clone();
    }
    let mut table = table.write().unwrap_or_else(PoisonError::into_inner);
    table.entry(key).or_insert_with(|| Arc::new(make())).clone()
}

impl RouteMetrics {
    fn register(registry: &Registry, route: Route) -> Self {
        let Route { method, template } = route;
        let answered = |class| {
            let labels = [("method", method), ("route", template), ("status", class)];
            let help = "REST requests answered, by route and class of status";
            registry.counter("sightfix_http_requests_total", help, &labels)
        };
        Self {
            answered: ["1xx", "2xx", "3xx", "4xx", "5xx"].map(answered),
            duration_s: registry.histogram(
                "sightfix_http_request_duration_seconds",
                "Time of a REST request until the head of its answer",
                &[("method", method), ("route", template)],
            ),
        }
    }
}

impl RpcMetrics {
    fn register(registry: &Arc<Registry>, rpc: &'static str) -> Self {
        Self {
            registry: Arc::clone(registry),
            rpc,
            ended: Default::default(),
            duration_s: registry.histogram(
                "sightfix_grpc_request_duration_seconds",
                "Time of an RPC until the head of its answer",
                &[("rpc", rpc)],
            ),
        }
    }

    fn ended(&self, code: usize) {
        let code = if code < RPC_CODES.len() { code } else { UNKNOWN };
        let counter = self.ended[code].get_or_init(|| {
            let labels = [("rpc", self.rpc), ("code", RPC_CODES[code])];
            let help = "RPCs that ended, streams included, by status";
            self.registry.counter("sightfix_grpc_requests_total", help, &labels)
        });
        counter.increment(1);
    }
}

/// A call of an RPC, counted by its status when the value is dropped: a stream ends long after its answer
/// began.
pub struct RpcCall {
    metrics: Arc<RpcMetrics>,
    code: Option<usize>,
}

impl RpcCall {
    /// The head of the answer is sent.
    pub fn answered(&self, time: Duration) {
        self.metrics.duration_s.record(time.as_secs_f64());
    }

    /// The status of the answer, as `grpc-status` has it. Without one the client went away.
    pub fn ended(&mut self, grpc_status: &[u8]) {
        let code = std::str::from_utf8(grpc_status).ok().and_then(|code| code.parse().ok());
        self.code = Some(code.unwrap_or(UNKNOWN));
    }
}

impl Drop for RpcCall {
    fn drop(&mut self) {
        self.metrics.ended(self.code.unwrap_or(CANCELLED));
    }
}
