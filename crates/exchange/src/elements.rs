//! Elements of a JSON array as a pull iterator in bounded memory.
//!
//! Only the brackets and commas of the array are parsed here; the elements are parsed by serde. So an
//! invalid element does not affect the others, as long as its brackets and quotes are balanced.
//! (serde's streaming, a `DeserializeSeed`, is push-based, does not limit the size of an element, and
//! stops at the first error.)

use std::io::{BufRead, BufReader, ErrorKind as IoErrorKind, Read};

use super::MAX_ROW_BYTES;
use super::lines::Line;
use crate::domain::{Error, ErrorKind, Result};

/// Reads `[element, ...]` or `{"NAME": [element, ...]}`.
pub(super) struct Elements<R> {
    reader: BufReader<R>,
    element: Vec<u8>,
    count: u64,
    is_wrapped: bool,
    has_ended: bool,
}

impl<R: Read> Elements<R> {
    /// # Errors
    /// `MalformedBody` for a document that does not begin like this.
    pub(super) fn new(reader: R, name: &str) -> Result<Self> {
        let mut elements = Self {
            reader: BufReader::with_capacity(64 * 1024, reader),
            element: Vec::with_capacity(512),
            count: 0,
            is_wrapped: false,
            has_ended: false,
        };
        elements.begin(name)?;
        Ok(elements)
    }

    fn begin(&mut self, name: &str) -> Result<()> {
        let expected = || malformed(&format!("must be an array of rows, or {{\"{name}\": [...]}}"));
        let mut first = self.next_token()?;
        if first == Some(0xEF) {
            let mark = [self.byte()?, self.byte()?];
            if mark != [Some(0xBB), Some(0xBF)] {
                return Err(malformed("not JSON"));
            }
            first = self.next_token()?;
        }
        if first == Some(b'{') {
            self.is_wrapped = true;
            if self.next_token()? != Some(b'"') {
                return Err(expected());
            }
            for expected_byte in name.bytes().chain([b'"']) {
                if self.byte()? != Some(expected_byte) {
                    return Err(expected());
                }
            }
            if self.next_token()? != Some(b':') {
                return Err(expected());
            }
            first = self.next_token()?;
        }
        if first == Some(b'[') { Ok(()) } else { Err(expected()) }
    }

    /// The next element and its number from 1; an error ends the file.
    pub(super) fn next_element(&mut self) -> Option<Result<(u64, Line<'_>)>> {
        if self.has_ended {
            return None;
        }
        match self.read_element() {
            Ok(true) => {}
            Ok(false) => {
                self.has_ended = true;
                return None;
            }
            Err(error) => {
                self.has_ended = true;
                return Some(Err(error));
            }
        }
        let line = if self.element.len() > MAX_ROW_BYTES {
            Line::TooLong
        } else {
            std::str::from_utf8(&self.element).map_or(Line::NotUtf8, Line::Text)
        };
        Some(Ok((self.count, line)))
    }

    /// Reads the next element into the buffer; `false` at the end of the array.
    fn read_element(&mut self) -> Result<bool> {
        let Some(first) = self.next_token()? else { return Err(self.truncated()) };
        if first == b']' && self.count == 0 {
            return self.end().map(|()| false);
        }
        self.element.clear();
        let mut nesting = Nesting::default();
        let byte = match first {
            b',' | b']' | b'}' => first,
            _ => {
                nesting.enter(first);
                self.element.push(first);
                self.read_rest(&mut nesting)?
            }
        };
        self.count += 1;
        let is_blank = self.element.iter().all(u8::is_ascii_whitespace);
        match byte {
            b'}' => Err(malformed(&format!("not JSON: unbalanced brackets in element {}", self.count))),
            b']' if is_blank => Err(malformed("not JSON: a comma before the end of the array")),
            b']' => {
                self.end()?;
                self.has_ended = true;
                Ok(true)
            }
            _ => Ok(true),
        }
    }

    /// Reads the rest of an element, and the comma or bracket that ends it, which is returned.
    fn read_rest(&mut self, nesting: &mut Nesting) -> Result<u8> {
        loop {
            let bytes = fill(&mut self.reader)?;
            if bytes.is_empty() {
                return Err(self.truncated());
            }
            let end = bytes.iter().position(|&byte| {
                let ends = nesting.is_outside() && matches!(byte, b',' | b']' | b'}');
                if !ends {
                    nesting.enter(byte);
                }
                ends
            });
            let part = &bytes[..end.unwrap_or(bytes.len())];
            // One byte beyond the limit is kept to recognise that the element is too long.
            let capacity = (MAX_ROW_BYTES + 1).saturating_sub(self.element.len());
            self.element.extend_from_slice(&part[..part.len().min(capacity)]);
            let (length, ending) = (part.len(), end.map(|at| bytes[at]));
            self.reader.consume(length + usize::from(ending.is_some()));
            if let Some(ending) = ending {
                return Ok(ending);
            }
        }
    }

    /// Checks what follows the array.
    fn end(&mut self) -> Result<()> {
        if self.is_wrapped && self.next_token()? != Some(b'}') {
            return Err(malformed("the document may contain only the rows"));
        }
        match self.next_token()? {
            None => Ok(()),
            Some(_) => Err(malformed("not JSON: text after the end of the document")),
        }
    }

    fn truncated(&self) -> Error {
        malformed(&format!("not JSON: ends within element {}", self.count + 1))
    }

    fn next_token(&mut self) -> Result<Option<u8>> {
        loop {
            match self.byte()? {
                Some(b' ' | b'\t' | b'\r' | b'\n') => {}
                other => return Ok(other),
            }
        }
    }

    fn byte(&mut self) -> Result<Option<u8>> {
        let next = fill(&mut self.reader)?.first().copied();
        self.reader.consume(usize::from(next.is_some()));
        Ok(next)
    }
}

/// Buffered bytes; empty at the end of the file.
fn fill<R: Read>(reader: &mut BufReader<R>) -> Result<&[u8]> {
    loop {
        match reader.fill_buf() {
            Ok(_) => break,
            Err(error) if error.kind() == IoErrorKind::Interrupted => {}
            Err(error) => return Err(Error::fault(error)),
        }
    }
    Ok(reader.buffer())
}

/// Nesting depth of brackets and quotes.
#[derive(Default)]
struct Nesting {
    depth: u32,
    in_text: bool,
    escaped: bool,
}

impl Nesting {
    const fn is_outside(&self) -> bool {
        self.depth == 0 && !self.in_text
    }

    const fn enter(&mut self, byte: u8) {
        if self.in_text {
            match byte {
                _ if self.escaped => self.escaped = false,
                b'\\' => self.escaped = true,
                b'"' => self.in_text = false,
                _ => {}
            }
            return;
        }
        match byte {
            b'"' => self.in_text = true,
            b'{' | b'[' => self.depth = self.depth.saturating_add(1),
            b'}' | b']' => self.depth = self.depth.saturating_sub(1),
            _ => {}
        }
    }
}

fn malformed(reason: &str) -> Error {
    Error::refused(ErrorKind::MalformedBody, reason)
}
