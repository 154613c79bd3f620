//! Request bodies: read up to a limit, or spooled to a file so that a long one costs no memory.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek as _};
use std::time::Duration;

use axum::body::Body;
use bytes::{Buf as _, Bytes, BytesMut};
use http_body_util::BodyExt as _;
use hyper::HeaderMap;
use hyper::header::{CONTENT_LENGTH, EXPECT};
use hyper::http::request::Parts;
use sha2::{Digest as _, Sha256};
use tokio::io::AsyncWriteExt as _;

use super::body_error::is_undecodable;
use crate::admission::{ClientId, Lease};
use crate::app::App;
use crate::domain::{Error, ErrorKind, IdempotentRequest, RequestHasher, Result};

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

/// A body to be read by blocking code. What it holds of the quotas is given back when it is dropped.
pub(super) struct Spooled {
    pub(super) content: Content,
    pub(super) leases: SpoolLeases,
}

impl Spooled {
    /// Adds the content to what a request asks for, and goes back to its begin.
    ///
    /// # Errors
    /// A fault if the temporary file cannot be read.
    pub(super) async fn hash_into(self, request: &IdempotentRequest) -> Result<Self> {
        let hasher = request.hasher.clone();
        let Self { content, leases } = self;
        let hashing = tokio::task::spawn_blocking(move || content.hash(&hasher));
        Ok(Self { content: hashing.await.map_err(Error::fault)?.map_err(Error::fault)?, leases })
    }
}

impl Content {
    fn hash(mut self, hasher: &RequestHasher) -> io::Result<Self> {
        // The pieces in which a body comes differ from time to time, so it is hashed by itself first.
        let mut hash = Sha256::new();
        match &mut self {
            Self::Memory(parts) => parts.iter().for_each(|part| hash.update(part)),
            Self::File(file) => {
                let mut buffer = vec![0; 64 * 1024];
                loop {
                    match file.read(&mut buffer)? {
                        0 => break,
                        read => hash.update(&buffer[..read]),
                    }
                }
                file.rewind()?;
            }
        }
        hasher.update(&hash.finalize());
        Ok(self)
    }
}

/// Where a spooled body is: in memory, or in a temporary file without a name.
pub(super) enum Content {
    Memory(VecDeque<Bytes>),
    File(File),
}

impl Read for Spooled {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match &mut self.content {
            Content::File(file) => file.read(buffer),
            Content::Memory(parts) => {
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

/// What a spooled body holds of the quotas of all imports.
pub(super) struct SpoolLeases {
    memory: Lease,
    disk: Lease,
}

impl SpoolLeases {
    fn new(app: &App, client: ClientId) -> Result<Self> {
        let memory = app.quotas.import_memory.try_acquire(client, 0)?;
        Ok(Self { memory, disk: app.quotas.import_disk.try_acquire(client, 0)? })
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
            if spool.length + part.len() > limit { Err(too_large(limit)) } else { spool.push(part).await };
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

/// Gathers what comes piece by piece, in memory up to a size and in a temporary file beyond, or where
/// the memory of all imports is used up.
pub(super) struct Spool {
    memory_bytes: usize,
    length: usize,
    parts: VecDeque<Bytes>,
    file: Option<tokio::fs::File>,
    leases: SpoolLeases,
}

impl Spool {
    pub(super) fn new(app: &App, client: ClientId) -> Result<Self> {
        Ok(Self {
            memory_bytes: app.limits.import_memory_bytes,
            length: 0,
            parts: VecDeque::new(),
            file: None,
            leases: SpoolLeases::new(app, client)?,
        })
    }

    /// # Errors
    /// `Overloaded` if all imports together hold as much as they may; `InsufficientStorage`, or a
    /// fault, if the temporary file cannot be written.
    pub(super) async fn push(&mut self, part: Bytes) -> Result<()> {
        if part.is_empty() {
            return Ok(());
        }
        let bytes = part.len();
        self.length += bytes;
        self.parts.push_back(part);
        let fits = self.file.is_none() && self.length <= self.memory_bytes;
        if fits && self.leases.memory.try_grow(bytes as u64).is_ok() {
            return Ok(());
        }
        let moved: usize = self.parts.iter().map(Bytes::len).sum();
        self.leases.disk.try_grow(moved as u64)?;
        let file = match &mut self.file {
            Some(file) => file,
            None => self.file.insert(temporary_file().await?),
        };
        for part in self.parts.drain(..) {
            file.write_all(&part).await.map_err(unspoolable)?;
        }
        self.leases.memory.clear();
        Ok(())
    }

    /// # Errors
    /// A fault if the temporary file cannot be written.
    pub(super) async fn finish(self) -> Result<Spooled> {
        let content = match self.file {
            None => Content::Memory(self.parts),
            Some(mut file) => {
                file.flush().await.map_err(unspoolable)?;
                let mut file = file.into_std().await;
                file.rewind().map_err(Error::fault)?;
                Content::File(file)
            }
        };
        Ok(Spooled { content, leases: self.leases })
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
