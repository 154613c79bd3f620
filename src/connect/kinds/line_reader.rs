//! Puts lines together.

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _};

use crate::connect::inbox::{ByteBudget, HeldBytes};

/// A shorter line is charged to nobody.
const SHORT_BYTES: usize = 8 << 10;
/// Bytes that are read at a time: after a line, less than a short line is left.
const CHUNK_BYTES: usize = 4 << 10;

/// The result of a read.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Line {
    /// Without its end.
    Whole(Bytes),
    /// A line that is longer than the limit; its rest is skipped.
    TooLong,
}

/// Reads lines. What is read stays in the buffer, so that a wait can be cancelled.
pub(super) struct LineReader<S> {
    stream: S,
    buffer: BytesMut,
    /// Bytes of the buffer that contain no line end.
    searched: usize,
    max_bytes: usize,
    /// True if the rest of a line that is too long is being skipped.
    skips: bool,
    /// Where the bytes of a long line are charged; nowhere for a source that reads a single peer.
    budget: Option<ByteBudget>,
    held: Option<HeldBytes>,
}

impl<S: AsyncRead + Unpin> LineReader<S> {
    pub(super) fn new(stream: S, max_bytes: usize, budget: Option<ByteBudget>) -> Self {
        let buffer = BytesMut::with_capacity(SHORT_BYTES);
        Self { stream, buffer, searched: 0, max_bytes, skips: false, budget, held: None }
    }

    /// The next line; `None` at the end of the stream.
    pub(super) async fn next(&mut self) -> std::io::Result<Option<Line>> {
        loop {
            if let Some(line) = self.take_line() {
                return Ok(Some(Line::Whole(line)));
            }
            if self.is_full() {
                self.empty();
                if !std::mem::replace(&mut self.skips, true) {
                    return Ok(Some(Line::TooLong));
                }
            }
            self.buffer.reserve(CHUNK_BYTES);
            if self.stream.read_buf(&mut (&mut self.buffer).limit(CHUNK_BYTES)).await? == 0 {
                return Ok(None);
            }
        }
    }

    /// A line of the buffer. It is copied: a queued line must not hold the buffer that it was read into.
    fn take_line(&mut self) -> Option<Bytes> {
        while let Some(at) = self.buffer[self.searched..].iter().position(|byte| *byte == b'\n') {
            let length = self.searched + at;
            let line =
                (!std::mem::take(&mut self.skips)).then(|| Bytes::copy_from_slice(&self.buffer[..length]));
            self.buffer.advance(length + 1);
            self.searched = 0;
            if line.is_some() {
                self.shrink();
                return line;
            }
        }
        self.searched = self.buffer.len();
        None
    }

    /// True if the line that has begun may not become longer.
    fn is_full(&mut self) -> bool {
        let length = self.buffer.len();
        if length > self.max_bytes {
            return true;
        }
        let Some(budget) = self.budget.as_ref().filter(|_| length >= SHORT_BYTES) else { return false };
        let held = self.held.as_ref().map_or(0, HeldBytes::num_permits);
        if length <= held {
            return false;
        }
        // The buffer grows by doubling.
        match budget.try_hold(2 * length - held) {
            Some(more) => {
                match &mut self.held {
                    Some(held) => held.merge(more),
                    None => self.held = Some(more),
                }
                false
            }
            None => true,
        }
    }

    fn empty(&mut self) {
        self.buffer.clear();
        self.searched = 0;
        self.shrink();
    }

    /// Gives back the memory of a long line, and what was charged for it: who waits for a budget must hold nothing of it.
    fn shrink(&mut self) {
        if self.buffer.len() < SHORT_BYTES {
            self.held = None;
            if self.buffer.capacity() > 4 * SHORT_BYTES {
                let mut small = BytesMut::with_capacity(SHORT_BYTES);
                small.extend_from_slice(&self.buffer);
                self.buffer = small;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn lines(text: &[u8], max_bytes: usize, budget: Option<ByteBudget>) -> Vec<Line> {
        let mut reader = LineReader::new(text, max_bytes, budget);
        let mut lines = Vec::new();
        while let Some(line) = reader.next().await.expect("a slice can be read") {
            lines.push(line);
        }
        lines
    }

    #[tokio::test]
    async fn lines_that_are_too_long_are_told_once_and_skipped() {
        let long = vec![b'x'; 300_000];
        let text = [&b"one\r\n"[..], &long, b"\ntwo\n\nrest"].concat();
        let whole = |text: &'static str| Line::Whole(Bytes::from_static(text.as_bytes()));
        assert_eq!(
            lines(&text, 100_000, None).await,
            [whole("one\r"), Line::TooLong, whole("two"), whole("")]
        );
        assert_eq!(lines(&text, 300_000, None).await.len(), 4);
        assert_eq!(lines(&text, 300_000, None).await[1], Line::Whole(long.into()));
    }

    #[tokio::test]
    async fn a_long_line_needs_bytes_of_the_budget_and_gives_them_back() {
        let text = [&vec![b'x'; 300_000][..], b"\ntwo\n"].concat();
        let budget = ByteBudget::new(1 << 20);
        let read = lines(&text, 1 << 20, Some(budget.clone())).await;
        assert!(matches!(&read[0], Line::Whole(line) if line.len() == 300_000));
        let others = budget.try_hold(budget.bytes() - 100_000).expect("all was given back");
        let read = lines(&text, 1 << 20, Some(budget.clone())).await;
        assert_eq!(read, [Line::TooLong, Line::Whole(Bytes::from_static(b"two"))], "others hold the budget");
        drop(others);
        assert!(budget.try_hold(budget.bytes()).is_some());
    }
}
