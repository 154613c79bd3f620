//! A file that occupies disk space until a full disk makes deletions, or the start of a server, need it.
//!
//! SQLite deletes by writing: the changed pages go to its log first. It opens a database by writing, too: the index
//! of the log. On a full disk nothing could be deleted and no server started, so some space is set aside while there
//! is plenty.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::domain::{Error, Result};

const NAME: &str = "sightfix.reserve";

/// Left free when released space is set aside again on a full disk, for small changes such as those of a start.
const SLACK_BYTES: u64 = 256 << 10;

/// The reserved space of a data folder.
#[derive(Clone)]
pub(super) struct Reserve {
    folder: PathBuf,
    bytes: u64,
    /// Bytes that were released and are not set aside again yet.
    owed_bytes: Arc<AtomicU64>,
}

impl Reserve {
    pub(super) fn new(folder: &Path, bytes: u64) -> Self {
        Self { folder: folder.to_owned(), bytes, owed_bytes: Arc::default() }
    }

    /// Sets the space aside, if it is not yet and the disk has it. Of space that was released, as much as the disk
    /// still has, so that nobody else fills it. Returns whether all of it is there (or none was asked for).
    pub(super) async fn ensure(&self) -> Result<bool> {
        self.blocking(Self::ensure_blocking).await
    }

    /// Gives the space to others; how many bytes that were.
    pub(super) async fn release(&self) -> Result<u64> {
        self.blocking(|reserve| {
            let bytes = reserve.length();
            match fs::remove_file(reserve.path()) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => reserve.owed_bytes.fetch_max(bytes, Ordering::Relaxed),
            };
            Ok(bytes)
        })
        .await
    }

    /// True if less space is left on the disk than is to be reserved.
    pub(super) async fn is_disk_scarce(&self) -> Result<bool> {
        let bytes = self.bytes;
        Ok(self.available_bytes().await?.is_some_and(|available| available < bytes))
    }

    /// Bytes that are left on the disk; `None` where the system does not tell.
    pub(super) async fn available_bytes(&self) -> Result<Option<u64>> {
        self.blocking(|reserve| available_bytes(&reserve.folder)).await
    }

    async fn blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Self) -> io::Result<T> + Send + 'static,
    ) -> Result<T> {
        let reserve = self.clone();
        let worked = tokio::task::spawn_blocking(move || work(&reserve)).await.map_err(Error::fault)?;
        worked.map_err(|error| Error::fault(format!("the reserve of the data folder: {error}")))
    }

    fn path(&self) -> PathBuf {
        self.folder.join(NAME)
    }

    fn length(&self) -> u64 {
        fs::metadata(self.path()).map_or(0, |metadata| metadata.len())
    }

    fn ensure_blocking(&self) -> io::Result<bool> {
        let length = self.length();
        let owed_bytes = self.owed_bytes.load(Ordering::Relaxed);
        let slack_bytes = if owed_bytes > 0 { SLACK_BYTES } else { 0 };
        let wanted = match available_bytes(&self.folder)?.map(|free| free + length) {
            _ if self.bytes <= length => self.bytes,
            Some(most) if most < self.bytes + slack_bytes => {
                owed_bytes.min(most.saturating_sub(slack_bytes)).max(length)
            }
            _ => self.bytes,
        };
        if wanted != length && !self.resize(length, wanted)? {
            return Ok(false);
        }
        if wanted == self.bytes {
            self.owed_bytes.store(0, Ordering::Relaxed);
        }
        Ok(wanted == self.bytes)
    }

    /// Makes the file so long; false if the disk is too full for it, which leaves it as it was.
    fn resize(&self, length: u64, wanted: u64) -> io::Result<bool> {
        let path = self.path();
        if wanted == 0 {
            fs::remove_file(&path)?;
            return Ok(true);
        }
        let file = create(&path)?;
        match file.set_len(wanted.min(length)).and_then(|()| allocate(&file, wanted)) {
            Ok(()) => Ok(true),
            Err(error) => {
                if length == 0 { fs::remove_file(&path) } else { file.set_len(length) }?;
                if is_full(&error) { Ok(false) } else { Err(error) }
            }
        }
    }
}

fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

fn create(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(false);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)
}

/// Real blocks, not a hole.
#[cfg(unix)]
fn allocate(file: &File, bytes: u64) -> io::Result<()> {
    rustix::fs::fallocate(file, rustix::fs::FallocateFlags::empty(), 0, bytes)?;
    Ok(())
}

#[cfg(not(unix))]
fn allocate(file: &File, bytes: u64) -> io::Result<()> {
    file.set_len(bytes)
}

/// Bytes that are left on the disk of a folder; `None` where the system does not tell.
///
/// # Errors
/// The folder does not exist.
#[cfg(unix)]
pub fn available_bytes(folder: &Path) -> io::Result<Option<u64>> {
    let system = rustix::fs::statvfs(folder)?;
    Ok(Some(system.f_bavail.saturating_mul(system.f_frsize)))
}

/// `None`: the system does not tell.
#[cfg(not(unix))]
pub fn available_bytes(_folder: &Path) -> io::Result<Option<u64>> {
    Ok(None)
}
