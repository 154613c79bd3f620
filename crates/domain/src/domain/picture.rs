//! A still picture of what a camera sees.

use strum::{EnumString, IntoStaticStr};

use super::error::{Error, ErrorKind, Result};

/// Formats of pictures; each is named by its media type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr)]
#[strum(parse_err_ty = Error, parse_err_fn = unknown_format)]
pub enum PictureFormat {
    /// JPEG.
    #[strum(serialize = "image/jpeg")]
    Jpeg,
    /// PNG.
    #[strum(serialize = "image/png")]
    Png,
}

fn unknown_format(_: &str) -> Error {
    Error::refused(ErrorKind::UnsupportedMediaType, "a picture must be image/jpeg or image/png")
}

impl PictureFormat {
    /// The media type.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        self.into()
    }

    /// The format of a file, by its first bytes.
    ///
    /// # Errors
    /// `UnsupportedMediaType` for any other.
    pub fn of_file(content: &[u8]) -> Result<Self> {
        let known =
            [Self::Jpeg, Self::Png].into_iter().find(|format| content.starts_with(format.signature()));
        known.ok_or_else(|| unknown_format(""))
    }

    /// The bytes that a file of the format begins with.
    const fn signature(self) -> &'static [u8] {
        match self {
            Self::Jpeg => b"\xff\xd8\xff",
            Self::Png => b"\x89PNG\r\n\x1a\n",
        }
    }
}

/// A still picture of what a camera sees, as a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    format: PictureFormat,
    content: Vec<u8>,
}

impl Picture {
    /// A picture of a format.
    ///
    /// # Errors
    /// `MalformedBody` for content that does not begin like a file of the format.
    pub fn new(format: PictureFormat, content: Vec<u8>) -> Result<Self> {
        if content.starts_with(format.signature()) {
            return Ok(Self { format, content });
        }
        let message = format!("the body is no file of the type {}", format.media_type());
        Err(Error::refused(ErrorKind::MalformedBody, message))
    }

    /// Its format.
    #[must_use]
    pub const fn format(&self) -> PictureFormat {
        self.format
    }

    /// The file.
    #[must_use]
    pub fn content(&self) -> &[u8] {
        &self.content
    }

    /// The file.
    #[must_use]
    pub fn into_content(self) -> Vec<u8> {
        self.content
    }
}
