//! Bodies of several named files: `multipart/form-data`.
//!
//! The whole body is spooled first, under the same limits and timeouts as any import; then each part
//! is spooled by itself. multer, the library beneath, has constraints on sizes of the whole body and of fields,
//! but none on the head of a part, which it gathers in memory; so chunks are handed to it one by one, and those
//! without a part are counted here. A part in memory never exceeds the spool's limit.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use axum::body::Body;
use axum::extract::multipart::Field;
use axum::extract::{DefaultBodyLimit, FromRequest as _, Multipart, Request};
use bytes::Bytes;
use futures_util::{Stream, stream};
use hyper::HeaderMap;
use hyper::header::CONTENT_TYPE;
use hyper::http::request::Parts;
use tokio::io::AsyncReadExt as _;

use super::body;
use super::extract::{media_type, not_read};
use crate::app::{App, Content, Spool, SpoolLeases, Spooled};
use crate::domain::{Error, ErrorKind, Result};
use crate::request::RequestContext;

/// Read at once while the body is split into its parts.
const CHUNK_BYTES: usize = 32 * 1024;
/// The largest head between two parts: a boundary and a few headers.
const LONGEST_HEAD_BYTES: usize = 8 * CHUNK_BYTES;

/// A part of a body.
pub(in crate::http) struct BodyPart {
    pub(in crate::http) content: Spooled,
    /// Its announced type, if any.
    pub(in crate::http) media_type: Option<String>,
    /// Its file's name, if any.
    pub(in crate::http) file_name: Option<String>,
}

impl BodyPart {
    /// The format that the type announces or, where it says nothing of use, the file's name.
    ///
    /// # Errors
    /// `UnsupportedMediaType`, naming the part.
    pub(in crate::http) fn format<T>(
        &self,
        name: &str,
        by_type: impl FnOnce(&str) -> Option<T>,
        by_path: impl FnOnce(&std::path::Path) -> Option<T>,
        readable: &str,
    ) -> Result<T> {
        let by_type = self.media_type.as_deref().and_then(by_type);
        let by_name = || self.file_name.as_deref().and_then(|file| by_path(std::path::Path::new(file)));
        by_type.or_else(by_name).ok_or_else(|| {
            let message =
                format!("the part must have the content type or the file name's ending of {readable}");
            Error::field(ErrorKind::UnsupportedMediaType, name, message)
        })
    }
}

/// The parts of the given names, each of which must be there once.
///
/// # Errors
/// `UnsupportedMediaType` for another body, `MalformedBody` for one that breaks its own rules,
/// `InvalidArgument` naming a part that is missing, doubled or unknown; `TooLarge` and the rest as
/// [`body::spooled`].
pub(in crate::http) async fn parts<const N: usize>(
    app: &App,
    head: &Parts,
    content: Body,
    names: [&str; N],
) -> Result<[BodyPart; N]> {
    if !media_type(&head.headers).is_some_and(|essence| essence.eq_ignore_ascii_case("multipart/form-data")) {
        return Err(not_read(&["multipart/form-data"]));
    }
    let whole = body::spooled(app, head, content).await?;
    let client = RequestContext::of(&head.extensions)?.client();
    let since = Arc::new(AtomicUsize::new(0));
    let mut multipart = multipart(&head.headers, chunks(whole, since.clone())).await?;
    let mut found: [Option<BodyPart>; N] = std::array::from_fn(|_| None);
    loop {
        since.store(0, Ordering::Relaxed);
        let Some(field) = multipart.next_field().await.map_err(|error| malformed(&error.body_text()))? else {
            break;
        };
        let name = field.name().unwrap_or_default().to_owned();
        let Some(place) =
            names.iter().zip(&mut found).find_map(|(known, place)| (*known == name).then_some(place))
        else {
            let shown: String = name.chars().take(60).collect();
            let known = names.join(" and ");
            return Err(Error::invalid(shown, format!("is not a part of this body; they are {known}")));
        };
        if place.is_some() {
            return Err(Error::invalid(name, "the part appears twice"));
        }
        *place = Some(spooled(field, Spool::new(app, client)?, &since).await?);
    }
    let mut missing = None;
    let found = found.into_iter().zip(names).map(|(part, name)| part.ok_or(name));
    let found: Vec<BodyPart> =
        found.filter_map(|part| part.map_err(|name| missing = Some(name)).ok()).collect();
    found.try_into().map_err(|_| Error::invalid(missing.unwrap_or_default(), "the part is required"))
}

async fn multipart(
    headers: &HeaderMap,
    chunks: impl Stream<Item = io::Result<Bytes>> + Send + 'static,
) -> Result<Multipart> {
    let mut request = Request::new(Body::from_stream(chunks));
    if let Some(value) = headers.get(CONTENT_TYPE) {
        request.headers_mut().insert(CONTENT_TYPE, value.clone());
    }
    // The body has been held to its limit already.
    DefaultBodyLimit::disable().apply(&mut request);
    Multipart::from_request(request, &()).await.map_err(|error| malformed(&error.body_text()))
}

async fn spooled(mut field: Field<'_>, mut spool: Spool, since: &AtomicUsize) -> Result<BodyPart> {
    let media_type = field.content_type().map(str::to_owned);
    let file_name = field.file_name().map(str::to_owned);
    while let Some(chunk) = field.chunk().await.map_err(|error| malformed(&error.body_text()))? {
        since.store(0, Ordering::Relaxed);
        spool.push(chunk).await?;
    }
    Ok(BodyPart { content: spool.finish().await?, media_type, file_name })
}

fn malformed(reason: &str) -> Error {
    Error::refused(ErrorKind::MalformedBody, format!("not multipart/form-data: {reason}"))
}

/// A spooled body in chunks, one for each time it is asked: the library would else gather all that is
/// ready. `since` counts what was read since a part or a piece of one was found.
fn chunks(whole: Spooled, since: Arc<AtomicUsize>) -> impl Stream<Item = io::Result<Bytes>> + Send + 'static {
    let Spooled { content, leases } = whole;
    let source = match content {
        Content::Memory(parts) => SpoolSource::Memory(parts),
        Content::File(file) => SpoolSource::File(tokio::fs::File::from_std(file)),
    };
    stream::try_unfold((source, leases), move |(mut source, leases): (SpoolSource, SpoolLeases)| {
        let since = since.clone();
        async move {
            tokio::task::yield_now().await;
            let chunk = source.chunk().await?;
            if since.fetch_add(chunk.len(), Ordering::Relaxed) > LONGEST_HEAD_BYTES {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "the head of a part is too long"));
            }
            Ok((!chunk.is_empty()).then_some((chunk, (source, leases))))
        }
    })
}

enum SpoolSource {
    Memory(VecDeque<Bytes>),
    File(tokio::fs::File),
}

impl SpoolSource {
    /// The next chunk; empty at the end.
    async fn chunk(&mut self) -> io::Result<Bytes> {
        match self {
            Self::Memory(parts) => {
                let Some(part) = parts.front_mut() else { return Ok(Bytes::new()) };
                let chunk = part.split_to(part.len().min(CHUNK_BYTES));
                if part.is_empty() {
                    parts.pop_front();
                }
                Ok(chunk)
            }
            Self::File(file) => {
                let mut chunk = vec![0; CHUNK_BYTES];
                let read = file.read(&mut chunk).await?;
                chunk.truncate(read);
                Ok(chunk.into())
            }
        }
    }
}
