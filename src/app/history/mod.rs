//! The history: finished tracks of cameras and sites that ask for one, in the archive.
//!
//! A track that is followed has a [`recorder::TrackRecorder`]. When the track ends, however it does, its path goes into a bounded
//! queue; nothing that follows targets ever waits. One task smooths the paths and writes them.

mod heat_map;
pub(super) mod path;
mod queries;
pub(super) mod queue;
pub(super) mod recorder;
mod writer;

pub use heat_map::{HeatCell, HeatMap};
pub use queries::{History, HistoryRows, HistorySelection};
pub use queue::ArchivedHistory;
pub(in crate::app) use writer::write_finished_tracks;
