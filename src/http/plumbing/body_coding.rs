//! Content codings of bodies: gzip and zstd, both ways.
//!
//! A body is decoded as it is read, so its reader applies the limit: of one that decodes to more,
//! no more than the limit is ever held. How much is decoded at most follows from how much has come, and other
//! requests have their turn in between. A body is not decoded at once, nor before its sender may use the route.
//! Event streams and compressed content are not compressed.

use std::convert::Infallible;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use async_compression::tokio::bufread::{GzipDecoder, ZstdDecoder};
use async_compression::zstd::DParameter;
use axum::body::Body;
use axum::extract::Request;
use axum::response::{IntoResponse as _, Response};
use bytes::{Bytes, BytesMut};
use futures_util::stream::BoxStream;
use futures_util::{StreamExt as _, TryStreamExt as _, stream};
use hyper::header::{ACCEPT_ENCODING, CONTENT_ENCODING, CONTENT_LENGTH, ETAG};
use hyper::http::{Extensions, HeaderValue};
use hyper::{HeaderMap, StatusCode, Version};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _};
use tokio_util::io::StreamReader;
use tower::{Layer as _, ServiceExt as _, service_fn};
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{DefaultPredicate, Predicate, SizeAbove};

use super::body_error::BodyError;
use super::problem::ApiError;
use crate::domain::{Error, ErrorKind};

/// Smaller responses are not worth it.
const SMALLEST_RESPONSE: u64 = 1_024;
/// A decoder of zstd holds no more than this many bytes of what it has decoded, 8 MiB (RFC 9659).
const ZSTD_WINDOW_LOG: u32 = 23;
/// Decoded at once.
const CHUNK_BYTES: usize = 32 * 1024;
/// Decoded until other tasks have their turn.
const TURN_BYTES: u64 = 64 * 1024;
/// Bytes that a coded byte may decode to. NDJSON of a target that stands still, with the same box and fix in every row, comes
/// to 76 by gzip and to 217 by zstd at its best; zeros come to 1,030 and to more than 20,000.
const MOST_RATIO: u64 = 256;
/// Bytes that a body may decode to in addition, whatever its length.
const FREE_BYTES: u64 = 1024 * 1024;
/// Decoded bytes that each member of gzip, or frame of zstd, counts as: it needs a decoder of its own.
const MEMBER_BYTES: u64 = 64 * 1024;

/// The largest number of bytes that `coded_bytes` bytes decode to.
const fn most_decoded_bytes(coded_bytes: u64) -> u64 {
    coded_bytes.saturating_mul(MOST_RATIO).saturating_add(FREE_BYTES)
}

/// The codings of a response that a client accepts.
pub(in crate::http) struct AcceptedCoding(Vec<HeaderValue>);

impl AcceptedCoding {
    pub(in crate::http) fn of(request: &Request) -> Self {
        Self(request.headers().get_all(ACCEPT_ENCODING).iter().cloned().collect())
    }

    /// Compresses a response for a client that accepts it. A response with an entity tag stays as it is: its
    /// tag is that of these bytes (RFC 9110, 8.8.3.3).
    pub(in crate::http) async fn encode(self, response: Response) -> Response {
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
pub(in crate::http) fn decoded(request: Request) -> Result<Request, Box<Response>> {
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
            let mut refusal = ApiError::from(error).into_response();
            refusal.headers_mut().insert(ACCEPT_ENCODING, HeaderValue::from_static("gzip, zstd"));
            return Err(Box::new(refusal));
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
        let coded_bytes = Arc::new(AtomicU64::new(0));
        let counted = coded_bytes.clone();
        let coded = body.into_data_stream().inspect_ok(move |part| {
            counted.fetch_add(part.len() as u64, Ordering::Relaxed);
        });
        let member = Member::new(self, StreamReader::new(coded.map_err(io::Error::other).boxed()));
        let decoding = Decoding { member, coded_bytes, spent_bytes: 0, turn_bytes: 0 };
        Body::from_stream(stream::try_unfold(decoding, Decoding::next_chunk))
    }
}

/// A coded body, whose parts are read one after another.
type Coded = StreamReader<BoxStream<'static, io::Result<Bytes>>, Bytes>;

/// A member of gzip (RFC 1952, 2.2) or a frame of zstd (RFC 8878, 3), of which a body may have several.
enum Member {
    Gzip(GzipDecoder<Coded>),
    Zstd(ZstdDecoder<Coded>),
}

impl Member {
    fn new(coding: Coding, coded: Coded) -> Self {
        match coding {
            Coding::Gzip => Self::Gzip(GzipDecoder::new(coded)),
            Coding::Zstd => {
                Self::Zstd(ZstdDecoder::with_params(coded, &[DParameter::window_log_max(ZSTD_WINDOW_LOG)]))
            }
        }
    }

    /// Decodes some bytes; none at its end.
    async fn read(&mut self, chunk: &mut BytesMut) -> io::Result<usize> {
        match self {
            Self::Gzip(decoder) => decoder.read_buf(chunk).await,
            Self::Zstd(decoder) => decoder.read_buf(chunk).await,
        }
    }

    /// The next member; `None` at the end of the body.
    async fn next(self) -> io::Result<Option<Self>> {
        let (coding, mut coded) = match self {
            Self::Gzip(decoder) => (Coding::Gzip, decoder.into_inner()),
            Self::Zstd(decoder) => (Coding::Zstd, decoder.into_inner()),
        };
        let is_end = coded.fill_buf().await?.is_empty();
        Ok((!is_end).then(|| Self::new(coding, coded)))
    }
}

/// A body that is decoded, and what that has cost.
struct Decoding {
    member: Member,
    coded_bytes: Arc<AtomicU64>,
    spent_bytes: u64,
    /// Spent since other tasks had their turn.
    turn_bytes: u64,
}

impl Decoding {
    /// The next part of what was coded.
    async fn next_chunk(mut self) -> Result<Option<(Bytes, Self)>, BodyError> {
        let mut chunk = BytesMut::with_capacity(CHUNK_BYTES);
        loop {
            let read = self.member.read(&mut chunk).await.map_err(|error| reason(&error))?;
            if read > 0 {
                self.spend(read as u64).await?;
                return Ok(Some((chunk.freeze(), self)));
            }
            let Some(member) = self.member.next().await.map_err(|error| reason(&error))? else {
                return Ok(None);
            };
            self.member = member;
            self.spend(MEMBER_BYTES).await?;
        }
    }

    async fn spend(&mut self, bytes: u64) -> Result<(), BodyError> {
        self.spent_bytes += bytes;
        if self.spent_bytes > most_decoded_bytes(self.coded_bytes.load(Ordering::Relaxed)) {
            return Err(BodyError::TooDense);
        }
        self.turn_bytes += bytes;
        if self.turn_bytes >= TURN_BYTES {
            self.turn_bytes = 0;
            tokio::task::yield_now().await;
        }
        Ok(())
    }
}

fn reason(error: &io::Error) -> BodyError {
    let is_of_body = error.get_ref().is_some_and(|inner| inner.is::<axum::Error>());
    if is_of_body { BodyError::Broken } else { BodyError::Undecodable }
}
