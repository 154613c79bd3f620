//! Why a body that is decoded as it is read ends early.

use std::error::Error as StdError;
use std::fmt;

use crate::domain::{Error, ErrorKind};

/// Why a body ends early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::http) enum BodyError {
    /// It is incomplete, or was refused where requests are admitted, which is known and reported there.
    Broken,
    /// It is not of its coding.
    Undecodable,
    /// It decodes to more than its length allows.
    TooDense,
}

impl BodyError {
    /// Why a body ended early.
    pub(in crate::http) fn of(error: &axum::Error) -> Self {
        let mut cause: Option<&(dyn StdError + 'static)> = Some(error);
        while let Some(error) = cause {
            if let Some(reason) = error.downcast_ref::<Self>() {
                return *reason;
            }
            cause = error.source();
        }
        Self::Broken
    }

    /// The refusal that the sender receives.
    pub(in crate::http) fn refusal(self) -> Error {
        let kind = match self {
            Self::Broken => ErrorKind::Cancelled,
            Self::Undecodable => ErrorKind::MalformedBody,
            Self::TooDense => ErrorKind::TooLarge,
        };
        Error::refused(kind, self.to_string())
    }
}

impl fmt::Display for BodyError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Broken => "the body is incomplete",
            Self::Undecodable => "the body is not of its content-encoding, or is cut off",
            Self::TooDense => {
                "the body decodes to more than its length allows (docs/reference/limits.md); send it without \
                 a content-encoding"
            }
        })
    }
}

impl StdError for BodyError {}
