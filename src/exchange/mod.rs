//! Files of samples, observations, fixes and fused positions: CSV, NDJSON, JSON, GeoJSON,
//! NMEA, GPX and gpsd's log.
//!
//! HTTP, the command line and evaluation all read and write through here, so a file means the same
//! everywhere. Readers and writers stream: memory is bounded by one line or element of at most
//! 64 KiB, however long the file. One bad row never loses the others: its line, field and reason
//! come out in its place. What never happens here: transports, storage, clocks; numbers are checked
//! by the constructors of [`crate::domain`] alone.

mod columns;
mod csv_rows;
mod cursor;
mod elements;
mod fixes;
mod format;
mod formula_guard;
mod gpsd;
mod gpx;
mod lines;
mod nmea_fixes;
mod rows;
#[cfg(test)]
mod tests;
pub mod wire;
mod write;

pub use cursor::{Cursor, read_cursor, write_cursor};
pub use fixes::{FixFormat, TimedFix, read_fixes, read_received_fixes};
pub use format::Format;
pub use rows::{ObservedRow, RowError, RowRules, read_detections, read_observations, read_samples};
pub use write::{FusedWriter, SampleWriter, write_fused, write_samples};

/// Longest line of a CSV, NDJSON or NMEA file and longest element of a JSON array, in bytes.
pub const LONGEST_ROW_BYTES: usize = 64 * 1024;
