//! Files of fixes: for estimating a receiver's error, and for pairing.

use std::io::Read;

use jiff::Timestamp;
use strum::{EnumString, IntoStaticStr, VariantArray};

use super::columns::{LATITUDE, LONGITUDE};
use super::csv_rows::CsvRows;
use super::gpsd::GpsdFixes;
use super::gpx::GpxFixes;
use super::nmea_fixes::NmeaFixes;
use super::rows::{Row, RowError, shared};
use crate::domain::{Error, Fix, ReceivedFix, ReceiverId, Result, TimeBounds, parse_time};

/// A format of fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_fix_format)]
pub enum FixFormat {
    /// Columns `longitude`, `latitude` and optionally `time`, `sigma_m` and `receiver_id`; other columns
    /// of sample files are accepted. Without a `receiver_id` the `target_id` is used instead.
    Csv,
    /// NMEA 0183: positions of GGA, dates of RMC and ZDA; other sentences are skipped.
    Nmea,
    /// GPX: track, route and way points.
    Gpx,
    /// Reports of gpsd, one per line (`gpspipe -w`): those of class TPV. The receiver is the `device`.
    Gpsd,
}

impl FixFormat {
    /// All formats.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The format of a file's extension; `nmea`, `log` and `txt` are NMEA; `json`,
    /// `ndjson` and `jsonl` are gpsd's.
    #[must_use]
    pub fn from_path(path: &std::path::Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "csv" => Some(Self::Csv),
            "nmea" | "log" | "txt" => Some(Self::Nmea),
            "gpx" => Some(Self::Gpx),
            "json" | "ndjson" | "jsonl" => Some(Self::Gpsd),
            _ => None,
        }
    }

    /// The format of a media type.
    #[must_use]
    pub fn from_media_type(media_type: &str) -> Option<Self> {
        let essence = media_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        match essence.as_str() {
            "text/csv" => Some(Self::Csv),
            "application/nmea" | "application/x-nmea" | "text/x-nmea" | "text/plain" => Some(Self::Nmea),
            "application/gpx+xml" => Some(Self::Gpx),
            "application/json" | "application/x-ndjson" | "application/ndjson" | "application/jsonl" => {
                Some(Self::Gpsd)
            }
            _ => None,
        }
    }

    /// Name in commands and reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

fn unknown_fix_format(_: &str) -> Error {
    Error::invalid("format", "must be one of csv, nmea, gpx, gpsd")
}

/// A fix, and its time if the file has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedFix {
    /// Time by the receiver's clock.
    pub time: Option<Timestamp>,
    /// The fix.
    pub fix: Fix,
}

/// Fixes of a file, in the order of the file.
///
/// # Errors
/// As [`super::read_samples`]. NMEA sentences and gpsd reports without a fix, with a wrong checksum or
/// with estimated, manual or simulated positions are row errors.
pub fn read_fixes<R: Read>(
    reader: R,
    format: FixFormat,
    time_bounds: TimeBounds,
) -> Result<impl Iterator<Item = Result<Result<TimedFix, RowError>>> + use<R>> {
    let mut rows = FixRows::new(reader, format, time_bounds)?;
    Ok(std::iter::from_fn(move || {
        let row = rows.next_row()?;
        Some(row.map(|row| row.map(|FixRow { time, fix, .. }| TimedFix { time, fix })))
    }))
}

/// Fixes with their receivers; a fix without a time is a row error.
///
/// # Errors
/// As [`read_fixes`].
pub fn read_received_fixes<R: Read>(
    reader: R,
    format: FixFormat,
    time_bounds: TimeBounds,
) -> Result<impl Iterator<Item = Result<Result<ReceivedFix, RowError>>> + use<R>> {
    let mut rows = FixRows::new(reader, format, time_bounds)?;
    Ok(std::iter::from_fn(move || {
        let row = rows.next_row()?;
        Some(row.map(|row| row.and_then(|row| row.received(format))))
    }))
}

/// A fix of a file, not yet checked for completeness.
pub(super) struct FixRow {
    line: u64,
    time: Option<Timestamp>,
    receiver_id: Option<ReceiverId>,
    fix: Fix,
}

impl FixRow {
    /// A fix with a valid time, if it has one.
    pub(super) fn checked(
        line: u64,
        time: Option<Timestamp>,
        receiver_id: Option<ReceiverId>,
        fix: Fix,
        time_bounds: &TimeBounds,
    ) -> Result<Self, RowError> {
        match time.map(|time| time_bounds.check(time)).transpose() {
            Ok(time) => Ok(Self { line, time, receiver_id, fix }),
            Err(error) => Err(RowError { line, field: "time".to_owned(), reason: error.to_string() }),
        }
    }

    fn received(self, format: FixFormat) -> Result<ReceivedFix, RowError> {
        let Self { line, time, receiver_id, fix } = self;
        if let Some(time) = time {
            return Ok(ReceivedFix { time, receiver_id, fix });
        }
        let reason = match format {
            FixFormat::Nmea => "has no date: the file has no RMC or ZDA sentence",
            FixFormat::Csv | FixFormat::Gpx | FixFormat::Gpsd => "is required",
        };
        Err(RowError { line, field: "time".to_owned(), reason: reason.to_owned() })
    }
}

enum FixRows<R> {
    Csv { rows: CsvRows<R>, time_bounds: TimeBounds, receiver_id: Option<ReceiverId> },
    Nmea(NmeaFixes<R>),
    Gpx(Box<GpxFixes<R>>),
    Gpsd(GpsdFixes<R>),
}

impl<R: Read> FixRows<R> {
    fn new(reader: R, format: FixFormat, time_bounds: TimeBounds) -> Result<Self> {
        Ok(match format {
            FixFormat::Csv => {
                let rows = CsvRows::of_fixes(reader, &[LONGITUDE, LATITUDE])?;
                Self::Csv { rows, time_bounds, receiver_id: None }
            }
            FixFormat::Nmea => Self::Nmea(NmeaFixes::new(reader, time_bounds)),
            FixFormat::Gpx => Self::Gpx(Box::new(GpxFixes::new(reader, time_bounds))),
            FixFormat::Gpsd => Self::Gpsd(GpsdFixes::new(reader, time_bounds)),
        })
    }

    fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        match self {
            Self::Csv { rows, time_bounds, receiver_id } => {
                let row = rows.next_row(|row| csv_row(&row, time_bounds, receiver_id))?;
                let line = rows.line();
                Some(row.map(|row| row.map(|fix_row| FixRow { line, ..fix_row })))
            }
            Self::Nmea(rows) => rows.next_row(),
            Self::Gpx(rows) => rows.next_row(),
            Self::Gpsd(rows) => rows.next_row(),
        }
    }
}

/// The row without its line number, which the reader adds.
fn csv_row(row: &Row<'_>, time_bounds: &TimeBounds, previous: &mut Option<ReceiverId>) -> Result<FixRow> {
    let time = row.time.as_ref().map(|text| time_bounds.check(parse_time(text.as_str())?)).transpose()?;
    let named = row.receiver_id.as_ref().or(row.target_id.as_ref());
    let fix = row.fix.ok_or_else(|| Error::invalid("fix", "is required"))?;
    Ok(FixRow {
        line: 0,
        time,
        receiver_id: shared(named, previous, ReceiverId::as_str, ReceiverId::new)?,
        fix: fix.to_domain().map_err(|error| error.under("fix"))?,
    })
}
