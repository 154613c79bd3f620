//! Elements of a JSON array, one by one and in bounded memory.
//!
//! Only the array's own brackets and commas are read here; what an element says is left to serde.
//! So an element that is no row, or no JSON, costs itself alone, as long as its brackets and quotes
//! pair up. (serde's own way through a long array, a `DeserializeSeed`, pushes instead of letting
//! pull, keeps no limit on an element, and ends at the first fault.)

use std::io::{BufRead, BufReader, ErrorKind as ErrorKindOfIo, Read};

use super::LONGEST_ROW_BYTES;
use super::lines::Line;
use crate::domain::{Error, ErrorKind, Result};

/// Reads `[element, ...]` or `{"NAME": [element, ...]}`.
pub(super) struct Elements<R> {
    reader: BufReader<R>,
    element: Vec<u8>,
    count: u64,
    wrapped: bool,
    ended: bool,
}

impl<R: Read> Elements<R> {
    /// # Errors
    /// `MalformedBody` for a document that does not begin so.
    pub(super) fn new(reader: R, name: &str) -> Result<Self> {
        let mut elements = Self {
            reader: BufReader::with_capacity(64 * 1024, reader),
            element: Vec::with_capacity(512),
            count: 0,
            wrapped: false,
            ended: false,
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
            self.wrapped = true;
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
        if self.ended {
            return None;
        }
        match self.gather() {
            Ok(true) => {}
            Ok(false) => {
                self.ended = true;
                return None;
            }
            Err(error) => {
                self.ended = true;
                return Some(Err(error));
            }
        }
        let line = if self.element.len() > LONGEST_ROW_BYTES {
            Line::TooLong
        } else {
            std::str::from_utf8(&self.element).map_or(Line::NotUtf8, Line::Text)
        };
        Some(Ok((self.count, line)))
    }

    /// Gathers the next element; `false` at the array's end.
    fn gather(&mut self) -> Result<bool> {
        let Some(first) = self.next_token()? else { return Err(self.broken_off()) };
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
                self.gather_rest(&mut nesting)?
            }
        };
        self.count += 1;
        let is_blank = self.element.iter().all(u8::is_ascii_whitespace);
        match byte {
            b'}' => Err(malformed(&format!("not JSON: brackets do not pair up in element {}", self.count))),
            b']' if is_blank => Err(malformed("not JSON: a comma before the array's end")),
            b']' => {
                self.end()?;
                self.ended = true;
                Ok(true)
            }
            _ => Ok(true),
        }
    }

    /// Gathers an element up to the comma or bracket that ends it, which is taken and given back.
    fn gather_rest(&mut self, nesting: &mut Nesting) -> Result<u8> {
        loop {
            let bytes = fill(&mut self.reader)?;
            if bytes.is_empty() {
                return Err(self.broken_off());
            }
            let end = bytes.iter().position(|&byte| {
                let ends = nesting.is_outside() && matches!(byte, b',' | b']' | b'}');
                if !ends {
                    nesting.enter(byte);
                }
                ends
            });
            let part = &bytes[..end.unwrap_or(bytes.len())];
            // One byte too many is kept, to tell that the element is too long.
            let room = (LONGEST_ROW_BYTES + 1).saturating_sub(self.element.len());
            self.element.extend_from_slice(&part[..part.len().min(room)]);
            let (taken, ending) = (part.len(), end.map(|at| bytes[at]));
            self.reader.consume(taken + usize::from(ending.is_some()));
            if let Some(ending) = ending {
                return Ok(ending);
            }
        }
    }

    /// What may follow the array.
    fn end(&mut self) -> Result<()> {
        if self.wrapped && self.next_token()? != Some(b'}') {
            return Err(malformed("nothing but the rows may stand in the document"));
        }
        match self.next_token()? {
            None => Ok(()),
            Some(_) => Err(malformed("not JSON: text after the document's end")),
        }
    }

    fn broken_off(&self) -> Error {
        malformed(&format!("not JSON: breaks off in element {}", self.count + 1))
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

/// Bytes at hand; none at the end of the file.
fn fill<R: Read>(reader: &mut BufReader<R>) -> Result<&[u8]> {
    loop {
        match reader.fill_buf() {
            Ok(_) => break,
            Err(error) if error.kind() == ErrorKindOfIo::Interrupted => {}
            Err(error) => return Err(Error::fault(error)),
        }
    }
    Ok(reader.buffer())
}

/// How deep in brackets and quotes a byte stands.
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
