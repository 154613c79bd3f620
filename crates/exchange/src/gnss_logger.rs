//! Fixes of a log of Android's GnssLogger, or of GPSTest in the same form: the lines `Fix,gps,...`.
//!
//! A comment before them names their columns. Lines of other providers (network, fused) are positions of the phone that
//! are not of its GNSS receiver alone; they are skipped like raw measurements.

use std::io::Read;

use super::file_row::RowError;
use super::fix_quality::sigma_of_radius_68;
use super::fix_row::FixRow;
use super::lines::Lines;
use super::unix_time::unix_time;
use super::wire;
use crate::domain::{Error, Result, SigmaM, TimeBounds};

/// The beginning of a line with a position, and of the comment with its columns.
const FIX: &str = "Fix,";

/// Reads the fixes of a log.
pub(super) struct GnssLoggerFixes<R> {
    lines: Lines<R>,
    /// Names of the columns after `Fix`.
    columns: Vec<String>,
    time_bounds: TimeBounds,
}

impl<R: Read> GnssLoggerFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self { lines: Lines::new(reader), columns: Vec::new(), time_bounds }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        let Self { lines, columns, time_bounds } = self;
        lines.find_row(|line, text| {
            if let Some(names) = text.strip_prefix('#').and_then(|it| it.trim().strip_prefix(FIX)) {
                *columns = names.split(',').map(|name| name.trim().to_owned()).collect();
            }
            text.strip_prefix(FIX).map_or(Ok(None), |values| fix_of(line, values, columns, time_bounds))
        })
    }
}

/// `None` for a position of another provider.
fn fix_of(
    line: u64,
    values: &str,
    columns: &[String],
    time_bounds: &TimeBounds,
) -> Result<Option<Result<FixRow, RowError>>> {
    let values: Vec<&str> = values.split(',').map(str::trim).collect();
    // Names differ between releases: the first of them that there is.
    let text = |names: &[&str]| {
        let at = columns.iter().position(|column| names.contains(&column.as_str()))?;
        values.get(at).copied().filter(|value| !value.is_empty())
    };
    if columns.is_empty() {
        return Err(Error::invalid("", "no line before it begins with # Fix and names the columns"));
    }
    if !text(&["Provider"]).is_some_and(|provider| provider.eq_ignore_ascii_case("gps")) {
        return Ok(None);
    }
    if text(&["MockLocation"]).is_some_and(|is_mock| matches!(is_mock, "1" | "true")) {
        return Err(Error::invalid("MockLocation", "the position is simulated"));
    }
    let number = |names: &[&str]| text(names).and_then(|value| value.parse::<f64>().ok());
    let required =
        |names: &[&str]| number(names).ok_or_else(|| Error::invalid(names[0], "is required, as a number"));
    let fix = wire::Fix {
        longitude_deg: required(&["LongitudeDegrees", "Longitude"])?,
        latitude_deg: required(&["LatitudeDegrees", "Latitude"])?,
        sigma_m: number(&["AccuracyMeters", "Accuracy"]).and_then(sigma_of_radius_68).map(SigmaM::metres),
    };
    const TIME: [&str; 2] = ["UnixTimeMillis", "(UTC)TimeInMs"];
    let time = unix_time(required(&TIME)?).map_err(|reason| Error::invalid(TIME[0], reason))?;
    Ok(Some(FixRow::checked(line, Some(time), None, fix.to_domain()?, time_bounds)))
}
