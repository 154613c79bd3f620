//! The caller of a REST request: authorised once for all routes, and the application on its behalf.

use axum::extract::{FromRequestParts, MatchedPath, Request};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use hyper::http::request::Parts;

use super::Rest;
use super::body::discard;
use super::problem::{ApiError, ApiResult};
use crate::app::App;
use crate::app::access::{Caller, Permission};
use crate::domain::Error;

/// Compares what the matched route needs with what the caller may do, before the handler runs.
pub(super) async fn authorize(request: Request, next: Next) -> Response {
    let template = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    let permission = Permission::of_route(request.method().as_str(), template);
    let authorized = match request.extensions().get::<Caller>() {
        Some(caller) => caller.authorize(permission),
        None => Err(no_caller()),
    };
    match authorized {
        Ok(()) => next.run(request).await,
        Err(error) => {
            let (head, mut body) = request.into_parts();
            discard(&head.headers, &mut body).await;
            ApiError::from(error).into_response()
        }
    }
}

/// The application on behalf of the request's caller.
pub(super) struct CallerApp(pub(super) App);

impl FromRequestParts<Rest> for CallerApp {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, rest: &Rest) -> ApiResult<Self> {
        let caller = parts.extensions.get::<Caller>().ok_or_else(no_caller)?;
        Ok(Self(rest.app.on_behalf_of(caller.clone())))
    }
}

fn no_caller() -> Error {
    Error::fault("a request came without its caller")
}
