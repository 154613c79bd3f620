//! Fixes of a solution file of RTKLIB (`.pos`), one per line (RTKLIB manual 2.4.2, appendix B.1).
//!
//! The header names the time system and the columns. Times of GPS are ahead of UTC by the leap seconds.

use std::io::Read;

use jiff::civil::{Date, DateTime};
use jiff::tz::{Offset, TimeZone};
use jiff::{SignedDuration, Timestamp};

use super::file_row::RowError;
use super::fix_quality::{Solution, sigma_of_deviations};
use super::fix_row::FixRow;
use super::lines::Lines;
use super::wire;
use crate::domain::{Error, Result, SigmaM, TimeBounds};

/// Seconds by which GPS time is ahead of UTC, from each date on (IERS Bulletin C). None was announced since.
const LEAP_SECONDS: [(Date, i64); 6] = [
    (jiff::civil::date(2017, 1, 1), 18),
    (jiff::civil::date(2015, 7, 1), 17),
    (jiff::civil::date(2012, 7, 1), 16),
    (jiff::civil::date(2009, 1, 1), 15),
    (jiff::civil::date(2006, 1, 1), 14),
    (jiff::civil::date(1999, 1, 1), 13),
];
/// The day on which week 0 of GPS began.
const FIRST_DAY: Date = jiff::civil::date(1980, 1, 6);
const WEEK_S: f64 = 604_800.0;
/// Weeks until the year 2100.
const MOST_WEEKS: f64 = 6_300.0;

/// Reads the fixes of a solution file.
pub(super) struct RtklibFixes<R> {
    lines: Lines<R>,
    header: Option<Header>,
    time_bounds: TimeBounds,
}

/// The line that names the columns.
struct Header {
    time_system: TimeSystem,
    /// After date and time of day, or week and second of the week.
    columns: Vec<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TimeSystem {
    Gps,
    Utc,
    Japan,
}

impl<R: Read> RtklibFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self { lines: Lines::new(reader), header: None, time_bounds }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        let Self { lines, header, time_bounds } = self;
        lines.find_row(|line, text| {
            if let Some(comment) = text.strip_prefix('%') {
                *header = Header::of(comment).or(header.take());
                return Ok(None);
            }
            if text.is_empty() {
                Ok(None)
            } else {
                fix_of(line, text, header.as_ref(), time_bounds).map(Some)
            }
        })
    }
}

impl Header {
    /// `None` for a line that names no columns.
    fn of(comment: &str) -> Option<Self> {
        let mut names = fields(comment);
        let time_system = match names.next()? {
            "GPST" => TimeSystem::Gps,
            "UTC" => TimeSystem::Utc,
            "JST" => TimeSystem::Japan,
            _ => return None,
        };
        Some(Self { time_system, columns: names.map(str::to_owned).collect() })
    }
}

/// The fields of a line. RTKLIB separates them by spaces, or by what its user has set.
fn fields(text: &str) -> impl Iterator<Item = &str> {
    text.split([' ', '\t', ',', ';']).filter(|field| !field.is_empty())
}

fn fix_of(
    line: u64,
    text: &str,
    header: Option<&Header>,
    time_bounds: &TimeBounds,
) -> Result<Result<FixRow, RowError>> {
    let reason = "no line before it begins with % GPST, % UTC or % JST and names the columns";
    let header = header.ok_or_else(|| Error::invalid("", reason))?;
    let mut texts = fields(text);
    let (day, time_of_day) = (texts.next().unwrap_or_default(), texts.next().unwrap_or_default());
    let time = time_of(day, time_of_day, header.time_system)
        .ok_or_else(|| Error::invalid("time", "must be 2026/01/05 08:00:00.000 or a week and its second"))?;
    let values: Vec<&str> = texts.collect();
    let number = |name: &str| {
        let at = header.columns.iter().position(|column| column == name)?;
        values.get(at)?.parse::<f64>().ok()
    };
    let required = |name: &str| {
        let reason = "is required: choose Lat/Lon/Height in degrees as the format of the solution";
        number(name).ok_or_else(|| Error::invalid(name, reason))
    };
    let fix = wire::Fix {
        longitude_deg: required("longitude(deg)")?,
        latitude_deg: required("latitude(deg)")?,
        sigma_m: sigma(&number).map(SigmaM::metres),
    };
    Ok(FixRow::checked(line, Some(time), None, fix.to_domain()?, time_bounds))
}

/// By the standard deviations of the solution, else by its quality `Q`.
fn sigma(number: &impl Fn(&str) -> Option<f64>) -> Option<SigmaM> {
    let deviations = number("sde(m)").zip(number("sdn(m)"));
    deviations.and_then(|(east_m, north_m)| sigma_of_deviations(east_m, north_m)).or_else(|| {
        let solution = match number("Q")? as u8 {
            1 => Solution::RtkFixed,
            // Precise point positioning (6) converges to some decimetres, too.
            2 | 6 => Solution::RtkFloat,
            3 | 4 => Solution::Differential,
            5 => Solution::Autonomous,
            _ => return None,
        };
        solution.sigma(None)
    })
}

/// The instant of a date and a time of day, or of a week of GPS and its second.
fn time_of(day: &str, time_of_day: &str, system: TimeSystem) -> Option<Timestamp> {
    let local = if day.contains('/') {
        let date: Date = day.replace('/', "-").parse().ok()?;
        DateTime::from_parts(date, time_of_day.parse().ok()?)
    } else {
        let (week, second): (f64, f64) = (day.parse().ok()?, time_of_day.parse().ok()?);
        let is_usable = (0.0..MOST_WEEKS).contains(&week) && (0.0..WEEK_S).contains(&second);
        let elapsed = is_usable.then(|| SignedDuration::try_from_secs_f64(week * WEEK_S + second).ok())??;
        FIRST_DAY.at(0, 0, 0, 0).checked_add(elapsed).ok()?
    };
    let zone = match system {
        TimeSystem::Japan => TimeZone::fixed(Offset::constant(9)),
        TimeSystem::Gps | TimeSystem::Utc => TimeZone::UTC,
    };
    let time = zone.to_timestamp(local).ok()?;
    if system != TimeSystem::Gps {
        return Some(time);
    }
    let leap_s = LEAP_SECONDS.iter().find(|(from, _)| local.date() >= *from).map_or(0, |(_, leap_s)| *leap_s);
    time.checked_sub(SignedDuration::from_secs(leap_s)).ok()
}
