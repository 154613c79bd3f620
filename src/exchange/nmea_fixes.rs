//! Fixes of an NMEA 0183 log.
//!
//! Positions come from GGA, which tells their quality but only the time of day; the date comes from
//! RMC and ZDA. Other sentences are passed over.

use std::collections::VecDeque;
use std::io::Read;

use jiff::civil::{Date, DateTime, Time};
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Timestamp};
use nmea::sentences::rmc::RmcStatusOfFix;
use nmea::sentences::{FixType, GgaData, RmcData, ZdaData};
use nmea::{ParseResult, SentenceType};

use super::file_row::RowError;
use super::fix_row::FixRow;
use super::lines::{Line, Lines};
use super::wire;
use crate::domain::{Error, Fix, Result, TimeBounds};

/// Sentences that wait for the first date. Receivers send RMC or ZDA at least every few seconds; in
/// a file without a date the fixes come out without a time.
const MOST_WAITING: usize = 256;

/// Reads an NMEA log's fixes.
pub(super) struct NmeaFixes<R> {
    lines: Lines<R>,
    time_bounds: TimeBounds,
    /// The latest instant of which the date was told.
    dated: Option<Timestamp>,
    /// In the file's order; the first waits for a date.
    waiting: VecDeque<Waiting>,
}

enum Waiting {
    Fix { line: u64, time_of_day: Option<Time>, fix: Fix },
    Fault(RowError),
}

/// What a line tells.
enum Told {
    Fix(Option<Time>, Fix),
    Date(Timestamp),
    Nothing,
}

impl<R: Read> NmeaFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self { lines: Lines::new(reader), time_bounds, dated: None, waiting: VecDeque::new() }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        loop {
            let full = self.waiting.len() >= MOST_WAITING;
            let ready =
                self.dated.is_some() || full || matches!(self.waiting.front(), Some(Waiting::Fault(_)));
            if ready && let Some(first) = self.waiting.pop_front() {
                return Some(Ok(self.released(first)));
            }
            match self.read_line() {
                Err(broken) => return Some(Err(broken)),
                Ok(true) => {}
                Ok(false) => return self.waiting.pop_front().map(|first| Ok(self.released(first))),
            }
        }
    }

    /// Reads one line; `false` at the end of the file.
    fn read_line(&mut self) -> Result<bool> {
        let Some((line, text)) = self.lines.next_line().map_err(Error::fault)? else { return Ok(false) };
        let told = match text {
            Line::Text(text) => told(text.trim()),
            Line::NotUtf8 => Err("is not UTF-8".to_owned()),
            Line::TooLong => Err("is longer than 64 KiB".to_owned()),
        };
        match told {
            Ok(Told::Nothing) => {}
            Ok(Told::Date(dated)) => self.dated = Some(dated),
            Ok(Told::Fix(time_of_day, fix)) => {
                self.waiting.push_back(Waiting::Fix { line, time_of_day, fix });
            }
            Err(reason) => self.waiting.push_back(Waiting::Fault(RowError::whole(line, &reason))),
        }
        Ok(true)
    }

    fn released(&self, waiting: Waiting) -> Result<FixRow, RowError> {
        match waiting {
            Waiting::Fault(fault) => Err(fault),
            Waiting::Fix { line, time_of_day, fix } => {
                let time = time_of_day.zip(self.dated).and_then(|(time, dated)| nearest(time, dated));
                FixRow::checked(line, time, None, fix, &self.time_bounds)
            }
        }
    }
}

/// The instant of a time of day that is nearest to a dated one: around midnight a fix may come
/// before the sentence that tells the new date.
fn nearest(time_of_day: Time, dated: Timestamp) -> Option<Timestamp> {
    let date = TimeZone::UTC.to_datetime(dated).date();
    let same_day = instant(date, time_of_day)?;
    let day = SignedDuration::from_hours(24);
    let candidates = [same_day.checked_sub(day).ok(), Some(same_day), same_day.checked_add(day).ok()];
    candidates.into_iter().flatten().min_by_key(|candidate| candidate.duration_since(dated).abs())
}

fn instant(date: Date, time: Time) -> Option<Timestamp> {
    TimeZone::UTC.to_timestamp(DateTime::from_parts(date, time)).ok()
}

/// What a line tells; blank lines and other sentences tell nothing.
fn told(text: &str) -> Result<Told, String> {
    let Some(sentence) = sentence_of(text) else { return Ok(Told::Nothing) };
    match nmea::parse_str(text) {
        Ok(ParseResult::GGA(gga)) => Ok(Told::Fix(time_of(gga.fix_time), fix_of(&gga)?)),
        Ok(ParseResult::RMC(rmc)) => Ok(date_of_rmc(&rmc).map_or(Told::Nothing, Told::Date)),
        Ok(ParseResult::ZDA(zda)) => Ok(date_of_zda(&zda).map_or(Told::Nothing, Told::Date)),
        Ok(_) => Ok(Told::Nothing),
        // Where there is no fix to lose, there is nothing to tell.
        Err(_) if sentence == Sentence::Dated => Ok(Told::Nothing),
        Err(nmea::Error::ChecksumMismatch { .. }) => Err("the sentence's checksum is wrong".to_owned()),
        Err(_) => Err("is not an NMEA 0183 sentence".to_owned()),
    }
}

#[derive(PartialEq, Eq)]
enum Sentence {
    /// GGA, or what is no sentence at all.
    Positioned,
    /// RMC or ZDA.
    Dated,
}

/// `$` or `!`, two letters of the talker, three of the sentence; `$P...` is a maker's own. `None`
/// for what need not be parsed.
fn sentence_of(text: &str) -> Option<Sentence> {
    let address = text.strip_prefix(['$', '!']).and_then(|rest| rest.split(',').next());
    let is_address = |address: &&str| {
        (4..=10).contains(&address.len()) && address.bytes().all(|byte| byte.is_ascii_alphanumeric())
    };
    let Some(address) = address.filter(is_address) else {
        return (!text.is_empty()).then_some(Sentence::Positioned);
    };
    let name = address.get(2..)?;
    if name == SentenceType::GGA.as_str() {
        return Some(Sentence::Positioned);
    }
    [SentenceType::RMC, SentenceType::ZDA]
        .iter()
        .any(|dated| name == dated.as_str())
        .then_some(Sentence::Dated)
}

/// The library's times and dates are those of another calendar library; their text is ISO 8601.
fn time_of(time: Option<impl ToString>) -> Option<Time> {
    time?.to_string().parse().ok()
}

/// A receiver that has no fix may tell any date.
fn date_of_rmc(rmc: &RmcData) -> Option<Timestamp> {
    let date = rmc.fix_date.filter(|_| rmc.status_of_fix != RmcStatusOfFix::Invalid)?;
    instant(date.to_string().parse().ok()?, time_of(rmc.fix_time)?)
}

fn date_of_zda(zda: &ZdaData) -> Option<Timestamp> {
    instant(zda.utc_date()?.to_string().parse().ok()?, time_of(zda.utc_time)?)
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
