//! Standard output and standard error, whose readers may go away and whose devices may be full.

use std::fmt::Display;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;

/// Set once the reader of standard output has gone.
static READER_IS_GONE: AtomicBool = AtomicBool::new(false);
/// Set by `--quiet`.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Suppresses progress and notes from now on.
pub(super) fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

/// True if progress and notes are suppressed.
pub(super) fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// True if the reader of standard output has gone, as in `sightfix openapi | head -1`: it wants nothing further, and a
/// command that ends early for it has not failed.
#[must_use]
pub fn reader_is_gone() -> bool {
    READER_IS_GONE.load(Ordering::Relaxed)
}

/// Standard output that remembers whether its reader has gone.
pub(super) struct StandardOutput;

impl StandardOutput {
    fn noted<T>(outcome: io::Result<T>) -> io::Result<T> {
        if outcome.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::BrokenPipe) {
            READER_IS_GONE.store(true, Ordering::Relaxed);
        }
        outcome
    }
}

impl Write for StandardOutput {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Self::noted(io::stdout().lock().write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Self::noted(io::stdout().lock().flush())
    }
}

/// Prints a text and a line break on standard output; unlike `println!` it does not panic. A reader that has
/// gone, as in `sightfix openapi | head -1`, wants nothing further: the rest is dropped.
///
/// # Errors
/// The output cannot be written for another reason, such as a full device.
pub(super) fn print_line(text: &impl Display) -> anyhow::Result<()> {
    match writeln!(StandardOutput, "{text}").and_then(|()| StandardOutput.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output cannot be written"),
    }
}

/// Prints a line on standard error unless the command is quiet; unlike `eprintln!` it does not panic. Where standard
/// error is closed or its device is full, there is nowhere left to report that.
pub(super) fn print_note(text: impl Display) {
    if !is_quiet() {
        let _ = writeln!(io::stderr().lock(), "{text}");
    }
}
