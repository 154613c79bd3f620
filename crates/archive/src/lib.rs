//! The archive: positions of finished tracks in columnar files, in a folder or an object store.
//!
//! | part | contents |
//! |---|---|
//! | [`Selection`] | the rows that a query or a deletion is for |
//! | [`Archive`] | writing, scanning, deletion, retention and compaction of files |
//! | [`FileWriter`] | a file of positions in GeoParquet, a group of rows at a time |
//!
//! A file has the rows of one scope and one hour, in order of time and track: its path is
//! `cameras/gate/2026-11-24/07/<name>.parquet`. A row is identified by its scope, time and track. The same row in two
//! files counts once: files are replaced by writing the new ones first, so a crash in between loses and repeats nothing.
//!
//! All calls block; they belong on a thread for blocking work.

#![warn(missing_docs)]
// Files of an archive may be damaged: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod archive;
mod columns;
mod file;
mod hour;
mod scan;
mod selection;
#[cfg(test)]
mod tests;

pub use archive::{Archive, Location};
pub use file::FileWriter;
pub use selection::{BoundingArea, Selection};

use sightfix_domain::{domain, geo};
