//! Ends a match that nobody waits for any more.

use std::fmt;

use crate::domain::{Error, ErrorKind, Result};

/// Tells whether a match is to end. It is asked often, so the answer must be cheap.
#[derive(Clone, Copy)]
pub struct Cancellation<'a>(&'a dyn Fn() -> bool);

impl<'a> Cancellation<'a> {
    /// Never cancels: the match runs to its end.
    pub const NEVER: Cancellation<'static> = Cancellation(&|| false);

    /// By a function that returns `true` once the match is to end.
    pub const fn new(is_cancelled: &'a dyn Fn() -> bool) -> Self {
        Self(is_cancelled)
    }

    pub(super) fn is_cancelled(&self) -> bool {
        (self.0)()
    }

    /// # Errors
    /// `Cancelled` once the match is to end.
    pub(super) fn check(&self) -> Result<()> {
        if self.is_cancelled() {
            return Err(Error::refused(ErrorKind::Cancelled, "nobody waits for the match any more"));
        }
        Ok(())
    }
}

impl fmt::Debug for Cancellation<'_> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Cancellation")
    }
}
