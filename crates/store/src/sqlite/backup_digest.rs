//! The digest over a whole backup, which is its last line.
//!
//! SQLite's integrity check finds pages that do not fit together, not a flipped bit in a value. So a backup ends with
//! a line of text: the SHA-256 of all bytes before it. SQLite reads the pages that its header counts and nothing
//! after them, so every tool opens the file as before, and the digest cannot be lost as a file beside it can.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Read, Seek as _, SeekFrom, Write};
use std::path::Path;

use sha2::{Digest as _, Sha256};

use super::space::PAGE_BYTES;
use crate::domain::{Error, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};

const MARK: &str = "\nsightfix backup, SHA-256 of all before this line: ";
const HEX_BYTES: usize = 64;
const LINE_BYTES: u64 = (MARK.len() + HEX_BYTES + 1) as u64;
const BUFFER_BYTES: usize = 256 << 10;

/// The part of a backup that is the database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct BackupContent {
    bytes: u64,
    sha256: String,
    /// True if the file states its digest, and thus what was read is what was written.
    pub(super) is_proven: bool,
}

/// Appends the line to a complete database file.
pub(super) fn append(file: &mut File) -> io::Result<()> {
    file.seek(SeekFrom::Start(0))?;
    let sha256 = copy_hashed(&mut *file, io::sink())?;
    file.seek(SeekFrom::End(0))?;
    file.write_all(format!("{MARK}{sha256}\n").as_bytes())
}

/// Reads a whole backup and compares it with its digest, if it has one.
///
/// # Errors
/// A [`FolderFault`]: the file does not match its digest, or its last line is damaged.
pub(super) fn read(path: &Path) -> Result<BackupContent> {
    let damaged = |finding: &str| {
        let message = format!("{} is damaged: {finding}; take another backup", path.display());
        FolderFault::error(FolderFaultKind::Damaged, message)
    };
    let mut file = File::open(path).map_err(|error| unreadable(path, &error))?;
    let (stated, bytes) = stated_sha256(&mut file).map_err(|error| unreadable(path, &error))?;
    file.seek(SeekFrom::Start(0)).map_err(|error| unreadable(path, &error))?;
    let sha256 = copy_hashed(file.take(bytes), io::sink()).map_err(|error| unreadable(path, &error))?;
    match stated {
        Some(stated) if stated != sha256 => Err(damaged("it does not match its digest")),
        None if !bytes.is_multiple_of(PAGE_BYTES) => Err(damaged("it ends with neither a page nor a digest")),
        stated => Ok(BackupContent { bytes, sha256, is_proven: stated.is_some() }),
    }
}

impl BackupContent {
    /// Copies the database without the line.
    ///
    /// # Errors
    /// The file cannot be read or written, or its content is no longer that which was read.
    pub(super) fn copy(&self, path: &Path, target: impl Write) -> io::Result<()> {
        let copied = copy_hashed(File::open(path)?.take(self.bytes), target)?;
        if copied == self.sha256 { Ok(()) } else { Err(io::Error::other("the backup was changed meanwhile")) }
    }
}

/// The digest in the last line, if that is one, and how many bytes are before it.
fn stated_sha256(file: &mut File) -> io::Result<(Option<String>, u64)> {
    let length = file.metadata()?.len();
    let Some(bytes) = length.checked_sub(LINE_BYTES) else { return Ok((None, length)) };
    file.seek(SeekFrom::Start(bytes))?;
    let mut line = Vec::new();
    file.take(LINE_BYTES).read_to_end(&mut line)?;
    let stated = std::str::from_utf8(&line).ok();
    let stated = stated.and_then(|line| line.strip_prefix(MARK)?.strip_suffix('\n'));
    Ok(stated.map_or((None, length), |sha256| (Some(sha256.to_owned()), bytes)))
}

/// Copies all bytes; their SHA-256 in hexadecimal.
fn copy_hashed(mut source: impl Read, mut target: impl Write) -> io::Result<String> {
    let mut hash = Sha256::new();
    let mut buffer = vec![0; BUFFER_BYTES];
    loop {
        let read = match source.read(&mut buffer) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            read => read?,
        };
        let Some(bytes) = buffer.get(..read).filter(|bytes| !bytes.is_empty()) else { break };
        hash.update(bytes);
        target.write_all(bytes)?;
    }
    Ok(hash.finalize().iter().fold(String::with_capacity(HEX_BYTES), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    }))
}

fn unreadable(path: &Path, error: &io::Error) -> Error {
    let message = format!("{} cannot be read: {error}", path.display());
    FolderFault::error(FolderFaultKind::Missing, message)
}
