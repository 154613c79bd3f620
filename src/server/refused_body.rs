//! Bodies of refused requests: the rest is read, so that the client reads the refusal, and what was read in vain is charged.

use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use http_body_util::BodyExt as _;
use hyper::Response;
use hyper::body::{Body as _, Incoming};
use hyper::http::HeaderValue;
use tokio::sync::Semaphore;

use super::activity::GRPC_STATUS;
use crate::config::Limits;
use crate::domain::ErrorKind;
use crate::status;

/// Bodies of refused requests that are read to their end at a time; more clients are answered at once.
const DISCARDED_BODIES: usize = 256;
/// Longest body of a refused request that is read, in bytes.
const DISCARD_BYTES: u64 = 256 << 20;
/// How long the body of a refused request is read.
const DISCARD_TIME: Duration = Duration::from_secs(10);

/// Refusals of what a request contains or asks for: its body was read in vain.
const OF_REQUEST: [ErrorKind; 6] = [
    ErrorKind::MalformedBody,
    ErrorKind::InvalidArgument,
    ErrorKind::Unauthenticated,
    ErrorKind::PermissionDenied,
    ErrorKind::RouteNotFound,
    ErrorKind::TooLarge,
];

/// Reads the rest of bodies: a client that sends all before it reads a word would else find a broken connection instead
/// of the refusal.
pub(super) struct Discards(Semaphore);

impl Default for Discards {
    fn default() -> Self {
        Self(Semaphore::new(DISCARDED_BODIES))
    }
}

impl Discards {
    /// Reads a rest, of which nothing is decoded; how many bytes.
    pub(super) async fn read(&self, rest: Option<Incoming>) -> u64 {
        let Some(mut body) = rest.filter(|body| body.size_hint().lower() <= DISCARD_BYTES) else { return 0 };
        let Ok(_turn) = self.0.try_acquire() else { return 0 };
        let mut bytes = 0;
        let reading = async {
            while bytes < DISCARD_BYTES
                && let Some(Ok(frame)) = body.frame().await
            {
                bytes += frame.data_ref().map_or(0, Bytes::len) as u64;
            }
        };
        // The answer does not depend on the rest.
        let _ = tokio::time::timeout(DISCARD_TIME, reading).await;
        bytes
    }
}

/// The bytes that a client is charged for a body and a rest that was discarded: nothing unless it was refused.
pub(super) fn read_in_vain(
    response: &Response<Body>,
    received_bytes: u64,
    discarded_bytes: u64,
    is_encoded: bool,
    limits: &Limits,
) -> u64 {
    let is = |kind| response.status().as_u16() == status::of(kind).http;
    let is_refused = match response.headers().get(GRPC_STATUS).map(HeaderValue::to_str) {
        // Among the codes of gRPC only this one is always about the content.
        Some(code) => {
            let invalid = status::of(ErrorKind::InvalidArgument).grpc;
            code.is_ok_and(|code| code.parse::<i32>() == Ok(invalid))
        }
        None => OF_REQUEST.into_iter().any(is),
    };
    if !is_refused {
        return 0;
    }
    let body_bytes = limits.body_bytes as u64;
    // The decoded size is not known here; the largest size that a body may have is.
    let is_decoded = is_encoded && received_bytes > 0;
    let read_bytes = if is_decoded { received_bytes.max(body_bytes) } else { received_bytes };
    // Bytes beyond a limit are not looked at.
    let most_bytes = if is(ErrorKind::TooLarge) { body_bytes } else { u64::MAX };
    (read_bytes + discarded_bytes).min(most_bytes)
}
