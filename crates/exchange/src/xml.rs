//! XML: files in bounded memory, and attributes of elements.

use std::io::{self, BufRead, BufReader, Read};

use quick_xml::escape::unescape;
use quick_xml::events::BytesStart;

use super::MAX_ROW_BYTES;

/// Counts lines and limits the bytes of one event.
pub(super) struct BoundedReader<R> {
    reader: BufReader<R>,
    line: u64,
    /// Bytes consumed since the latest event.
    event_bytes: usize,
}

impl<R: Read> BoundedReader<R> {
    pub(super) fn new(reader: R) -> Self {
        Self { reader: BufReader::new(reader), line: 1, event_bytes: 0 }
    }

    /// Number of the line that is read, from 1.
    pub(super) const fn line(&self) -> u64 {
        self.line
    }

    /// Begins to count the bytes of the next event.
    pub(super) const fn begin_event(&mut self) {
        self.event_bytes = 0;
    }
}

impl<R: Read> Read for BoundedReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let consumed = self.fill_buf()?.read(buffer)?;
        self.consume(consumed);
        Ok(consumed)
    }
}

impl<R: Read> BufRead for BoundedReader<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.event_bytes > MAX_ROW_BYTES {
            let reason = "a tag or text is longer than 64 KiB";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        self.reader.fill_buf()
    }

    fn consume(&mut self, consumed: usize) {
        let lines = self.reader.buffer().iter().take(consumed).filter(|&&byte| byte == b'\n').count();
        self.line += lines as u64;
        self.event_bytes += consumed;
        self.reader.consume(consumed);
    }
}

/// An element with attributes: of XML, or of JSON that stands for XML.
pub(crate) trait Element {
    /// An attribute, if the element has it.
    ///
    /// # Errors
    /// It cannot be read.
    fn attribute(&self, name: &str) -> Result<Option<String>, String>;
}

impl Element for BytesStart<'_> {
    fn attribute(&self, name: &str) -> Result<Option<String>, String> {
        let Some(found) = self.try_get_attribute(name).map_err(not_xml)? else { return Ok(None) };
        Ok(Some(unescape(&found.value).map_err(not_xml)?.into_owned()))
    }
}

/// Why a document cannot be read.
pub(crate) fn not_xml(error: impl std::fmt::Display) -> String {
    format!("is not XML: {error}")
}

/// Attributes that are finite numbers.
pub(crate) fn numbers<const N: usize>(element: &impl Element, names: [&str; N]) -> Result<[f64; N], String> {
    let mut values = [0.0; N];
    for (value, name) in values.iter_mut().zip(names) {
        let text = element.attribute(name)?.unwrap_or_default();
        let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
        *value = number.ok_or_else(|| format!("the attribute {name} is `{text}`, which is not a number"))?;
    }
    Ok(values)
}
