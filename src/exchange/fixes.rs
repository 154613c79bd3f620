//! Files of fixes alone: for a receiver's error, and for pairing.

use std::io::Read;

use jiff::Timestamp;
use nmea::sentences::{FixType, GgaData};
use nmea::{ParseResult, SentenceType};

use super::columns::{LATITUDE, LONGITUDE};
use super::csv_rows::CsvRows;
use super::lines::{Line, Lines};
use super::rows::{Row, RowError};
use super::wire;
use crate::domain::{Error, Fix, Result, TimeBounds, parse_time};

/// A format of fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FixFormat {
    /// Columns `longitude`, `latitude` and at will `time` and `sigma_m`; other columns of sample
    /// files may stand beside them.
    Csv,
    /// NMEA 0183: GGA sentences; others are passed over.
    Nmea,
}

impl FixFormat {
    /// The format that a file's extension announces; `nmea`, `log` and `txt` are NMEA.
    #[must_use]
    pub fn from_path(path: &std::path::Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "csv" => Some(Self::Csv),
            "nmea" | "log" | "txt" => Some(Self::Nmea),
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
            _ => None,
        }
    }
}

/// A fix and its time; GGA sentences know no date, so theirs is `None`.
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
/// Outside, as an item and within an item as [`super::read_samples`]. Sentences without a fix
/// (quality 0), of a wrong checksum or of estimated, manual or simulated positions are the row's
/// fault.
pub fn read_fixes<R: Read>(
    reader: R,
    format: FixFormat,
    time_bounds: TimeBounds,
) -> Result<impl Iterator<Item = Result<Result<TimedFix, RowError>>> + use<R>> {
    let mut rows = match format {
        FixFormat::Csv => FixRows::Csv(CsvRows::new(reader, &[LONGITUDE, LATITUDE])?),
        FixFormat::Nmea => FixRows::Nmea(Lines::new(reader)),
    };
    Ok(std::iter::from_fn(move || match &mut rows {
        FixRows::Csv(rows) => rows.next_row(|row| timed_fix(&row, &time_bounds)),
        FixRows::Nmea(lines) => next_gga(lines),
    }))
}

enum FixRows<R> {
    Csv(CsvRows<R>),
    Nmea(Lines<R>),
}

fn timed_fix(row: &Row<'_>, time_bounds: &TimeBounds) -> Result<TimedFix> {
    let time = row.time.as_ref().map(|text| time_bounds.check(parse_time(text.as_str())?));
    let fix = row.fix.ok_or_else(|| Error::invalid("fix", "is required"))?;
    Ok(TimedFix { time: time.transpose()?, fix: fix.to_domain().map_err(|error| error.under("fix"))? })
}

fn next_gga<R: Read>(lines: &mut Lines<R>) -> Option<Result<Result<TimedFix, RowError>>> {
    loop {
        let (line, text) = match lines.next_line() {
            Err(broken) => return Some(Err(Error::fault(broken))),
            Ok(None) => return None,
            Ok(Some(read)) => read,
        };
        let fix = match text {
            Line::Text(text) => gga(text.trim()).transpose(),
            Line::NotUtf8 => Some(Err("is not UTF-8".to_owned())),
            Line::TooLong => Some(Err("is longer than 64 KiB".to_owned())),
        };
        match fix {
            None => {}
            Some(Ok(fix)) => return Some(Ok(Ok(TimedFix { time: None, fix }))),
            Some(Err(reason)) => return Some(Ok(Err(RowError::whole(line, &reason)))),
        }
    }
}

/// The fix of a GGA sentence; `None` for a blank line or another sentence.
fn gga(text: &str) -> Result<Option<Fix>, String> {
    if text.is_empty() || is_other_sentence(text) {
        return Ok(None);
    }
    match nmea::parse_str(text) {
        Ok(ParseResult::GGA(gga)) => fix_of(&gga).map(Some),
        Ok(_) => Ok(None),
        Err(nmea::Error::ChecksumMismatch { .. }) => Err("the sentence's checksum is wrong".to_owned()),
        Err(_) => Err("is not an NMEA 0183 sentence".to_owned()),
    }
}

/// `$` or `!`, two letters of the talker, three of the sentence; `$P...` is a maker's own.
fn is_other_sentence(text: &str) -> bool {
    let Some(address) = text.strip_prefix(['$', '!']).and_then(|rest| rest.split(',').next()) else {
        return false;
    };
    let is_address = (4..=10).contains(&address.len()) && address.bytes().all(|b| b.is_ascii_alphanumeric());
    is_address && address.get(2..) != Some(SentenceType::GGA.as_str())
}

fn fix_of(gga: &GgaData) -> Result<Fix, String> {
    match gga.fix_type {
        Some(quality) if quality.is_valid() => {}
        None | Some(FixType::Invalid) => return Err("the receiver had no fix (quality 0)".to_owned()),
        Some(_) => {
            return Err(
                "the position is estimated, typed in or simulated (quality 6 to 8), not received".to_owned()
            );
        }
    }
    let (Some(longitude_deg), Some(latitude_deg)) = (gga.longitude, gga.latitude) else {
        return Err("the sentence has no position".to_owned());
    };
    wire::Fix { longitude_deg, latitude_deg, sigma_m: None }.to_domain().map_err(|error| error.to_string())
}
