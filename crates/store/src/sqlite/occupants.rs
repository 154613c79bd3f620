//! Which processes use the data folder.
//!
//! Several may (a server and commands beside it), but an operator should know of it. Each process
//! holds an advisory lock on a file of its own that names it; the lock ends with the process, however
//! it ends, so a file that is not locked is stale and is removed.

use std::collections::HashSet;
use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tempfile::NamedTempFile;

const PREFIX: &str = "sightfix.";
const SUFFIX: &str = ".lock";

/// A process that uses the data folder.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Occupant {
    /// Its process id, on its host (and in its container).
    pub pid: u32,
    /// Name of its host.
    pub host: String,
    /// Its purpose.
    pub role: String,
}

impl Occupant {
    pub(super) fn this_process(role: &str) -> Self {
        Self { pid: std::process::id(), host: host(), role: role.to_owned() }
    }
}

impl fmt::Display for Occupant {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} with process id {} on host {}", self.role, self.pid, self.host)
    }
}

/// This process among those of a folder; its lock file vanishes with it.
pub(super) struct Presence {
    folder: PathBuf,
    lock: NamedTempFile,
    /// Lock files of others that were reported before.
    reported: HashSet<PathBuf>,
}

impl Presence {
    /// Announces this process to the others of a folder.
    pub(super) fn announce(folder: &Path, role: &str) -> io::Result<Self> {
        let name = serde_json::to_vec(&Occupant::this_process(role))?;
        loop {
            let mut lock = tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).tempfile_in(folder)?;
            lock.as_file().lock()?;
            lock.write_all(&name)?;
            // Before it was locked, another process may have taken it for stale.
            if lock.path().exists() {
                return Ok(Self { folder: folder.to_owned(), lock, reported: HashSet::new() });
            }
        }
    }

    /// The other processes that have come since the last call; all of them at the first.
    pub(super) fn newcomers(&mut self) -> io::Result<Vec<Occupant>> {
        let others = self.others()?;
        let new = others.iter().filter(|(path, _)| !self.reported.contains(path));
        let new = new.map(|(_, occupant)| occupant.clone()).collect();
        self.reported = others.into_iter().map(|(path, _)| path).collect();
        Ok(new)
    }

    /// The other living processes by their lock files; removes stale files.
    fn others(&self) -> io::Result<Vec<(PathBuf, Occupant)>> {
        let mut others = Vec::new();
        for entry in fs::read_dir(&self.folder)? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if !name.starts_with(PREFIX)
                || !name.ends_with(SUFFIX)
                || path.file_name() == self.lock.path().file_name()
            {
                continue;
            }
            // Gone since the folder was listed: its process has ended.
            let Ok(file) = File::open(&path) else { continue };
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => {
                    // It may not have written its name yet; it will be reported at the next look.
                    let name = fs::read(&path).ok().and_then(|text| serde_json::from_slice(&text).ok());
                    others.extend(name.map(|occupant| (path, occupant)));
                }
                Ok(()) => fs::remove_file(&path)?,
                Err(TryLockError::Error(error)) => return Err(error),
            }
        }
        Ok(others)
    }
}

/// Empty where the system does not tell.
fn host() -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname");
    name.or_else(|_| std::env::var("COMPUTERNAME")).unwrap_or_default().trim().to_owned()
}
