//! Fixes of a gpsd log: one JSON report per line, as written by `gpspipe -w`.
//!
//! Reports of class TPV contain the fixes; others are skipped. gpsd's error estimates (`eph`, `epx`,
//! `epy`) are not used: their confidence level is not defined.

use std::io::Read;

use jiff::Timestamp;
use serde::Deserialize;

use super::file_row::RowError;
use super::fix_row::FixRow;
use super::lines::{Line, Lines};
use super::wire::{self, Text};
use crate::domain::{Error, ReceiverId, Result, TimeBounds, parse_time};

/// Reads a gpsd log's fixes.
pub(super) struct GpsdFixes<R> {
    lines: Lines<R>,
    time_bounds: TimeBounds,
}

/// The fields of a report that are used.
#[derive(Deserialize)]
struct GpsdReport<'a> {
    #[serde(borrow)]
    class: Text<'a>,
    #[serde(borrow)]
    device: Option<Text<'a>>,
    mode: Option<u8>,
    status: Option<u8>,
    #[serde(borrow)]
    time: Option<Text<'a>>,
    lon: Option<f64>,
    lat: Option<f64>,
}

impl<R: Read> GpsdFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self { lines: Lines::new(reader), time_bounds }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        loop {
            let (line, text) = match self.lines.next_line() {
                Err(error) => return Some(Err(Error::fault(error))),
                Ok(None) => return None,
                Ok(Some(read)) => read,
            };
            let text = match text {
                Line::Text(text) => text.trim(),
                Line::NotUtf8 => return Some(Ok(Err(RowError::whole(line, "is not UTF-8")))),
                Line::TooLong => return Some(Ok(Err(RowError::whole(line, "is longer than 64 KiB")))),
            };
            if text.is_empty() {
                continue;
            }
            match report(line, text, &self.time_bounds) {
                Ok(None) => {}
                Ok(Some(row)) => return Some(Ok(row)),
                Err(error) => return Some(RowError::of(line, error).map(Err)),
            }
        }
    }
}

/// The fix of a report; `None` for a report of another class.
pub(super) fn report(
    line: u64,
    text: &str,
    time_bounds: &TimeBounds,
) -> Result<Option<Result<FixRow, RowError>>> {
    let report: GpsdReport<'_> = wire::parse_json(text.as_bytes())?;
    if report.class.as_str() != "TPV" {
        return Ok(None);
    }
    if matches!(report.mode, None | Some(0 | 1)) {
        return Err(Error::invalid("mode", "the receiver had no fix"));
    }
    if matches!(report.status, Some(5 | 7 | 8)) {
        let reason = "the position is dead reckoning, surveyed or simulated (status 5, 7, 8), not received";
        return Err(Error::invalid("status", reason));
    }
    let required = |number: Option<f64>, field| number.ok_or_else(|| Error::invalid(field, "is required"));
    let fix = wire::Fix {
        longitude_deg: required(report.lon, "lon")?,
        latitude_deg: required(report.lat, "lat")?,
        sigma_m: None,
    };
    let receiver_id = report.device.map(|device| ReceiverId::new(device.as_str())).transpose();
    let receiver_id = receiver_id.map_err(|_| Error::invalid("device", "is too long or not printable"))?;
    let time: Option<Timestamp> = report.time.map(|text| parse_time(text.as_str())).transpose()?;
    Ok(Some(FixRow::checked(line, time, receiver_id, fix.to_domain()?, time_bounds)))
}
