//! The page `/docs`: the REST interface as Swagger UI shows it, in a page of our own that passes the checks of accessibility.

use axum::Router;
use axum::http::HeaderValue;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_FRAME_OPTIONS};
use axum::middleware::map_response;
use axum::response::{Redirect, Response};
use axum::routing::get;
use utoipa::openapi::OpenApi;
use utoipa_swagger_ui::SwaggerUi;

const PAGE: &str = include_str!("page.html");
const SCRIPT: &str = include_str!("page.js");
const STYLE: &str = include_str!("page.css");

/// The content security policy of the page: it runs its own scripts and asks its own server only.
/// Swagger UI sets styles by attribute and shows images that it holds itself.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; \
     img-src 'self' data:; font-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

/// The description at `/openapi.json`, its page at `/docs/`, and the library's files under `/docs/swagger`.
pub(super) fn routes<S: Clone + Send + Sync + 'static>(described: OpenApi) -> Router<S> {
    let library = Router::from(SwaggerUi::new("/docs/swagger").url("/openapi.json", described));
    let file = |content_type, text| get(move || async move { ([(CONTENT_TYPE, content_type)], text) });
    Router::new()
        .route("/docs", get(|| async { Redirect::to("/docs/") }))
        .route("/docs/", file("text/html; charset=utf-8", PAGE))
        .route("/docs/page.js", file("text/javascript; charset=utf-8", SCRIPT))
        .route("/docs/page.css", file("text/css; charset=utf-8", STYLE))
        .merge(library)
        .layer(map_response(contain))
}

/// Limits what the page may do.
async fn contain(mut response: Response) -> Response {
    for (name, value) in
        [(CONTENT_SECURITY_POLICY, POLICY), (X_FRAME_OPTIONS, "DENY"), (REFERRER_POLICY, "no-referrer")]
    {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}
