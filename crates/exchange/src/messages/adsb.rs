//! Positions of aircraft (ADS-B): lines of a BaseStation port (`MSG,...`, port 30003), and the JSON of dump1090 and readsb:
//! `aircraft.json` whole, or one aircraft per line (`--net-json-port`).
//!
//! The receiver is the 24-bit address, in upper case. Lines have the civil time of the machine that decodes them, without
//! an offset from UTC: it is the multiple of a quarter of an hour that brings the time nearest to the server's.
//! `nac_p` (DO-260B, table A-13) bounds the position in 95 of 100 cases.

use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Timestamp};
use serde::Deserialize;

use super::{MessageContext, MessageDecoder, MessageItem, Reading, ReportedFix, parse};
use crate::domain::SigmaM;
use crate::fix_quality::sigma_of_radius_95;
use crate::unix_time::unix_time;

pub(super) struct Adsb;

/// The document, or a line of one aircraft.
#[derive(Deserialize)]
struct Report {
    /// Seconds since 1970.
    now: f64,
    aircraft: Option<Vec<Aircraft>>,
    #[serde(flatten)]
    single: Option<Aircraft>,
}

#[derive(Deserialize)]
struct Aircraft {
    hex: String,
    lat: Option<f64>,
    lon: Option<f64>,
    /// Age of the position, s.
    seen_pos: Option<f64>,
    nac_p: Option<u8>,
}

impl MessageDecoder for Adsb {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let mut reading = Reading::default();
        if payload.trim_ascii_start().starts_with(b"{") {
            let Report { now, aircraft, single } = parse(payload)?;
            for aircraft in aircraft.into_iter().flatten().chain(single) {
                if let Some(fix) = aircraft.item(now, context).transpose() {
                    reading.take(fix);
                }
            }
            return Ok(reading);
        }
        let text = std::str::from_utf8(payload).map_err(|_| "is not UTF-8".to_owned())?;
        for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
            if let Some(fix) = line_item(line, context).transpose() {
                reading.take(fix);
            }
        }
        Ok(reading)
    }
}

impl Aircraft {
    /// Its position, if it states one.
    fn item(&self, now_s: f64, context: &MessageContext<'_>) -> Result<Option<MessageItem>, String> {
        let Some((longitude_deg, latitude_deg)) = self.lon.zip(self.lat) else { return Ok(None) };
        let fix = ReportedFix {
            time: unix_time(now_s - self.seen_pos.unwrap_or(0.0))?,
            receiver: Some(&self.hex.to_ascii_uppercase()),
            longitude_deg,
            latitude_deg,
            sigma: self.nac_p.and_then(sigma_of_category),
        };
        fix.checked(context).map(MessageItem::Fix).map(Some)
    }
}

/// The sigma of a navigation accuracy category for position.
fn sigma_of_category(category: u8) -> Option<SigmaM> {
    const NAUTICAL_MILE_M: f64 = 1_852.0;
    let radius_95_m = match category {
        11 => 3.0,
        10 => 10.0,
        9 => 30.0,
        8 => 0.05 * NAUTICAL_MILE_M,
        7 => 0.1 * NAUTICAL_MILE_M,
        6 => 0.3 * NAUTICAL_MILE_M,
        5 => 0.5 * NAUTICAL_MILE_M,
        4 => NAUTICAL_MILE_M,
        3 => 2.0 * NAUTICAL_MILE_M,
        2 => 4.0 * NAUTICAL_MILE_M,
        1 => 10.0 * NAUTICAL_MILE_M,
        _ => return None,
    };
    sigma_of_radius_95(radius_95_m)
}

/// The position of a line; `None` for a message without one.
fn line_item(line: &str, context: &MessageContext<'_>) -> Result<Option<MessageItem>, String> {
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    if matches!(fields[0], "SEL" | "ID" | "AIR" | "STA" | "CLK") {
        return Ok(None);
    }
    if fields[0] != "MSG" || fields.len() < 16 {
        return Err("is neither a line of a BaseStation port nor JSON of dump1090 or readsb".to_owned());
    }
    if fields[14].is_empty() || fields[15].is_empty() {
        return Ok(None);
    }
    let degrees = |text: &str| text.parse().map_err(|_| format!("`{text:.40}` is not a number of degrees"));
    let fix = ReportedFix {
        time: nearest_zone(fields[6], fields[7], context.received_at)?,
        receiver: Some(&fields[4].to_ascii_uppercase()),
        longitude_deg: degrees(fields[15])?,
        latitude_deg: degrees(fields[14])?,
        sigma: None,
    };
    fix.checked(context).map(MessageItem::Fix).map(Some)
}

/// The instant of a civil time whose offset from UTC is not known.
fn nearest_zone(date: &str, time: &str, received_at: Timestamp) -> Result<Timestamp, String> {
    const QUARTER_S: f64 = 900.0;
    /// The largest offset of a time zone: they go from -12 to +14 hours.
    const LARGEST_OFFSET_S: f64 = 50_400.0;
    let text = format!("{}T{time}", date.replace('/', "-"));
    let civil: DateTime =
        text.parse().map_err(|_| format!("`{date:.40} {time:.40}` is no date with a time"))?;
    let utc = TimeZone::UTC.to_timestamp(civil).map_err(|error| error.to_string())?;
    let offset_s = (received_at.duration_since(utc).as_secs_f64() / QUARTER_S).round() * QUARTER_S;
    if offset_s.abs() > LARGEST_OFFSET_S {
        return Err(
            "is of another day by every time zone; set the clock of the machine that decodes".to_owned()
        );
    }
    utc.checked_add(SignedDuration::from_secs(offset_s as i64)).map_err(|error| error.to_string())
}
