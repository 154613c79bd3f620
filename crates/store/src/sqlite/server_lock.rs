//! At most one server, or one restore, per data folder.
//!
//! Commands beside a server change rows that the server sees within seconds. Two servers would each run the
//! jobs, track the targets and grant the quotas of the other. The lock is advisory and ends with its process,
//! however it ends, so a killed server leaves nothing that must be cleared.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use super::occupants::Occupant;
use crate::domain::{Error, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};

const NAME: &str = "server.lock";

/// The lock, held until the value is dropped.
pub(super) struct ServerLock {
    file: File,
    path: PathBuf,
}

impl ServerLock {
    /// Takes the lock of a folder for this process. Nothing is written, so that it works on a full disk.
    ///
    /// # Errors
    /// A [`FolderFault`]: another process holds the lock, or the file cannot be opened for writing.
    pub(super) fn acquire(folder: &Path) -> Result<Self> {
        let path = folder.join(NAME);
        let file = open(&path).map_err(|error| unusable(&path, &error))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(in_use(folder, read_holder(&path).as_ref())),
            // Some network file systems have no locks. Refusing to serve from them would help nobody.
            Err(TryLockError::Error(error)) => {
                tracing::warn!(%error, "the file system has no locks: make sure that only one server uses it");
            }
        }
        Ok(Self { file, path })
    }

    /// Writes the name of this process into the lock's file, for others that find the folder in use.
    ///
    /// # Errors
    /// A [`FolderFault`]: the file cannot be written.
    pub(super) fn announce(&mut self, role: &str) -> Result<()> {
        let name = serde_json::to_vec(&Occupant::this_process(role)).map_err(Error::fault)?;
        let written = self.file.set_len(0).and_then(|()| self.file.write_all(&name));
        written.map_err(|error| unusable(&self.path, &error))
    }
}

fn unusable(path: &Path, error: &io::Error) -> Error {
    let kind = match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => FolderFaultKind::NoSpace,
        _ => FolderFaultKind::NotWritable,
    };
    let path = path.display();
    FolderFault::error(
        kind,
        format!("{path} cannot be opened for writing ({error}); check owner, permissions and disk"),
    )
}

/// The process that holds the lock of a folder, if one does and has written its name.
///
/// # Errors
/// The file cannot be read.
pub fn holder(folder: &Path) -> io::Result<Option<Occupant>> {
    let path = folder.join(NAME);
    let file = match File::open(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        opened => opened?,
    };
    match file.try_lock_shared() {
        Err(TryLockError::WouldBlock) => Ok(read_holder(&path)),
        Ok(()) => Ok(None),
        Err(TryLockError::Error(error)) => Err(error),
    }
}

pub(super) fn in_use(folder: &Path, holder: Option<&Occupant>) -> Error {
    let holder = holder.map_or_else(|| "another process".to_owned(), ToString::to_string);
    FolderFault::error(
        FolderFaultKind::InUse,
        format!(
            "the data folder {} is in use by {holder}; stop that first, or choose another folder",
            folder.display()
        ),
    )
}

fn read_holder(path: &Path) -> Option<Occupant> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(false);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)
}
