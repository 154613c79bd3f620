//! The header `idempotency-key`.

use axum::extract::FromRequestParts;
use hyper::HeaderMap;
use hyper::header::CONTENT_TYPE;
use hyper::http::request::Parts;

use super::problem::{ApiError, ApiResult};
use crate::domain::{Error, IdempotencyKey, IdempotentRequest, RequestHasher, Result};

const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The request as one that its client may repeat, if it has a key; its body is still to be hashed.
pub(in crate::http) struct Idempotent(pub(in crate::http) Option<IdempotentRequest>);

impl<S: Send + Sync> FromRequestParts<S> for Idempotent {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> ApiResult<Self> {
        Ok(Self(idempotent(parts)?))
    }
}

/// The request as one that its client may repeat, if it has a key; its body is still to be hashed.
///
/// # Errors
/// `InvalidArgument` naming the header.
pub(in crate::http) fn idempotent(head: &Parts) -> Result<Option<IdempotentRequest>> {
    let Some(key) = key_of(&head.headers)? else { return Ok(None) };
    let hasher = RequestHasher::default();
    hasher.update(head.method.as_str().as_bytes());
    hasher.update(head.uri.path().as_bytes());
    hasher.update(head.uri.query().unwrap_or_default().as_bytes());
    // The boundary of a multipart body is another one each time.
    let content_type = head.headers.get(CONTENT_TYPE).map_or(&b""[..], |value| value.as_bytes());
    hasher.update(content_type.split(|byte| *byte == b';').next().unwrap_or_default());
    Ok(Some(IdempotentRequest { key, hasher }))
}

fn key_of(headers: &HeaderMap) -> Result<Option<IdempotencyKey>> {
    let mut values = headers.get_all(IDEMPOTENCY_KEY).iter();
    let Some(value) = values.next() else { return Ok(None) };
    match value.to_str() {
        Ok(text) if values.next().is_none() => IdempotencyKey::new(text).map(Some),
        _ => {
            Err(Error::invalid(IDEMPOTENCY_KEY, "the header must have one value of visible ASCII characters"))
        }
    }
}
