//! Bodies that clients send in pieces and blocking code reads whole: in memory up to a size, beyond in temporary files.
//!
//! Does not use memory or disk beyond the quotas of all imports.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek as _};

use bytes::{Buf as _, Bytes};
use sha2::{Digest as _, Sha256};
use tokio::io::AsyncWriteExt as _;

use super::App;
use crate::admission::{ClientId, Lease};
use crate::domain::{Error, ErrorKind, IdempotentRequest, RequestHasher, Result};

/// A body to be read by blocking code. What it holds of the quotas is given back when it is dropped.
pub struct Spooled {
    /// The content that was sent.
    pub content: Content,
    /// Its share of the quotas.
    pub leases: SpoolLeases,
}

impl Spooled {
    /// Adds the content to what a request asks for, and goes back to its start.
    ///
    /// # Errors
    /// A fault if the temporary file cannot be read.
    pub async fn hash_into(self, request: &IdempotentRequest) -> Result<Self> {
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
pub enum Content {
    /// Piece by piece.
    Memory(VecDeque<Bytes>),
    /// At its start.
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

/// The leases of a spooled body in the quotas of all imports.
pub struct SpoolLeases {
    memory: Lease,
    disk: Lease,
}

impl SpoolLeases {
    fn new(app: &App, client: ClientId) -> Result<Self> {
        let memory = app.quotas.import_memory.try_acquire(client, 0)?;
        Ok(Self { memory, disk: app.quotas.import_disk.try_acquire(client, 0)? })
    }
}

/// Gathers what comes piece by piece, in memory up to a size and in a temporary file beyond, or where
/// the memory of all imports is used up.
pub struct Spool {
    memory_bytes: usize,
    length: usize,
    parts: VecDeque<Bytes>,
    file: Option<tokio::fs::File>,
    leases: SpoolLeases,
}

impl Spool {
    /// An empty one.
    ///
    /// # Errors
    /// `Overloaded` if the client has reached its limit of imports under way.
    pub fn new(app: &App, client: ClientId) -> Result<Self> {
        Ok(Self {
            memory_bytes: app.limits.import_memory_bytes,
            length: 0,
            parts: VecDeque::new(),
            file: None,
            leases: SpoolLeases::new(app, client)?,
        })
    }

    /// Bytes so far.
    #[must_use]
    pub const fn length(&self) -> usize {
        self.length
    }

    /// Adds a piece.
    ///
    /// # Errors
    /// `Overloaded` if all imports together hold as much as they may; `InsufficientStorage`, or a
    /// fault, if the temporary file cannot be written.
    pub async fn push(&mut self, part: Bytes) -> Result<()> {
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

    /// The whole, to be read from its start.
    ///
    /// # Errors
    /// A fault if the temporary file cannot be written.
    pub async fn finish(self) -> Result<Spooled> {
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
