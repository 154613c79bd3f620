//! `/v1/tiles`: the file of map tiles that the setting `console.tile_file` names.

use std::io::SeekFrom;
use std::path::Path;
use std::time::UNIX_EPOCH;

use axum::body::Body;
use axum::extract::State;
use axum::response::Response;
use hyper::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG, IF_RANGE, RANGE,
};
use hyper::http::HeaderValue;
use hyper::{HeaderMap, StatusCode};
use tokio::fs::File;
use tokio::io::{AsyncReadExt as _, AsyncSeekExt as _};
use tokio_util::io::ReaderStream;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::domain::{Error, ErrorKind, Result};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;

/// Where the file is.
pub(super) const TILES_PATH: &str = "/v1/tiles";

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_tiles))
}

/// Read the file of map tiles
///
/// A PMTiles file, which readers fetch in ranges of bytes (RFC 9110, 14). Several ranges in one request are not
/// served; such a request gets the whole file.
#[utoipa::path(
    get, path = "/v1/tiles", tag = "service",
    params(("range" = Option<String>, Header, description = "A range of bytes", example = "bytes=0-16383")),
    responses(
        (status = 200, description = "The whole file", content_type = "application/vnd.pmtiles", body = Vec<u8>),
        (status = 206, description = "The range of it", content_type = "application/vnd.pmtiles", body = Vec<u8>),
        (status = 404, description = "No file is set", body = Problem, content_type = "application/problem+json"),
        (status = 416, description = "The range begins after its end", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_tiles(State(rest): State<Rest>, headers: HeaderMap) -> ApiResult {
    let Some(path) = &rest.console.tile_file else {
        let message = "no file of map tiles is set (console.tile_file)";
        return Err(Error::refused(ErrorKind::RouteNotFound, message).into());
    };
    Ok(answer(path, &headers).await?)
}

async fn answer(path: &Path, headers: &HeaderMap) -> Result<Response> {
    let mut file = File::open(path).await.map_err(Error::fault)?;
    let metadata = file.metadata().await.map_err(Error::fault)?;
    let length = metadata.len();
    let modified = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let tag = format!("\"{length:x}-{:x}\"", modified.unwrap_or_default().as_nanos());
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let is_current = text(IF_RANGE).is_none_or(|known| known == tag);
    let range =
        text(RANGE).filter(|_| is_current).and_then(|asked| ByteRange::parse(asked, length)).transpose()?;

    let ByteRange { first, last } = range.unwrap_or(ByteRange { first: 0, last: length.saturating_sub(1) });
    let count = if length == 0 { 0 } else { last - first + 1 };
    file.seek(SeekFrom::Start(first)).await.map_err(Error::fault)?;
    let mut response = Response::new(Body::from_stream(ReaderStream::new(file.take(count))));
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/vnd.pmtiles"));
    headers.insert(ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("private, max-age=3600"));
    headers.insert(CONTENT_LENGTH, HeaderValue::from(count));
    headers.insert(ETAG, HeaderValue::from_str(&tag).map_err(Error::fault)?);
    if range.is_some() {
        let content_range = format!("bytes {first}-{last}/{length}");
        headers.insert(CONTENT_RANGE, HeaderValue::from_str(&content_range).map_err(Error::fault)?);
        *response.status_mut() = StatusCode::PARTIAL_CONTENT;
    }
    Ok(response)
}

/// Bytes of a file, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct ByteRange {
    first: u64,
    last: u64,
}

impl ByteRange {
    /// The single range that a `Range` header asks of a file; `None` for what is to be ignored: another unit,
    /// several ranges, or text that is no range.
    fn parse(text: &str, length: u64) -> Option<Result<Self>> {
        let (first, last) = text.strip_prefix("bytes=")?.trim().split_once('-')?;
        let is_number = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
        if !is_number(first) || !is_number(last) || (first.is_empty() && last.is_empty()) {
            return None;
        }
        // Beyond u64 is after every end.
        let number = |part: &str| part.parse().unwrap_or(u64::MAX);
        let range = if first.is_empty() {
            let count = number(last).min(length);
            Self { first: length - count, last: length.saturating_sub(1) }
        } else {
            let end = if last.is_empty() { u64::MAX } else { number(last) };
            if end < number(first) {
                return None;
            }
            Self { first: number(first), last: end.min(length.saturating_sub(1)) }
        };
        Some(if range.first < length {
            Ok(range)
        } else {
            let message = format!("the file has {length} bytes");
            Err(Error::field(ErrorKind::RangeNotSatisfiable, "range", message))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Option<std::result::Result<(u64, u64), ErrorKind>> {
        let range = ByteRange::parse(text, 100)?;
        Some(range.map(|range| (range.first, range.last)).map_err(|error| match error {
            Error::Refused(refusal) => refusal.kind,
            Error::Fault(_) => ErrorKind::Internal,
        }))
    }

    #[test]
    fn a_range_is_cut_at_the_end_and_refused_after_it() {
        assert_eq!(parsed("bytes=0-9"), Some(Ok((0, 9))));
        assert_eq!(parsed("bytes=90-16383"), Some(Ok((90, 99))));
        assert_eq!(parsed("bytes=99-"), Some(Ok((99, 99))));
        assert_eq!(parsed("bytes=-10"), Some(Ok((90, 99))));
        assert_eq!(parsed("bytes=-1000"), Some(Ok((0, 99))));
        for later in ["bytes=100-", "bytes=100-200", "bytes=-0", "bytes=99999999999999999999-"] {
            assert_eq!(parsed(later), Some(Err(ErrorKind::RangeNotSatisfiable)), "{later}");
        }
        for ignored in ["bytes=5-1", "bytes=0-1,3-4", "rows=0-1", "bytes=-", "bytes=a-b", ""] {
            assert_eq!(parsed(ignored), None, "{ignored}");
        }
    }
}
