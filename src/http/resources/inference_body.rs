//! Bodies of inference requests: JSON, or JSON with the elements of its tensors after it (the binary tensor data extension
//! of the Open Inference Protocol).

use axum::extract::{FromRequest, Request};
use bytes::Bytes;
use hyper::HeaderMap;
use serde::Deserialize;

use crate::domain::{Error, ErrorKind, Result};
use crate::exchange::wire::parse_document;
use crate::http::plumbing::body;
use crate::http::plumbing::extract::{media_type, not_read};
use crate::http::plumbing::problem::{ApiError, ApiResult};
use crate::http::plumbing::state::Rest;

/// Number of bytes of JSON before the elements.
const JSON_LENGTH: &str = "inference-header-content-length";

/// A request as it came.
pub(super) struct InferenceBody {
    json: Bytes,
    /// Elements of tensors, little-endian.
    pub(super) elements: Bytes,
}

impl FromRequest<Rest> for InferenceBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, rest: &Rest) -> ApiResult<Self> {
        let (parts, content) = request.into_parts();
        // Triton's client names no type.
        let is_read = media_type(&parts.headers).is_none_or(|essence| {
            ["application/json", "application/octet-stream"].iter().any(|it| it.eq_ignore_ascii_case(essence))
        });
        let mut json = body::whole(&parts.headers, content, rest.app.limits.body_bytes).await?;
        if !is_read && !json.is_empty() {
            return Err(not_read(&["application/json", "application/octet-stream"]).into());
        }
        let length = json_length(&parts.headers, json.len())?;
        let elements = json.split_off(length);
        Ok(Self { json, elements })
    }
}

/// The number of bytes of JSON; all without a header.
fn json_length(headers: &HeaderMap, length: usize) -> Result<usize> {
    let Some(stated) = headers.get(JSON_LENGTH) else { return Ok(length) };
    let stated = stated.to_str().ok().and_then(|text| text.parse().ok()).filter(|stated| *stated <= length);
    stated.ok_or_else(|| {
        Error::invalid(JSON_LENGTH, format!("must be a number of bytes up to {length}, the body's"))
    })
}

impl InferenceBody {
    /// The JSON of the request.
    ///
    /// # Errors
    /// As of a body of JSON.
    pub(super) fn read<'a, T: Deserialize<'a>>(&'a self) -> Result<T> {
        if self.json.is_empty() {
            return Err(Error::refused(ErrorKind::MalformedBody, "the operation needs a body of JSON"));
        }
        parse_document(&self.json)
    }
}
