//! Errors as gRPC statuses. The only place of this transport that makes a status.

use std::collections::HashMap;
use std::time::Duration;

use hyper::http::Extensions;
use hyper::http::HeaderValue;
use hyper::{HeaderMap, Response};
use tonic::{Code, Request, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt as _};

use crate::app::App;
use crate::domain::{Error, ErrorKind, Refusal, Result, Violation};
use crate::request::RequestContext;
use crate::status;
use crate::telemetry::RequestId;

/// Who speaks in `ErrorInfo`.
const DOMAIN: &str = "sightfix";
/// Key of the address of the node to ask instead, in the metadata of `ErrorInfo`.
const OWNER: &str = "owner";
/// Clients take no more than some kB of headers, and texts may quote what they sent.
const LONGEST_TEXT: usize = 400;
/// The same for each text about a field at fault.
const LONGEST_VIOLATION_TEXT: usize = 160;

/// The result of a unary method.
pub(super) type Reply<T> = std::result::Result<tonic::Response<T>, Status>;

/// Answers a unary request by a use case, which gets the application on behalf of the caller.
pub(super) async fn answer<M, R, F>(
    app: &App,
    request: Request<M>,
    handle: impl FnOnce(App, M) -> F,
) -> Reply<R>
where
    F: Future<Output = Result<R>>,
{
    let (_, extensions, message) = request.into_parts();
    let context = context(&extensions)?;
    match handle(app.on_behalf_of(context.caller().clone()), message).await {
        Ok(reply) => Ok(tonic::Response::new(reply)),
        Err(error) => Err(to_status(&error, context.id())),
    }
}

/// Returns the context of the request.
///
/// # Errors
/// `INTERNAL` for a request that did not come through the server's layers.
pub(super) fn context(extensions: &Extensions) -> std::result::Result<&RequestContext, Status> {
    let unknown = || RequestId::new(HeaderValue::from_static("unknown"));
    RequestContext::of(extensions).map_err(|error| to_status(&error, &unknown()))
}

/// An error as the last frame of a response.
#[must_use]
pub fn trailers(error: &Error, id: &RequestId) -> HeaderMap {
    let mut trailers = HeaderMap::new();
    // All of it was made here from text, so it fits into headers.
    let _ = to_status(error, id).add_header(&mut trailers);
    trailers
}

/// An error with its code and details: `ErrorInfo` with the problem's slug as reason (and as `owner` in its metadata the
/// address of the node to ask instead), `RequestInfo`,
/// `RetryInfo` where a later try may succeed, and `BadRequest` where fields are at fault. A fault is logged here and nothing of it is shown.
pub(super) fn to_status(error: &Error, id: &RequestId) -> Status {
    let row = status::of(error.kind());
    let mut metadata = HashMap::new();
    if let Error::Refused(Refusal { conflicting_id: Some(id), .. }) = error {
        metadata.insert("conflicting_id".to_owned(), id.clone());
    }
    if let Error::Refused(Refusal { other_node: Some(url), .. }) = error {
        metadata.insert(OWNER.to_owned(), url.clone());
    }
    let mut details = ErrorDetails::with_error_info(row.slug, DOMAIN, metadata);
    details.set_request_info(id.as_str(), "");
    if let Some(seconds) = row.retry_after_s {
        details.set_retry_info(Some(Duration::from_secs(seconds.into())));
    }
    let message = match error {
        Error::Refused(refusal) => {
            if !refusal.violations.is_empty() {
                details.set_bad_request(violations(refusal));
            }
            shortened(&refusal.to_string(), LONGEST_TEXT)
        }
        Error::Fault(fault) => {
            tracing::error!(request.id = %id, error = %fault, "a request failed");
            row.title.to_owned()
        }
    };
    Status::with_error_details(Code::from(row.grpc), message, details)
}

fn violations(refusal: &Refusal) -> Vec<FieldViolation> {
    let short = |text| shortened(text, LONGEST_VIOLATION_TEXT);
    let violations = refusal.violations.iter();
    violations.map(|Violation { field, message }| FieldViolation::new(short(field), short(message))).collect()
}

fn shortened(text: &str, most_bytes: usize) -> String {
    if text.len() <= most_bytes {
        return text.to_owned();
    }
    format!("{}...", &text[..text.floor_char_boundary(most_bytes)])
}

/// An answer that tonic gave by itself (no such method, a message too large or not of its type) with
/// the code and the details of the same table; any other answer as it is.
pub fn explain<B>(mut response: Response<B>, id: &RequestId) -> Response<B> {
    let Some(bare) = Status::from_header_map(response.headers()).filter(|status| status.details().is_empty())
    else {
        return response;
    };
    let error = match bare.code() {
        Code::Unimplemented if bare.message().is_empty() => Error::refused(
            ErrorKind::RouteNotFound,
            "there is no such service or method; server reflection lists those that there are",
        ),
        Code::OutOfRange | Code::Internal => broken(&bare),
        _ => return response,
    };
    // All of it was made here from text, so it fits into headers.
    let _ = to_status(&error, id).add_header(response.headers_mut());
    response
}

/// The address of the node that answers instead, of the head of a response that names one.
#[must_use]
pub fn owner(headers: &HeaderMap) -> Option<String> {
    let status = Status::from_header_map(headers).filter(|status| status.code() == Code::Unavailable)?;
    status.get_details_error_info()?.metadata.remove(OWNER)
}

/// Why a client's message could not be read, from what tonic says of it.
pub(super) fn broken(status: &Status) -> Error {
    let kind = match status.code() {
        Code::OutOfRange | Code::ResourceExhausted => ErrorKind::TooLarge,
        Code::Cancelled => ErrorKind::Cancelled,
        Code::DeadlineExceeded => ErrorKind::Timeout,
        _ => ErrorKind::MalformedBody,
    };
    Error::refused(kind, format!("the message cannot be read: {}", status.message()))
}
