//! Entity tags of resources with revisions: `ETag`, `If-Match`, `If-None-Match` (RFC 9110, 13.1).

use axum::body::Body;
use axum::response::Response;
use http_body_util::BodyExt as _;
use hyper::header::{CONTENT_TYPE, ETAG, IF_MATCH, IF_NONE_MATCH};
use hyper::http::HeaderValue;
use hyper::{HeaderMap, StatusCode};

use crate::domain::{Error, ErrorKind, ExpectedVersion, Result, Revision};

/// Reads the version that a change is based on from the required `If-Match`; `None` for `*`, any version.
///
/// # Errors
/// `RevisionRequired` without the header; `RevisionMismatch` for what this server never gave.
pub(in crate::http) fn required<K: From<i64>>(headers: &HeaderMap) -> Result<Option<ExpectedVersion<K>>> {
    if headers.contains_key(IF_MATCH) {
        return optional(headers);
    }
    let message = "the header must name the revision that the change is based on, as `etag` gave it, or be *";
    Err(Error::field(ErrorKind::RevisionRequired, "if-match", message))
}

/// The same where the header may be left out, which means whatever is there.
///
/// # Errors
/// `RevisionMismatch` for what this server never gave.
pub(in crate::http) fn optional<K: From<i64>>(headers: &HeaderMap) -> Result<Option<ExpectedVersion<K>>> {
    let Some(value) = headers.get(IF_MATCH) else { return Ok(None) };
    let text = value.to_str().unwrap_or_default().trim();
    if text == "*" {
        return Ok(None);
    }
    let quoted = text.strip_prefix('"').and_then(|rest| rest.strip_suffix('"'));
    let version = quoted.and_then(version_of).ok_or_else(|| {
        // No version of ours ever looked like this, so none can match it.
        let message = "must be an `etag` as this server gave it, quotes included, or *";
        Error::field(ErrorKind::RevisionMismatch, "if-match", message)
    })?;
    Ok(Some(version))
}

/// The version in an `etag`; a revision alone is understood, too.
fn version_of<K: From<i64>>(etag: &str) -> Option<ExpectedVersion<K>> {
    let mut parts = etag.split('.');
    match (parts.next(), parts.next(), parts.next(), parts.next()) {
        (Some(revision), None, ..) => Some(Revision(revision.parse().ok()?).into()),
        (Some(key), Some(revision), Some(_), None) => Some(ExpectedVersion {
            key: Some(key.parse::<i64>().ok()?.into()),
            revision: Revision(revision.parse().ok()?),
        }),
        _ => None,
    }
}

/// Names what is shown: which resource of that id, its revision, and a digest, for parts of it may change
/// without a revision.
pub(in crate::http) async fn with_etag<K: Into<i64>>(
    response: Response,
    version: ExpectedVersion<K>,
) -> Result<Response> {
    let (mut head, body) = response.into_parts();
    let body = body.collect().await.map_err(Error::fault)?.to_bytes();
    let key: i64 = version.key.map_or(0, Into::into);
    let etag = format!("\"{key}.{}.{:08x}\"", version.revision.0, crc32fast::hash(&body));
    head.headers.insert(ETAG, HeaderValue::from_str(&etag).map_err(Error::fault)?);
    Ok(Response::from_parts(head, Body::from(body)))
}

/// A 304 instead of what the client has shown already.
pub(in crate::http) fn unless_known(headers: &HeaderMap, response: Response) -> Response {
    let Some(etag) = response.headers().get(ETAG).and_then(|etag| etag.to_str().ok()) else {
        return response;
    };
    let known = headers.get_all(IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    let mut known = known.flat_map(|list| list.split(',')).map(str::trim);
    if !known.any(|known| known == "*" || known.strip_prefix("W/").unwrap_or(known) == etag) {
        return response;
    }
    let (mut head, _) = response.into_parts();
    head.status = StatusCode::NOT_MODIFIED;
    head.headers.remove(CONTENT_TYPE);
    Response::from_parts(head, Body::empty())
}
