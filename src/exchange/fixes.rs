//! Files of fixes alone: for a receiver's error, and for pairing.

use std::io::Read;
use std::str::FromStr;

use jiff::Timestamp;

use super::columns::{LATITUDE, LONGITUDE};
use super::csv_rows::CsvRows;
use super::gpsd::GpsdFixes;
use super::gpx::GpxFixes;
use super::nmea_fixes::NmeaFixes;
use super::rows::{Row, RowError, shared};
use crate::domain::{Error, Fix, ReceivedFix, ReceiverId, Result, TimeBounds, parse_time};

/// A format of fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FixFormat {
    /// Columns `longitude`, `latitude` and at will `time`, `sigma_m` and `receiver_id`; other columns
    /// of sample files may stand beside them. Without a `receiver_id`, a `target_id` stands for it.
    Csv,
    /// NMEA 0183: positions of GGA, dates of RMC and ZDA; other sentences are passed over.
    Nmea,
    /// GPX: track, route and way points.
    Gpx,
    /// Reports of gpsd, one a line (`gpspipe -w`): those of class TPV. The receiver is the `device`.
    Gpsd,
}

impl FixFormat {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Csv, Self::Nmea, Self::Gpx, Self::Gpsd];

    /// The format that a file's extension announces; `nmea`, `log` and `txt` are NMEA; `json`,
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

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Nmea => "nmea",
            Self::Gpx => "gpx",
            Self::Gpsd => "gpsd",
        }
    }
}

impl FromStr for FixFormat {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|format| format.as_str() == name)
            .ok_or_else(|| Error::invalid("format", "must be one of csv, nmea, gpx, gpsd"))
    }
}

/// A fix, and its time where the file tells it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedFix {
    /// When.
    pub time: Option<Timestamp>,
    /// Where.
    pub fix: Fix,
}

/// Fixes of a file, one by one, in the file's order.
///
/// # Errors
/// Outside, as an item and within an item as [`super::read_samples`]. NMEA sentences and gpsd's
/// reports without a fix, of a wrong checksum or of estimated, manual or simulated positions are the
/// row's fault.
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

/// The same with receivers; a fix without a time is the row's fault.
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

/// A fix as it stands in a file.
pub(super) struct FixRow {
    line: u64,
    time: Option<Timestamp>,
    receiver_id: Option<ReceiverId>,
    fix: Fix,
}

impl FixRow {
    /// A fix of a believable time.
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
            FixFormat::Nmea => "has no date: no RMC or ZDA sentence of the file tells it",
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

/// The row but for its line, which its reader knows.
fn csv_row(row: &Row<'_>, time_bounds: &TimeBounds, before: &mut Option<ReceiverId>) -> Result<FixRow> {
    let time = row.time.as_ref().map(|text| time_bounds.check(parse_time(text.as_str())?)).transpose()?;
    let named = row.receiver_id.as_ref().or(row.target_id.as_ref());
    let fix = row.fix.ok_or_else(|| Error::invalid("fix", "is required"))?;
    Ok(FixRow {
        line: 0,
        time,
        receiver_id: shared(named, before, ReceiverId::as_str, ReceiverId::new)?,
        fix: fix.to_domain().map_err(|error| error.under("fix"))?,
    })
}
