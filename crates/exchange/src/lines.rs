//! Lines of a file in bounded memory: a line beyond the limit is skipped and reported.

use std::io::{self, BufRead, BufReader, Read};

use super::MAX_ROW_BYTES;
use super::file_row::RowError;
use crate::domain::{Error, Result};

/// One line without its line ending.
pub(super) enum Line<'a> {
    /// The line is valid text.
    Text(&'a str),
    /// It is not UTF-8.
    NotUtf8,
    /// It is longer than [`MAX_ROW_BYTES`].
    TooLong,
}

/// Reads lines that end in LF or CRLF; a byte order mark before the first is removed.
pub(super) struct Lines<R> {
    reader: BufReader<R>,
    line: Vec<u8>,
    number: u64,
}

impl<R: Read> Lines<R> {
    /// The next row that `read` finds in a line, by the line's number and its text without spaces about it; a line that is no
    /// text, or that `read` refuses, is a row that failed. `None` at the end of the file.
    ///
    /// # Errors
    /// The file cannot be read, or a fault of `read`.
    pub(super) fn find_row<T>(
        &mut self,
        mut read: impl FnMut(u64, &str) -> Result<Option<Result<T, RowError>>>,
    ) -> Option<Result<Result<T, RowError>>> {
        loop {
            let (line, text) = match self.next_text().transpose()? {
                Err(error) => return Some(Err(error)),
                Ok((_, Err(row))) => return Some(Ok(Err(row))),
                Ok((line, Ok(text))) => (line, text),
            };
            if let Some(row) = read(line, text).transpose() {
                return Some(row.or_else(|error| RowError::of(line, error).map(Err)));
            }
        }
    }

    /// The next line and its number, without spaces about it, or why it is no text; `None` at the end of the file.
    ///
    /// # Errors
    /// The file cannot be read.
    fn next_text(&mut self) -> Result<Option<(u64, Result<&str, RowError>)>> {
        let Some((number, line)) = self.next_line().map_err(Error::fault)? else { return Ok(None) };
        let text = match line {
            Line::Text(text) => Ok(text.trim()),
            Line::NotUtf8 => Err(RowError::whole(number, "is not UTF-8")),
            Line::TooLong => Err(RowError::whole(number, "is longer than 64 KiB")),
        };
        Ok(Some((number, text)))
    }

    pub(super) fn new(reader: R) -> Self {
        Self { reader: BufReader::with_capacity(64 * 1024, reader), line: Vec::with_capacity(256), number: 0 }
    }

    /// Number of the latest line, from 1; 0 before the first.
    pub(super) const fn number(&self) -> u64 {
        self.number
    }

    /// The next line and its number from 1, or `None` at the end of the file.
    pub(super) fn next_line(&mut self) -> io::Result<Option<(u64, Line<'_>)>> {
        self.line.clear();
        let limit = MAX_ROW_BYTES as u64 + 2; // plus the line ending
        if (&mut self.reader).take(limit).read_until(b'\n', &mut self.line)? == 0 {
            return Ok(None);
        }
        self.number += 1;
        let is_complete = self.line.ends_with(b"\n");
        let mut text = self.line.strip_suffix(b"\n").unwrap_or(&self.line);
        text = text.strip_suffix(b"\r").unwrap_or(text);
        if self.number == 1 {
            text = text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(text);
        }
        if text.len() > MAX_ROW_BYTES {
            if !is_complete {
                self.reader.skip_until(b'\n')?;
            }
            return Ok(Some((self.number, Line::TooLong)));
        }
        let line = std::str::from_utf8(text).map_or(Line::NotUtf8, Line::Text);
        Ok(Some((self.number, line)))
    }
}
