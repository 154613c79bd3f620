//! Files of tracks on the server's machine.

use super::fields::SinkFields;
use crate::address::Scheme;
use crate::domain::{Error, Result};
use crate::track_files::TrackFileFormat;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::bare("file")];
/// Time after which a new file begins, s, if the settings state none.
const DEFAULT_ROTATE_S: f64 = 3_600.0;

/// A folder of files.
#[derive(Debug, Clone, Copy)]
pub struct FileSink {
    /// Their format.
    pub format: TrackFileFormat,
    /// Time after which a new file begins, s.
    pub rotate_s: f64,
}

impl FileSink {
    pub(super) fn new(fields: &mut SinkFields) -> Result<Self> {
        let rule = "must be gpx or kml for the address file:, and for no other";
        let format = fields.track_file.take().ok_or_else(|| Error::invalid("format", rule))?;
        Ok(Self { format, rotate_s: fields.rotate_s.take().unwrap_or(DEFAULT_ROTATE_S) })
    }
}
