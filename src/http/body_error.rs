//! Why a body that is decoded as it is read ends early.

use std::error::Error as StdError;
use std::fmt;

/// Why a decoded body ends early.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum BodyError {
    /// The coded body broke off or was refused.
    Broken,
    /// It is not of its coding.
    Undecodable,
}

impl fmt::Display for BodyError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Broken => "the body broke off",
            Self::Undecodable => "the body cannot be decoded",
        })
    }
}

impl StdError for BodyError {}

/// Whether a body ended early because it is not of its coding.
pub(super) fn is_undecodable(error: &axum::Error) -> bool {
    let mut cause: Option<&(dyn StdError + 'static)> = Some(error);
    while let Some(error) = cause {
        if error.downcast_ref() == Some(&BodyError::Undecodable) {
            return true;
        }
        cause = error.source();
    }
    false
}
