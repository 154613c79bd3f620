//! `/authority.crt`: the authority of the server's own certificate, for phones that shall trust it.

use axum::Router;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use hyper::header::{CACHE_CONTROL, CONTENT_TYPE};

use crate::domain::{Error, ErrorKind};
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::state::Rest;

/// The route exists without a setting, too, so that the answer can say what is missing.
pub(super) fn routes() -> Router<Rest> {
    Router::new().route("/authority.crt", get(answer))
}

async fn answer(State(rest): State<Rest>) -> ApiResult {
    let Some(path) = &rest.console.authority else {
        let message = "no authority is set (console.authority); `sightfix tls self-signed` makes one";
        return Err(Error::refused(ErrorKind::RouteNotFound, message).into());
    };
    let certificate = tokio::fs::read(path).await.map_err(Error::fault)?;
    Ok(respond(certificate))
}

/// Phones offer to install a file of this type.
fn respond(certificate: Vec<u8>) -> Response {
    let headers = [(CONTENT_TYPE, "application/x-x509-ca-cert"), (CACHE_CONTROL, "no-store")];
    (headers, certificate).into_response()
}
