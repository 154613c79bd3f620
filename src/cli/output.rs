//! Standard output and standard error, whose readers may go away and whose devices may be full.

use std::fmt::Display;
use std::io::{self, Write as _};

use anyhow::Context as _;

/// Prints a text and a line break on standard output; unlike `println!` it does not panic. A reader that has
/// gone, as in `sightfix openapi | head -1`, wants no more: the rest is dropped.
///
/// # Errors
/// The output cannot be written for another reason, such as a full device.
pub(super) fn print_line(text: &impl Display) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output cannot be written"),
    }
}

/// Prints a line on standard error; unlike `eprintln!` it does not panic. Where standard error is closed or its
/// device is full, there is nowhere left to report that.
pub(super) fn print_note(text: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}
