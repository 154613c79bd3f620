//! Content codings of bodies: gzip and zstd, both ways.
//!
//! A body is decoded as it is read, so its reader applies the limit: of one that decodes to more,
//! no more than the limit is ever held. What never happens here: a body decoded at once, an event stream or
//! what is compressed already compressed.

use std::convert::Infallible;
use std::io;

use async_compression::tokio::bufread::{GzipDecoder, ZstdDecoder};
use async_compression::zstd::DParameter;
use axum::body::Body;
use axum::extract::Request;
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use futures_util::{Stream, StreamExt as _, TryStreamExt as _};
use hyper::header::{ACCEPT_ENCODING, CONTENT_ENCODING, CONTENT_LENGTH, ETAG};
use hyper::http::{Extensions, HeaderValue};
use hyper::{HeaderMap, StatusCode, Version};
use tokio::io::AsyncRead;
use tokio_util::io::{ReaderStream, StreamReader};
use tower::{Layer as _, ServiceExt as _, service_fn};
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{DefaultPredicate, Predicate, SizeAbove};

use super::body::discard;
use super::body_error::BodyError;
use super::problem::ApiError;
use crate::domain::{Error, ErrorKind};

/// Smaller responses are not worth it.
const SMALLEST_RESPONSE: u64 = 1_024;
/// A decoder of zstd holds no more than this many bytes of what it has decoded, 8 MiB (RFC 9659).
const ZSTD_WINDOW_LOG: u32 = 23;
/// Decoded at once.
const CHUNK_BYTES: usize = 32 * 1024;

/// What a client accepts of the codings of a response.
pub(super) struct AcceptedCoding(Vec<HeaderValue>);

impl AcceptedCoding {
    pub(super) fn of(request: &Request) -> Self {
        Self(request.headers().get_all(ACCEPT_ENCODING).iter().cloned().collect())
    }

    /// Compresses a response for a client that accepts it. A response with an entity tag stays as it is: its
    /// tag is that of these bytes (RFC 9110, 8.8.3.3).
    pub(super) async fn encode(self, response: Response) -> Response {
        if self.0.is_empty() {
            return response;
        }
        let has_no_tag =
            |_: StatusCode, _: Version, headers: &HeaderMap, _: &Extensions| !headers.contains_key(ETAG);
        let worthwhile = DefaultPredicate::new().and(SizeAbove::new(SMALLEST_RESPONSE)).and(has_no_tag);
        let mut asked = Request::new(Body::empty());
        for value in self.0 {
            asked.headers_mut().append(ACCEPT_ENCODING, value);
        }
        let mut response = Some(response);
        let answer = service_fn(|_: Request| {
            let response = response.take().unwrap_or_default();
            async { Ok::<_, Infallible>(response) }
        });
        let Ok(encoded) =
            CompressionLayer::new().compress_when(worthwhile).layer(answer).oneshot(asked).await;
        encoded.map(Body::new)
    }
}

/// The request with its body decoded as it is read.
///
/// # Errors
/// The refusal of a coding that is not read here.
pub(super) async fn decoded(request: Request) -> Result<Request, Response> {
    if !request.headers().contains_key(CONTENT_ENCODING) {
        return Ok(request);
    }
    let (mut head, mut body) = request.into_parts();
    match coding_of(&head.headers) {
        Ok(Some(coding)) => {
            head.headers.remove(CONTENT_ENCODING);
            head.headers.remove(CONTENT_LENGTH);
            body = coding.decode(body);
        }
        Ok(None) => {}
        Err(error) => {
            discard(&head.headers, &mut body).await;
            let mut refusal = ApiError::from(error).into_response();
            refusal.headers_mut().insert(ACCEPT_ENCODING, HeaderValue::from_static("gzip, zstd"));
            return Err(refusal);
        }
    }
    Ok(Request::from_parts(head, body))
}

#[derive(Clone, Copy)]
enum Coding {
    Gzip,
    Zstd,
}

fn coding_of(headers: &HeaderMap) -> Result<Option<Coding>, Error> {
    let mut codings = headers.get_all(CONTENT_ENCODING).iter();
    let coding = match (codings.next(), codings.next()) {
        (None, _) => return Ok(None),
        (Some(coding), None) => coding.to_str().unwrap_or_default().trim().to_ascii_lowercase(),
        (Some(_), Some(_)) => String::new(),
    };
    match coding.as_str() {
        "identity" => Ok(None),
        "gzip" | "x-gzip" => Ok(Some(Coding::Gzip)),
        "zstd" => Ok(Some(Coding::Zstd)),
        _ => Err(Error::field(
            ErrorKind::UnsupportedMediaType,
            "content-encoding",
            "the header must be gzip or zstd, once, or be left out",
        )),
    }
}

impl Coding {
    fn decode(self, body: Body) -> Body {
        let coded = StreamReader::new(body.into_data_stream().map_err(io::Error::other));
        match self {
            Self::Gzip => {
                let mut decoder = GzipDecoder::new(coded);
                decoder.multiple_members(true);
                Body::from_stream(chunks(decoder))
            }
            Self::Zstd => {
                let mut decoder =
                    ZstdDecoder::with_params(coded, &[DParameter::window_log_max(ZSTD_WINDOW_LOG)]);
                decoder.multiple_members(true);
                Body::from_stream(chunks(decoder))
            }
        }
    }
}

fn chunks(decoder: impl AsyncRead + Send + 'static) -> impl Stream<Item = Result<Bytes, BodyError>> + Send {
    let chunks = ReaderStream::with_capacity(decoder, CHUNK_BYTES);
    chunks.map(|chunk| {
        chunk.map_err(|error| {
            let is_of_body = error.get_ref().is_some_and(|inner| inner.is::<axum::Error>());
            if is_of_body { BodyError::Broken } else { BodyError::Undecodable }
        })
    })
}
