//! Pages of other origins that may use the interface (CORS, Fetch standard).

use std::time::Duration;

use hyper::Method;
use hyper::header::{
    ACCEPT, AUTHORIZATION, CONTENT_ENCODING, CONTENT_TYPE, ETAG, HeaderName, IF_MATCH, IF_NONE_MATCH,
    LOCATION, RETRY_AFTER,
};
use hyper::http::HeaderValue;
use tower_http::cors::{AllowOrigin, CorsLayer};

use crate::telemetry::REQUEST_ID;

/// How long a browser need not ask again.
const PREFLIGHT_LIFE: Duration = Duration::from_secs(600);

/// Answers preflight requests and lets pages of exactly these origins read responses; `None` if there are none.
/// Cookies are not among what such pages may send: they present keys.
pub(super) fn layer(origins: &[String]) -> Option<CorsLayer> {
    let origins: Vec<HeaderValue> =
        origins.iter().filter_map(|origin| HeaderValue::from_str(origin).ok()).collect();
    let methods = [Method::GET, Method::HEAD, Method::POST, Method::PUT, Method::PATCH, Method::DELETE];
    let sent = [
        ACCEPT,
        AUTHORIZATION,
        CONTENT_ENCODING,
        CONTENT_TYPE,
        IF_MATCH,
        IF_NONE_MATCH,
        HeaderName::from_static("idempotency-key"),
        HeaderName::from_static("last-event-id"),
        REQUEST_ID,
    ];
    (!origins.is_empty()).then(|| {
        CorsLayer::new()
            .allow_origin(AllowOrigin::list(origins))
            .allow_methods(methods)
            .allow_headers(sent)
            .expose_headers([ETAG, LOCATION, RETRY_AFTER, REQUEST_ID])
            .max_age(PREFLIGHT_LIFE)
    })
}
