//! Files of fixes: for estimating a receiver's error, and for pairing.

use std::io::{BufRead as _, BufReader, Read};

use jiff::Timestamp;

use super::columns::{LATITUDE, LONGITUDE};
use super::csv_layout::LaidOut;
use super::csv_rows::CsvRows;
use super::file_row::{FileRow, RowError, shared};
use super::fit::FitFixes;
use super::fix_row::FixRow;
use super::format::FixFormat;
use super::gnss_logger::GnssLoggerFixes;
use super::gpsd::GpsdFixes;
use super::gpx::GpxFixes;
use super::nmea_fixes::NmeaFixes;
use super::rtklib::RtklibFixes;
use crate::domain::{Error, Fix, ReceivedFix, ReceiverId, Result, TimeBounds, parse_time};

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
    let mut rows = FixRows::new(reader, &format.into(), time_bounds)?;
    Ok(std::iter::from_fn(move || {
        let row = rows.next_row()?;
        Some(row.map(|row| row.map(|FixRow { time, fix, .. }| TimedFix { time, fix })))
    }))
}

/// Fixes with their receivers; a fix without a time is a row error.
///
/// # Errors
/// As [`read_fixes`].
pub fn read_received_fixes<R: Read, F: Into<LaidOut<FixFormat>>>(
    reader: R,
    format: F,
    time_bounds: TimeBounds,
) -> Result<impl Iterator<Item = Result<Result<ReceivedFix, RowError>>> + use<R, F>> {
    let laid_out = format.into();
    let format = laid_out.format;
    let mut rows = FixRows::new(reader, &laid_out, time_bounds)?;
    Ok(std::iter::from_fn(move || {
        let row = rows.next_row()?;
        Some(row.map(|row| row.and_then(|row| row.received(format))))
    }))
}

enum FixRows<R> {
    Csv { rows: CsvRows<R>, time_bounds: TimeBounds, receiver_id: Option<ReceiverId> },
    Nmea(NmeaFixes<R>),
    Gpx(Box<GpxFixes<R>>),
    Gpsd(GpsdFixes<R>),
    Rtklib(RtklibFixes<R>),
    Fit(Box<FitFixes<R>>),
    GnssLogger(GnssLoggerFixes<R>),
}

impl<R: Read> FixRows<BufReader<R>> {
    fn new(reader: R, laid_out: &LaidOut<FixFormat>, time_bounds: TimeBounds) -> Result<Self> {
        let mut reader = BufReader::new(reader);
        let beginning = reader.fill_buf().map_err(Error::fault)?;
        Ok(match laid_out.format.of_content(beginning) {
            FixFormat::Csv => {
                let rows = CsvRows::with_receivers(reader, &[LONGITUDE, LATITUDE], &laid_out.layout)?;
                Self::Csv { rows, time_bounds, receiver_id: None }
            }
            FixFormat::Nmea => Self::Nmea(NmeaFixes::new(reader, time_bounds)),
            FixFormat::Gpx => Self::Gpx(Box::new(GpxFixes::new(reader, time_bounds))),
            FixFormat::Gpsd => Self::Gpsd(GpsdFixes::new(reader, time_bounds)),
            FixFormat::Rtklib => Self::Rtklib(RtklibFixes::new(reader, time_bounds)),
            FixFormat::Fit => Self::Fit(Box::new(FitFixes::new(reader, time_bounds))),
            FixFormat::GnssLogger => Self::GnssLogger(GnssLoggerFixes::new(reader, time_bounds)),
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
            Self::Rtklib(rows) => rows.next_row(),
            Self::Fit(rows) => rows.next_row(),
            Self::GnssLogger(rows) => rows.next_row(),
        }
    }
}

/// The row without its line number, which the reader adds.
fn csv_row(row: &FileRow<'_>, time_bounds: &TimeBounds, previous: &mut Option<ReceiverId>) -> Result<FixRow> {
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
