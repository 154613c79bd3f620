//! A file that occupies disk space until a full disk makes deletions need it.
//!
//! SQLite deletes by writing: the changed pages go to its log first. On a full disk nothing could be
//! deleted any more, so some space is set aside while there is plenty.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use crate::domain::{Error, Result};

const NAME: &str = "sightfix.reserve";

/// The reserved space of a data folder.
#[derive(Clone)]
pub(super) struct Reserve {
    folder: PathBuf,
    bytes: u64,
}

impl Reserve {
    pub(super) fn new(folder: &Path, bytes: u64) -> Self {
        Self { folder: folder.to_owned(), bytes }
    }

    /// Sets the space aside, if it is not yet and the disk has it. Returns whether it is there (or
    /// none was asked for).
    pub(super) async fn ensure(&self) -> Result<bool> {
        self.blocking(Self::ensure_blocking).await
    }

    /// Gives the space to others.
    pub(super) async fn release(&self) -> Result<()> {
        self.blocking(|reserve| match fs::remove_file(reserve.path()) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        })
        .await
    }

    /// Whether less space is left on the disk than is to be reserved.
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

    fn ensure_blocking(&self) -> io::Result<bool> {
        let path = self.path();
        let length = fs::metadata(&path).map_or(0, |metadata| metadata.len());
        if length == self.bytes {
            return Ok(true);
        }
        if self.bytes == 0 {
            fs::remove_file(&path)?;
            return Ok(true);
        }
        let file = create(&path)?;
        let allocated = file.set_len(self.bytes.min(length)).and_then(|()| allocate(&file, self.bytes));
        match allocated {
            Ok(()) => Ok(true),
            Err(error) => {
                drop(file);
                fs::remove_file(&path)?;
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
