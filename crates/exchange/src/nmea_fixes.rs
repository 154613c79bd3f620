//! Fixes of an NMEA 0183 log.
//!
//! Positions are those of GGA, else of GNS, else of RMC, else of GLL: the first of these that the receiver sends, for they
//! say ever less of the quality. The date is that of RMC and ZDA, and standard deviations are those of GST. Other
//! sentences are skipped.

use std::collections::VecDeque;
use std::io::Read;

use jiff::civil::{Date, DateTime, Time};
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Timestamp};
use nmea::sentences::gns::parse_gns;
use nmea::sentences::rmc::RmcStatusOfFix;
use nmea::sentences::{FixType, GgaData, GllData, GnsData, GstData, RmcData, ZdaData};
use nmea::{NmeaSentence, ParseResult, parse_nmea_sentence};

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

/// A position with its time of day.
type TimedPosition = (Option<Time>, Fix);

/// Content of a line.
#[derive(Default)]
pub(super) struct SentenceContent {
    pub(super) date: Option<Timestamp>,
    /// Two where a sentence shows that the one before it counts.
    pub(super) fixes: Vec<TimedPosition>,
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
        let Some((line, text)) = self.lines.next_line().map_err(Error::fault)? else {
            let last = self.sentences.last_position();
            let line = self.lines.number();
            self.pending.extend(last.map(|(time_of_day, fix)| PendingRow::Fix { line, time_of_day, fix }));
            return Ok(false);
        };
        let content = match text {
            Line::Text(text) => self.sentences.content_of(text.trim()),
            Line::NotUtf8 => Err("is not UTF-8".to_owned()),
            Line::TooLong => Err("is longer than 64 KiB".to_owned()),
        };
        match content {
            Ok(SentenceContent { date, fixes }) => {
                self.dated_instant = date.or(self.dated_instant);
                for (time_of_day, fix) in fixes {
                    self.pending.push_back(PendingRow::Fix { line, time_of_day, fix });
                }
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

/// Sentences that contain positions, the one that says most of their quality first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum PositionKind {
    Gga,
    Gns,
    Rmc,
    Gll,
}

/// A position as a sentence states it.
struct StatedPosition {
    time: Option<Time>,
    longitude_deg: Option<f64>,
    latitude_deg: Option<f64>,
    /// `None` where the receiver does not say how it found the position.
    fix_type: Option<FixType>,
    hdop: Option<f32>,
}

/// The sentences of one receiver, in the order in which it sends them.
#[derive(Default)]
pub(super) struct Sentences {
    deviations: StatedDeviations<Solution>,
    /// The sentences whose positions are read.
    kind: Option<PositionKind>,
    /// A position of other sentences, which counts if the next of its kind comes before one of `kind`.
    held: Option<(PositionKind, TimedPosition)>,
}

impl Sentences {
    /// Parses a line; blank lines and other sentences have no content.
    pub(super) fn content_of(&mut self, text: &str) -> Result<SentenceContent, String> {
        let Some(sentence) = sentence_of(text) else { return Ok(SentenceContent::default()) };
        let parsed =
            if sentence == Sentence::Gns { gns_of(text) } else { nmea::parse_str(text).map_err(reason) };
        let (date, position) = match parsed {
            Ok(ParseResult::GGA(gga)) => (None, Some((PositionKind::Gga, position_of_gga(&gga)))),
            Ok(ParseResult::GNS(gns)) => (None, Some((PositionKind::Gns, position_of_gns(&gns)))),
            Ok(ParseResult::RMC(rmc)) => {
                (date_of_rmc(&rmc), Some((PositionKind::Rmc, position_of_rmc(&rmc))))
            }
            Ok(ParseResult::GLL(gll)) => (None, Some((PositionKind::Gll, position_of_gll(&gll)))),
            Ok(ParseResult::ZDA(zda)) => (date_of_zda(&zda), None),
            Ok(ParseResult::GST(gst)) => {
                self.take_deviations(&gst);
                (None, None)
            }
            Ok(_) => (None, None),
            // An invalid sentence without a position loses no fix.
            Err(_) if sentence == Sentence::Supplement => (None, None),
            Err(reason) => return Err(reason),
        };
        let fixes = position.map(|(kind, position)| self.fixes_of(kind, position)).transpose()?;
        Ok(SentenceContent { date, fixes: fixes.unwrap_or_default() })
    }

    /// The fixes that a position completes. What sentences of another kind than the one that is read refuse is no loss.
    fn fixes_of(
        &mut self,
        kind: PositionKind,
        position: Result<StatedPosition, String>,
    ) -> Result<Vec<TimedPosition>, String> {
        let is_read = kind == PositionKind::Gga || self.kind == Some(kind);
        let fix = position.and_then(|position| Ok((position.time, self.fix_of(&position)?)));
        let fix = match fix {
            Err(_) if !is_read => return Ok(Vec::new()),
            fix => fix?,
        };
        if is_read {
            (self.kind, self.held) = (Some(kind), None);
            return Ok(vec![fix]);
        }
        match self.held.take() {
            Some((held, earlier)) if held == kind => {
                self.kind = Some(kind);
                return Ok(vec![earlier, fix]);
            }
            Some(better) if better.0 < kind => self.held = Some(better),
            _ => self.held = Some((kind, fix)),
        }
        Ok(Vec::new())
    }

    /// The only position of a receiver that has sent one sentence with a position.
    fn last_position(&mut self) -> Option<TimedPosition> {
        self.held.take().filter(|_| self.kind.is_none()).map(|(_, position)| position)
    }

    fn take_deviations(&mut self, gst: &GstData) {
        let Some(time_of_day) = time_of(gst.time) else { return };
        let axes = gst.long_sd.zip(gst.lat_sd).or(gst.ellipse_semi_major_sd.zip(gst.ellipse_semi_minor_sd));
        let sigma = axes.and_then(|(one_m, other_m)| sigma_of_deviations(one_m.into(), other_m.into()));
        self.deviations.state(second_of_day(time_of_day), sigma);
    }

    fn fix_of(&mut self, stated: &StatedPosition) -> Result<Fix, String> {
        let solution = stated.fix_type.map(solution_of).transpose()?;
        let (Some(longitude_deg), Some(latitude_deg)) = (stated.longitude_deg, stated.latitude_deg) else {
            return Err("the sentence has no position".to_owned());
        };
        let time_of_day = stated.time.map(second_of_day).zip(solution);
        let deviations = time_of_day.and_then(|(at_s, solution)| self.deviations.of_fix(at_s, solution));
        let sigma = deviations.or_else(|| solution?.sigma(stated.hdop.map(f64::from)));
        wire::Fix { longitude_deg, latitude_deg, sigma_m: sigma.map(SigmaM::metres) }
            .to_domain()
            .map_err(|error| error.to_string())
    }
}

#[derive(PartialEq, Eq)]
enum Sentence {
    /// GGA, GLL, or text that is not a sentence.
    Position,
    Gns,
    /// RMC, ZDA or GST, which are read for their date or their deviations if they have no position.
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
    match address.get(2..)? {
        "GGA" => Some(Sentence::Position),
        "GNS" => Some(Sentence::Gns),
        "RMC" | "ZDA" | "GST" | "GLL" => Some(Sentence::Supplement),
        _ => None,
    }
}

fn reason(error: nmea::Error<'_>) -> String {
    match error {
        nmea::Error::ChecksumMismatch { .. } => "the sentence's checksum is wrong".to_owned(),
        _ => "is not an NMEA 0183 sentence".to_owned(),
    }
}

/// A GNS sentence. It has a letter of mode per satellite system, of which the parser takes at most two: it gets the first
/// system that is used.
fn gns_of(text: &str) -> Result<ParseResult, String> {
    let NmeaSentence { data, checksum, .. } = parse_nmea_sentence(text).map_err(reason)?;
    let sentence = parse_nmea_sentence(text).map_err(reason)?;
    if sentence.calc_checksum() != checksum {
        return Err("the sentence's checksum is wrong".to_owned());
    }
    let mut fields: Vec<&str> = data.split(',').collect();
    if let Some(modes) = fields.get_mut(5) {
        let used = modes.find(|mode| mode != 'N').unwrap_or(0);
        *modes = modes.get(used..used + 1).unwrap_or("N");
    }
    let data = fields.join(",");
    let gns = parse_gns(NmeaSentence { data: &data, ..sentence });
    gns.map(ParseResult::GNS).map_err(|_| "is not an NMEA 0183 sentence".to_owned())
}

fn position_of_gga(gga: &GgaData) -> Result<StatedPosition, String> {
    Ok(StatedPosition {
        time: time_of(gga.fix_time),
        longitude_deg: gga.longitude,
        latitude_deg: gga.latitude,
        fix_type: Some(gga.fix_type.unwrap_or(FixType::Invalid)),
        hdop: gga.hdop,
    })
}

fn position_of_gns(gns: &GnsData) -> Result<StatedPosition, String> {
    Ok(StatedPosition {
        time: time_of(gns.fix_time),
        longitude_deg: gns.lon,
        latitude_deg: gns.lat,
        fix_type: Some(gns.faa_modes.into()),
        hdop: gns.hdop,
    })
}

fn position_of_rmc(rmc: &RmcData) -> Result<StatedPosition, String> {
    if rmc.status_of_fix == RmcStatusOfFix::Invalid {
        return Err(NO_FIX.to_owned());
    }
    Ok(StatedPosition {
        time: time_of(rmc.fix_time),
        longitude_deg: rmc.lon,
        latitude_deg: rmc.lat,
        fix_type: rmc.faa_mode.map(FixType::from),
        hdop: None,
    })
}

fn position_of_gll(gll: &GllData) -> Result<StatedPosition, String> {
    if !gll.valid {
        return Err(NO_FIX.to_owned());
    }
    Ok(StatedPosition {
        time: time_of(gll.fix_time),
        longitude_deg: gll.longitude,
        latitude_deg: gll.latitude,
        fix_type: gll.faa_mode.map(FixType::from),
        hdop: None,
    })
}

const NO_FIX: &str = "the receiver had no fix";

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

fn solution_of(fix_type: FixType) -> Result<Solution, String> {
    match fix_type {
        FixType::Gps => Ok(Solution::Autonomous),
        FixType::DGps => Ok(Solution::Differential),
        FixType::Pps => Ok(Solution::Precise),
        FixType::Rtk => Ok(Solution::RtkFixed),
        FixType::FloatRtk => Ok(Solution::RtkFloat),
        FixType::Invalid => Err(format!("{NO_FIX} (quality 0)")),
        FixType::Estimated | FixType::Manual | FixType::Simulation => {
            let message =
                "the position is estimated, entered manually or simulated (quality 6 to 8), not measured";
            Err(message.to_owned())
        }
    }
}
