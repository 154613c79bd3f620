//! Rows of several files of one hour in one order, each row once.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::ops::Range;
use std::vec::IntoIter;

use bytes::Bytes;
use object_store::path::Path;

use crate::domain::{ArchivedPosition, Result};
use crate::file::Footer;
use crate::selection::Selection;

/// The rows of one file that are in a selection.
pub(crate) struct FileRows {
    pub(crate) path: Path,
    pub(crate) footer: Footer,
    groups: IntoIter<usize>,
    rows: IntoIter<ArchivedPosition>,
}

impl FileRows {
    pub(crate) fn new(path: Path, footer: Footer, selection: &Selection) -> Self {
        let groups = footer.groups(selection).into_iter();
        Self { path, footer, groups, rows: Vec::new().into_iter() }
    }

    fn next(&mut self, selection: &Selection, fetch: &impl Fetch) -> Result<Option<ArchivedPosition>> {
        loop {
            if let Some(row) = self.rows.find(|row| selection.contains(row)) {
                return Ok(Some(row));
            }
            let Some(group) = self.groups.next() else { return Ok(None) };
            self.rows = self.footer.read_group(group, |range| fetch(&self.path, range))?.into_iter();
        }
    }
}

/// Reads a range of bytes of a file.
pub(crate) trait Fetch: Fn(&Path, Range<u64>) -> Result<Bytes> {}

impl<F: Fn(&Path, Range<u64>) -> Result<Bytes>> Fetch for F {}

/// The rows of several files, in order of time and track.
pub(crate) struct Merged<'a, F> {
    files: Vec<FileRows>,
    selection: &'a Selection,
    fetch: F,
    /// The next row of every file that has one, with the number of the file.
    next: BinaryHeap<Reverse<Head>>,
}

struct Head {
    row: ArchivedPosition,
    file: usize,
}

impl PartialEq for Head {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Head {}

impl PartialOrd for Head {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Head {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.row.key(), self.file).cmp(&(other.row.key(), other.file))
    }
}

impl<'a, F: Fetch> Merged<'a, F> {
    pub(crate) fn new(files: Vec<FileRows>, selection: &'a Selection, fetch: F) -> Result<Self> {
        let mut merged = Self { files, selection, fetch, next: BinaryHeap::new() };
        for file in 0..merged.files.len() {
            merged.advance(file)?;
        }
        Ok(merged)
    }

    fn advance(&mut self, file: usize) -> Result<()> {
        let Some(rows) = self.files.get_mut(file) else { return Ok(()) };
        if let Some(row) = rows.next(self.selection, &self.fetch)? {
            self.next.push(Reverse(Head { row, file }));
        }
        Ok(())
    }

    /// The next row; one that another file repeats comes once.
    pub(crate) fn next_row(&mut self) -> Result<Option<ArchivedPosition>> {
        let Some(Reverse(Head { row, file })) = self.next.pop() else { return Ok(None) };
        self.advance(file)?;
        while let Some(Reverse(same)) = self.next.peek()
            && same.row.key() == row.key()
        {
            let file = same.file;
            self.next.pop();
            self.advance(file)?;
        }
        Ok(Some(row))
    }
}
