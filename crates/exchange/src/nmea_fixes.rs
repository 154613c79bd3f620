//! Fixes of an NMEA 0183 log.
//!
//! Positions are those of GGA, which has their quality but only the time of day; the date is that of
//! RMC and ZDA, and standard deviations are those of GST. Other sentences are skipped.

use std::collections::VecDeque;
use std::io::Read;

use jiff::civil::{Date, DateTime, Time};
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Timestamp};
use nmea::sentences::rmc::RmcStatusOfFix;
use nmea::sentences::{FixType, GgaData, GstData, RmcData, ZdaData};
use nmea::{ParseResult, SentenceType};

use super::file_row::RowError;
use super::fix_quality::{Solution, StatedDeviations, sigma_of_deviations};
use super::fix_row::FixRow;
use super::lines::{Line, Lines};
use super::wire;
use crate::domain::{Error, Fix, Result, SigmaM, TimeBounds};

/// Rows buffered until the first date. Receivers send RMC or ZDA at least every few seconds; the fixes
/// of a file without a date have no time.
const MAX_PENDING: usize = 256;

/// Reads an NMEA log's fixes.
pub(super) struct NmeaFixes<R> {
    lines: Lines<R>,
    sentences: Sentences,
    time_bounds: TimeBounds,
    /// The latest instant with a date.
    dated_instant: Option<Timestamp>,
    /// In the order of the file; the first lacks a date.
    pending: VecDeque<PendingRow>,
}

enum PendingRow {
    Fix { line: u64, time_of_day: Option<Time>, fix: Fix },
    Invalid(RowError),
}

/// Content of a line.
pub(super) enum SentenceContent {
    Fix(Option<Time>, Fix),
    Date(Timestamp),
    None,
}

impl<R: Read> NmeaFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self {
            lines: Lines::new(reader),
            sentences: Sentences::default(),
            time_bounds,
            dated_instant: None,
            pending: VecDeque::new(),
        }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        loop {
            let is_full = self.pending.len() >= MAX_PENDING;
            let is_ready = self.dated_instant.is_some()
                || is_full
                || matches!(self.pending.front(), Some(PendingRow::Invalid(_)));
            if is_ready && let Some(first) = self.pending.pop_front() {
                return Some(Ok(self.resolve(first)));
            }
            match self.read_line() {
                Err(error) => return Some(Err(error)),
                Ok(true) => {}
                Ok(false) => return self.pending.pop_front().map(|first| Ok(self.resolve(first))),
            }
        }
    }

    /// Reads one line; `false` at the end of the file.
    fn read_line(&mut self) -> Result<bool> {
        let Some((line, text)) = self.lines.next_line().map_err(Error::fault)? else { return Ok(false) };
        let content = match text {
            Line::Text(text) => self.sentences.content_of(text.trim()),
            Line::NotUtf8 => Err("is not UTF-8".to_owned()),
            Line::TooLong => Err("is longer than 64 KiB".to_owned()),
        };
        match content {
            Ok(SentenceContent::None) => {}
            Ok(SentenceContent::Date(instant)) => self.dated_instant = Some(instant),
            Ok(SentenceContent::Fix(time_of_day, fix)) => {
                self.pending.push_back(PendingRow::Fix { line, time_of_day, fix });
            }
            Err(reason) => self.pending.push_back(PendingRow::Invalid(RowError::whole(line, &reason))),
        }
        Ok(true)
    }

    fn resolve(&self, row: PendingRow) -> Result<FixRow, RowError> {
        match row {
            PendingRow::Invalid(error) => Err(error),
            PendingRow::Fix { line, time_of_day, fix } => {
                let time = time_of_day
                    .zip(self.dated_instant)
                    .and_then(|(time, dated)| nearest_instant(time, dated));
                FixRow::checked(line, time, None, fix, &self.time_bounds)
            }
        }
    }
}

/// The instant with that time of day that is nearest to a dated instant: at midnight a fix may precede
/// the sentence with the new date.
pub(super) fn nearest_instant(time_of_day: Time, dated: Timestamp) -> Option<Timestamp> {
    let date = TimeZone::UTC.to_datetime(dated).date();
    let same_day = instant(date, time_of_day)?;
    let day = SignedDuration::from_hours(24);
    let candidates = [same_day.checked_sub(day).ok(), Some(same_day), same_day.checked_add(day).ok()];
    candidates.into_iter().flatten().min_by_key(|candidate| candidate.duration_since(dated).abs())
}

fn instant(date: Date, time: Time) -> Option<Timestamp> {
    TimeZone::UTC.to_timestamp(DateTime::from_parts(date, time)).ok()
}

/// The sentences of one receiver, in the order in which it sends them.
#[derive(Default)]
pub(super) struct Sentences {
    deviations: StatedDeviations<Solution>,
}

impl Sentences {
    /// Parses a line; blank lines and other sentences have no content.
    pub(super) fn content_of(&mut self, text: &str) -> Result<SentenceContent, String> {
        let Some(sentence) = sentence_of(text) else { return Ok(SentenceContent::None) };
        match nmea::parse_str(text) {
            Ok(ParseResult::GGA(gga)) => Ok(SentenceContent::Fix(time_of(gga.fix_time), self.fix_of(&gga)?)),
            Ok(ParseResult::GST(gst)) => {
                self.take_deviations(&gst);
                Ok(SentenceContent::None)
            }
            Ok(ParseResult::RMC(rmc)) => {
                Ok(date_of_rmc(&rmc).map_or(SentenceContent::None, SentenceContent::Date))
            }
            Ok(ParseResult::ZDA(zda)) => {
                Ok(date_of_zda(&zda).map_or(SentenceContent::None, SentenceContent::Date))
            }
            Ok(_) => Ok(SentenceContent::None),
            // An invalid sentence without a position loses no fix.
            Err(_) if sentence == Sentence::Supplement => Ok(SentenceContent::None),
            Err(nmea::Error::ChecksumMismatch { .. }) => Err("the sentence's checksum is wrong".to_owned()),
            Err(_) => Err("is not an NMEA 0183 sentence".to_owned()),
        }
    }

    fn take_deviations(&mut self, gst: &GstData) {
        let Some(time_of_day) = time_of(gst.time) else { return };
        let axes = gst.long_sd.zip(gst.lat_sd).or(gst.ellipse_semi_major_sd.zip(gst.ellipse_semi_minor_sd));
        let sigma = axes.and_then(|(one_m, other_m)| sigma_of_deviations(one_m.into(), other_m.into()));
        self.deviations.state(second_of_day(time_of_day), sigma);
    }

    fn fix_of(&mut self, gga: &GgaData) -> Result<Fix, String> {
        let solution = solution_of(gga)?;
        let (Some(longitude_deg), Some(latitude_deg)) = (gga.longitude, gga.latitude) else {
            return Err("the sentence has no position".to_owned());
        };
        let time_of_day = time_of(gga.fix_time).map(second_of_day);
        let stated = time_of_day.and_then(|at_s| self.deviations.of_fix(at_s, solution));
        let sigma = stated.or_else(|| solution.sigma(gga.hdop.map(f64::from)));
        wire::Fix { longitude_deg, latitude_deg, sigma_m: sigma.map(SigmaM::metres) }
            .to_domain()
            .map_err(|error| error.to_string())
    }
}

#[derive(PartialEq, Eq)]
enum Sentence {
    /// GGA, or text that is not a sentence.
    Position,
    /// RMC or ZDA, which have the date, or GST.
    Supplement,
}

/// Kind of a sentence by its address: `$` or `!`, two letters of the talker, three of the sentence;
/// `$P...` is proprietary. `None` for sentences that need not be parsed.
fn sentence_of(text: &str) -> Option<Sentence> {
    let address = text.strip_prefix(['$', '!']).and_then(|rest| rest.split(',').next());
    let is_address = |address: &&str| {
        (4..=10).contains(&address.len()) && address.bytes().all(|byte| byte.is_ascii_alphanumeric())
    };
    let Some(address) = address.filter(is_address) else {
        return (!text.is_empty()).then_some(Sentence::Position);
    };
    let name = address.get(2..)?;
    if name == SentenceType::GGA.as_str() {
        return Some(Sentence::Position);
    }
    [SentenceType::RMC, SentenceType::ZDA, SentenceType::GST]
        .iter()
        .any(|supplement| name == supplement.as_str())
        .then_some(Sentence::Supplement)
}

/// Converts the parser's times, which are of another calendar library, by their ISO 8601 text.
fn time_of(time: Option<impl ToString>) -> Option<Time> {
    time?.to_string().parse().ok()
}

/// The date of an RMC sentence; it is undefined while the receiver has no fix.
fn date_of_rmc(rmc: &RmcData) -> Option<Timestamp> {
    let date = rmc.fix_date.filter(|_| rmc.status_of_fix != RmcStatusOfFix::Invalid)?;
    instant(date.to_string().parse().ok()?, time_of(rmc.fix_time)?)
}

fn date_of_zda(zda: &ZdaData) -> Option<Timestamp> {
    instant(zda.utc_date()?.to_string().parse().ok()?, time_of(zda.utc_time)?)
}

fn second_of_day(time: Time) -> f64 {
    time.duration_since(Time::midnight()).as_secs_f64()
}

fn solution_of(gga: &GgaData) -> Result<Solution, String> {
    Ok(match gga.fix_type {
        Some(FixType::Gps) => Solution::Autonomous,
        Some(FixType::DGps) => Solution::Differential,
        Some(FixType::Pps) => Solution::Precise,
        Some(FixType::Rtk) => Solution::RtkFixed,
        Some(FixType::FloatRtk) => Solution::RtkFloat,
        None | Some(FixType::Invalid) => return Err("the receiver had no fix (quality 0)".to_owned()),
        Some(FixType::Estimated | FixType::Manual | FixType::Simulation) => {
            return Err(
                "the position is estimated, entered manually or simulated (quality 6 to 8), not measured"
                    .to_owned(),
            );
        }
    })
}
