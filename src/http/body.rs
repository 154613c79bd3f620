//! Request bodies: read up to a limit, or spooled to a file so that a long one costs no memory.

use std::collections::VecDeque;
use std::error::Error as StdError;
use std::fs::File;
use std::io::{self, Read, Seek as _};
use std::time::Duration;

use axum::body::Body;
use bytes::{Buf as _, Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::HeaderMap;
use hyper::header::{CONTENT_LENGTH, EXPECT};
use tokio::io::AsyncWriteExt as _;
use tower_http::timeout::TimeoutError;

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

/// A body to be read by blocking code, in memory or in a temporary file without a name.
pub(super) enum Spooled {
    Memory(VecDeque<Bytes>),
    File(File),
}

impl Read for Spooled {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::File(file) => file.read(buffer),
            Self::Memory(parts) => {
                let Some(part) = parts.front_mut() else { return Ok(0) };
                let count = part.len().min(buffer.len());
                part.copy_to_slice(&mut buffer[..count]);
                if part.is_empty() {
                    parts.pop_front();
                }
                Ok(count)
            }
        }
    }
}

/// The body, in memory up to a size and in a temporary file beyond.
///
/// # Errors
/// As [`whole`]; a fault if the temporary file cannot be written.
pub(super) async fn spooled(
    headers: &HeaderMap,
    mut body: Body,
    limit: usize,
    memory_bytes: usize,
) -> Result<Spooled> {
    check_announced(headers, &mut body, limit).await?;
    let mut spool = Spool::new(memory_bytes);
    while let Some(part) = next(&mut body).await? {
        if spool.length + part.len() > limit {
            discard(headers, &mut body).await;
            return Err(too_large(limit));
        }
        spool.push(part).await?;
    }
    spool.finish().await
}

/// Gathers what comes piece by piece, in memory up to a size and in a temporary file beyond.
pub(super) struct Spool {
    memory_bytes: usize,
    length: usize,
    parts: VecDeque<Bytes>,
    file: Option<tokio::fs::File>,
}

impl Spool {
    pub(super) const fn new(memory_bytes: usize) -> Self {
        Self { memory_bytes, length: 0, parts: VecDeque::new(), file: None }
    }

    /// # Errors
    /// `InsufficientStorage`, or a fault, if the temporary file cannot be written.
    pub(super) async fn push(&mut self, part: Bytes) -> Result<()> {
        self.length += part.len();
        if !part.is_empty() {
            self.parts.push_back(part);
        }
        if self.length > self.memory_bytes {
            let file = match &mut self.file {
                Some(file) => file,
                None => self.file.insert(temporary_file().await?),
            };
            for part in self.parts.drain(..) {
                file.write_all(&part).await.map_err(unspoolable)?;
            }
        }
        Ok(())
    }

    /// # Errors
    /// A fault if the temporary file cannot be written.
    pub(super) async fn finish(self) -> Result<Spooled> {
        let Some(mut file) = self.file else { return Ok(Spooled::Memory(self.parts)) };
        file.flush().await.map_err(unspoolable)?;
        let mut file = file.into_std().await;
        file.rewind().map_err(Error::fault)?;
        Ok(Spooled::File(file))
    }
}

/// A temporary file that cannot be written.
fn unspoolable(error: io::Error) -> Error {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Error::refused(
            ErrorKind::InsufficientStorage,
            "the disk that holds the server's temporary files is full; send less at once, or give it more space",
        ),
        _ => Error::fault(error),
    }
}

async fn temporary_file() -> Result<tokio::fs::File> {
    let file = tokio::task::spawn_blocking(tempfile::tempfile).await.map_err(Error::fault)?;
    file.map(tokio::fs::File::from_std).map_err(Error::fault)
}

async fn next(body: &mut Body) -> Result<Option<Bytes>> {
    loop {
        match body.frame().await {
            None => return Ok(None),
            Some(Err(error)) => return Err(broken(&error)),
            Some(Ok(frame)) => {
                if let Ok(part) = frame.into_data() {
                    return Ok(Some(part));
                }
            }
        }
    }
}

fn broken(error: &axum::Error) -> Error {
    let mut cause: Option<&(dyn StdError + 'static)> = Some(error);
    while let Some(at) = cause {
        if at.is::<TimeoutError>() {
            return Error::refused(ErrorKind::Timeout, "the body stopped coming");
        }
        cause = at.source();
    }
    Error::refused(ErrorKind::Cancelled, "the body broke off")
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
async fn discard(headers: &HeaderMap, body: &mut Body) {
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
