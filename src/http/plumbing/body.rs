//! Request bodies: read up to a limit, or spooled to a file so that a long one costs no memory.

use axum::body::Body;
use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::HeaderMap;
use hyper::header::CONTENT_LENGTH;
use hyper::http::request::Parts;

use super::body_error::BodyError;
use crate::app::{App, Spool, Spooled};
use crate::domain::{Error, ErrorKind, Result};
use crate::request::RequestContext;

/// The whole body. What is beyond the limit is not read, and so never decoded.
///
/// # Errors
/// `TooLarge` beyond the limit; `Timeout` and `Cancelled` for a body that does not come.
pub(in crate::http) async fn whole(headers: &HeaderMap, mut body: Body, limit: usize) -> Result<Bytes> {
    check_announced(headers, limit)?;
    let Some(first) = next(&mut body).await? else { return Ok(Bytes::new()) };
    let mut gathered = Gathered::One(first);
    while let Some(part) = next(&mut body).await? {
        gathered = gathered.and(&part);
        if gathered.len() > limit {
            break;
        }
    }
    if gathered.len() > limit { Err(too_large(limit)) } else { Ok(gathered.into_bytes()) }
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
pub(in crate::http) async fn spooled(app: &App, head: &Parts, mut body: Body) -> Result<Spooled> {
    let limit = app.limits.import_bytes;
    check_announced(&head.headers, limit)?;
    let mut spool = Spool::new(app, RequestContext::of(&head.extensions)?.client())?;
    while let Some(part) = next(&mut body).await? {
        if spool.length() + part.len() > limit {
            return Err(too_large(limit));
        }
        spool.push(part).await?;
    }
    spool.finish().await
}

async fn next(body: &mut Body) -> Result<Option<Bytes>> {
    loop {
        match body.frame().await {
            None => return Ok(None),
            Some(Err(error)) => return Err(BodyError::of(&error).refusal()),
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
fn check_announced(headers: &HeaderMap, limit: usize) -> Result<()> {
    if announced(headers).is_some_and(|length| length > limit as u64) {
        return Err(too_large(limit));
    }
    Ok(())
}

fn announced(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}
