//! Request bodies: read up to a limit, or spooled to a file so that a long one costs no memory.

use std::time::Duration;

use axum::body::Body;
use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::HeaderMap;
use hyper::header::{CONTENT_LENGTH, EXPECT};
use hyper::http::request::Parts;

use super::body_error::is_undecodable;
use crate::admission::ClientId;
use crate::app::{App, Spool, Spooled};
use crate::domain::{Error, ErrorKind, Result};

/// What is read and thrown away of a body that is too large, so that the client gets its answer
/// and not a broken connection, and for how long.
const DISCARD_BYTES: u64 = 256 << 20;
const DISCARD_TIME: Duration = Duration::from_secs(10);

/// The whole body.
///
/// # Errors
/// `TooLarge` beyond the limit; `Timeout` and `Cancelled` for a body that does not come.
pub(super) async fn whole(headers: &HeaderMap, mut body: Body, limit: usize) -> Result<Bytes> {
    check_announced(headers, &mut body, limit).await?;
    let Some(first) = next(&mut body).await? else { return Ok(Bytes::new()) };
    let mut gathered = Gathered::One(first);
    while let Some(part) = next(&mut body).await? {
        gathered = gathered.and(&part);
        if gathered.len() > limit {
            break;
        }
    }
    if gathered.len() > limit {
        discard(headers, &mut body).await;
        return Err(too_large(limit));
    }
    Ok(gathered.into_bytes())
}

/// Mostly a body comes in one part, which then need not be copied.
enum Gathered {
    One(Bytes),
    Many(BytesMut),
}

impl Gathered {
    fn and(self, part: &[u8]) -> Self {
        let mut many = match self {
            Self::One(first) => BytesMut::from(first),
            Self::Many(many) => many,
        };
        many.extend_from_slice(part);
        Self::Many(many)
    }

    fn len(&self) -> usize {
        match self {
            Self::One(bytes) => bytes.len(),
            Self::Many(bytes) => bytes.len(),
        }
    }

    fn into_bytes(self) -> Bytes {
        match self {
            Self::One(bytes) => bytes,
            Self::Many(bytes) => bytes.freeze(),
        }
    }
}

/// The body of an import, in memory up to a size and in a temporary file beyond.
///
/// # Errors
/// As [`whole`]; `Overloaded` if all imports together hold as much as they may; a fault if the
/// temporary file cannot be written.
pub(super) async fn spooled(app: &App, head: &Parts, mut body: Body) -> Result<Spooled> {
    let limit = app.limits.import_bytes;
    check_announced(&head.headers, &mut body, limit).await?;
    let mut spool = Spool::new(app, client_id(head))?;
    while let Some(part) = next(&mut body).await? {
        let pushed =
            if spool.length() + part.len() > limit { Err(too_large(limit)) } else { spool.push(part).await };
        if let Err(error) = pushed {
            discard(&head.headers, &mut body).await;
            return Err(error);
        }
    }
    spool.finish().await
}

/// Who sends a request.
pub(super) fn client_id(head: &Parts) -> ClientId {
    head.extensions.get().copied().unwrap_or(ClientId::UNKNOWN)
}

async fn next(body: &mut Body) -> Result<Option<Bytes>> {
    loop {
        match body.frame().await {
            None => return Ok(None),
            Some(Err(error)) if is_undecodable(&error) => {
                return Err(Error::refused(
                    ErrorKind::MalformedBody,
                    "the body is not of its content-encoding, or is cut off",
                ));
            }
            // Why a body was refused is known, and reported, where requests are admitted.
            Some(Err(_)) => return Err(Error::refused(ErrorKind::Cancelled, "the body broke off")),
            Some(Ok(frame)) => {
                if let Ok(part) = frame.into_data() {
                    return Ok(Some(part));
                }
            }
        }
    }
}

fn too_large(limit: usize) -> Error {
    Error::refused(ErrorKind::TooLarge, format!("the body may have at most {limit} bytes"))
}

/// Refuses a body by the length that its header announces, before any of it is read.
async fn check_announced(headers: &HeaderMap, body: &mut Body, limit: usize) -> Result<()> {
    if announced(headers).is_some_and(|length| length > limit as u64) {
        discard(headers, body).await;
        return Err(too_large(limit));
    }
    Ok(())
}

fn announced(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}

/// Many clients send all before they read a word; an answer to a half-read body would reach them
/// as a reset connection. One that waits for `100 Continue` is answered at once.
pub(super) async fn discard(headers: &HeaderMap, body: &mut Body) {
    if headers.contains_key(EXPECT) || announced(headers).is_some_and(|length| length > DISCARD_BYTES) {
        return;
    }
    let reading = async {
        let mut left = DISCARD_BYTES;
        while let Ok(Some(part)) = next(body).await {
            left = left.saturating_sub(part.len() as u64);
            if left == 0 {
                return;
            }
        }
    };
    // Whether all came or not, the answer is the same.
    let _ = tokio::time::timeout(DISCARD_TIME, reading).await;
}
