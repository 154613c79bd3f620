//! Errors as RFC 9457 problems, by the one table in [`crate::status`].
//!
//! A handler's error carries no request; [`Refused::explain`] knows the request and writes the
//! problem, and the log line of a fault, once and here.

use std::any::Any;
use std::sync::Arc;

use axum::body::Body;
use axum::extract::Request;
use axum::response::{IntoResponse, Response};
use hyper::header::{CONTENT_LENGTH, CONTENT_TYPE, LOCATION, RETRY_AFTER, WWW_AUTHENTICATE};
use hyper::http::HeaderValue;
use hyper::{Method, StatusCode, Uri};
use serde::Serialize;
use utoipa::ToSchema;

use crate::domain::{Error, ErrorKind, Refusal};
use crate::http::plumbing::path_key::shown_path;
use crate::request::RequestContext;
use crate::status;
use crate::telemetry::RequestId;

/// Media type of a problem.
pub(in crate::http) const PROBLEM_JSON: &str = "application/problem+json";

/// Below it, problems also have the member of the Open Inference Protocol.
const INFERENCE: &str = "/v2";
/// Below it, what is wrong with a query is a 400, as OGC API Features demands.
const FEATURES: &str = "/ogc";

/// An error on its way to where its problem is written.
#[derive(Clone)]
pub(in crate::http) struct ApiError(Arc<Error>);

/// The result of a handler.
pub(in crate::http) type ApiResult<T = Response> = std::result::Result<T, ApiError>;

impl From<Error> for ApiError {
    fn from(error: Error) -> Self {
        Self(Arc::new(error))
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let mut response = status_of(&self.0).into_response();
        response.extensions_mut().insert(self);
        response
    }
}

/// A refusal or a fault, by RFC 9457.
#[derive(Serialize, ToSchema)]
pub(in crate::http) struct Problem<'a> {
    /// Stable name of the kind of problem.
    #[schema(value_type = String, example = "urn:sightfix:problem:invalid-argument")]
    r#type: String,
    /// The kind in words, the same for every occurrence.
    #[schema(value_type = String)]
    title: &'a str,
    /// The status of the answer.
    #[schema(example = 422)]
    status: u16,
    /// This occurrence in words.
    detail: String,
    /// The path that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    instance: Option<&'a str>,
    /// Id of the request, as in the header `x-request-id` and in the server's log.
    #[schema(value_type = String)]
    trace_id: &'a str,
    /// The fields at fault.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    violations: Vec<Violation<'a>>,
    /// Id of what stands in the way, such as the camera's live training run.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    conflicting_id: Option<&'a str>,
    /// The same as `detail`, where the Open Inference Protocol wants it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    error: Option<String>,
}

/// One field at fault.
#[derive(Serialize, ToSchema)]
struct Violation<'a> {
    /// Path of the field in the body, or name of the parameter.
    #[schema(value_type = String, example = "observations[3].bounding_box.width_px")]
    field: &'a str,
    /// States the fault and the valid values.
    #[schema(value_type = String)]
    message: &'a str,
}

fn status_of(error: &Error) -> StatusCode {
    StatusCode::from_u16(status::of(error.kind()).http).unwrap_or_default()
}

/// The problem of an error as a response.
pub(in crate::http) fn response(error: &Error, id: &RequestId, instance: Option<&str>) -> Response<Body> {
    let row = status::of(error.kind());
    let (detail, violations, conflicting_id) = match error {
        Error::Refused(refusal) => {
            let violations = refusal.violations.iter();
            let violations = violations.map(|at| Violation { field: &at.field, message: &at.message });
            (refusal.to_string(), violations.collect(), refusal.conflicting_id.as_deref())
        }
        Error::Fault(fault) => {
            tracing::error!(request.id = %id, error = %fault, "a request failed");
            ("the server failed; its log has more under this trace_id".to_owned(), Vec::new(), None)
        }
    };
    let is_inference = instance.is_some_and(|path| path.starts_with(INFERENCE));
    let problem = Problem {
        error: is_inference.then(|| detail.clone()),
        r#type: format!("{}{}", status::PROBLEM_TYPE_PREFIX, row.slug),
        title: row.title,
        status: row.http,
        detail,
        instance,
        trace_id: id.as_str(),
        violations,
        conflicting_id,
    };
    let json = serde_json::to_vec(&problem).unwrap_or_default();
    let mut response = Response::new(Body::from(json));
    *response.status_mut() = status_of(error);
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(PROBLEM_JSON));
    if let Some(seconds) = row.retry_after_s {
        headers.insert(RETRY_AFTER, seconds.into());
    }
    if error.kind() == ErrorKind::Unauthenticated {
        headers.insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"sightfix\""));
    }
    response
}

/// The facts about a request that its problem states, should it be refused.
pub(in crate::http) struct Refused {
    id: Option<RequestId>,
    uri: Uri,
    is_head: bool,
}

impl Refused {
    pub(in crate::http) fn of(request: &Request) -> Self {
        Self {
            id: RequestContext::of(request.extensions()).ok().map(|context| context.id().clone()),
            uri: request.uri().clone(),
            is_head: request.method() == Method::HEAD,
        }
    }

    /// The answer as it is, or the problem of a refusal, in whatever part of the router it was refused.
    pub(in crate::http) fn explain(self, answer: Response) -> Response {
        let error = match answer.extensions().get::<ApiError>() {
            Some(refused) => refused.0.clone(),
            None => match routing_error(&answer) {
                Some(error) => Arc::new(error),
                None => return answer,
            },
        };
        let error = if self.uri.path().starts_with(FEATURES) { as_query_error(&error) } else { error };
        let id = self.id.unwrap_or_else(|| RequestId::new(HeaderValue::from_static("none")));
        let mut problem = response(&error, &id, Some(&shown_path(self.uri.path())));
        if let Some(location) = location(&error, &self.uri) {
            problem.headers_mut().insert(LOCATION, location);
        }
        for (name, value) in answer.headers() {
            if name != CONTENT_TYPE && name != CONTENT_LENGTH {
                problem.headers_mut().insert(name, value.clone());
            }
        }
        if self.is_head {
            *problem.body_mut() = Body::empty();
        }
        problem
    }
}

/// The same request at the node that answers it.
fn location(error: &Error, uri: &Uri) -> Option<HeaderValue> {
    let Error::Refused(Refusal { other_node: Some(url), .. }) = error else { return None };
    let path = uri.path_and_query().map_or("/", |path| path.as_str());
    HeaderValue::try_from(format!("{url}{path}")).ok()
}

/// A value at fault as OGC API Features answers it; other errors as they are.
fn as_query_error(error: &Arc<Error>) -> Arc<Error> {
    match error.as_ref() {
        Error::Refused(refusal) if refusal.kind == ErrorKind::InvalidArgument => {
            Arc::new(Error::Refused(Refusal { kind: ErrorKind::InvalidQuery, ..refusal.clone() }))
        }
        Error::Refused(_) | Error::Fault(_) => error.clone(),
    }
}

/// The error of a request that the router itself refused, with a status alone.
fn routing_error(answer: &Response) -> Option<Error> {
    if answer.headers().contains_key(CONTENT_TYPE) {
        return None;
    }
    match answer.status() {
        StatusCode::NOT_FOUND => Some(no_route()),
        StatusCode::METHOD_NOT_ALLOWED => {
            Some(Error::refused(ErrorKind::MethodNotAllowed, "the header `allow` lists the methods"))
        }
        _ => None,
    }
}

pub(in crate::http) fn no_route() -> Error {
    Error::refused(ErrorKind::RouteNotFound, "there is no such path; /docs lists them")
}

/// The response when a handler panics.
pub(in crate::http) fn panicked(panic: Box<dyn Any + Send + 'static>) -> Response {
    let message = panic.downcast_ref::<String>().cloned();
    let message = message.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
    ApiError::from(Error::fault(format!("a handler panicked: {}", message.unwrap_or_default())))
        .into_response()
}
