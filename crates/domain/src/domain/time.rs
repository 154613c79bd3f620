//! Valid times of samples and observations, and their text format.

use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use jiff::{SignedDuration, Timestamp};

use super::error::{Error, Result};

/// The range of valid times: from 1980-01-06, the start of GPS time, to one day ahead of the server's
/// clock; for live items, to a few seconds ahead.
#[derive(Debug, Clone, Copy)]
pub struct TimeBounds {
    latest: Timestamp,
    ahead: SignedDuration,
}

impl TimeBounds {
    /// The start of GPS time, 1980-01-06T00:00:00Z, in seconds since 1970.
    const EARLIEST_S: i64 = 315_964_800;

    /// The bounds at a current time.
    #[must_use]
    pub fn at(now: Timestamp) -> Self {
        Self::ahead_of(now, SignedDuration::from_hours(24))
    }

    /// The bounds for live items, which may be `ahead_s` ahead of the server's clock. Times of the past
    /// may be of any year, for recordings are streamed too.
    #[must_use]
    pub fn live_at(now: Timestamp, ahead_s: u32) -> Self {
        Self::ahead_of(now, SignedDuration::from_secs(ahead_s.into()))
    }

    fn ahead_of(now: Timestamp, ahead: SignedDuration) -> Self {
        Self { latest: now.saturating_add(ahead).unwrap_or(Timestamp::MAX), ahead }
    }

    /// The same instant truncated to the microsecond, the resolution of stored times, if it is valid.
    ///
    /// # Errors
    /// Names the field `time` for an instant before GPS time or too far ahead.
    pub fn check(&self, time: Timestamp) -> Result<Timestamp> {
        if time.as_second() < Self::EARLIEST_S {
            return Err(Error::invalid("time", "must not be before 1980-01-06, the start of GPS time"));
        }
        if time > self.latest {
            return Err(Error::invalid("time", self.too_far_ahead()));
        }
        Ok(Timestamp::from_microsecond(time.as_microsecond()).unwrap_or(time))
    }

    fn too_far_ahead(&self) -> String {
        if self.ahead >= SignedDuration::from_hours(24) {
            return "must not be more than one day ahead of the server's clock".to_owned();
        }
        format!(
            "must not be more than {} s ahead of the server's clock; set the device's clock, or give the \
             receiver's clock_offset_s in the camera's profile",
            self.ahead.as_secs()
        )
    }
}

/// Parses RFC 3339 text with an offset: `2020-12-14T14:41:48+08:00`.
///
/// # Errors
/// Names the field `time` for text that is not such an instant, has no offset, names a leap second, or lies
/// outside of the years that can be represented.
pub fn parse_time(text: &str) -> Result<Timestamp> {
    let invalid = |message| Err(Error::invalid("time", message));
    if names_leap_second(text) {
        return invalid("has the second 60; a leap second is the second 59 or the next 0");
    }
    if text.len() > 19 && offset_hours(text).is_some_and(|hours| hours > 23) {
        return invalid("has an offset of more than 23:59 hours");
    }
    match text.parse() {
        Ok(time) => Ok(time),
        Err(_)
            if text.get(..19).is_some_and(|civil| civil.parse::<DateTime>().is_ok()) && has_offset(text) =>
        {
            invalid("is outside of the times that can be represented, which end in the year 9999")
        }
        Err(_) if local_time(text).is_some() => invalid(
            "has no offset from UTC; write it, as in 2020-12-14T14:41:48+08:00, or import the rows with `timezone`",
        ),
        Err(_) => invalid(
            "must be RFC 3339 with an offset, such as 2020-12-14T14:41:48+08:00 or 2020-12-14T06:41:48Z",
        ),
    }
}

/// A zone of the IANA time zone database, such as `Europe/Berlin`, or `UTC`.
///
/// # Errors
/// Names the field `timezone` for a name that the database does not have.
pub fn parse_time_zone(name: &str) -> Result<TimeZone> {
    TimeZone::get(name).map_err(|_| {
        let shown: String = name.chars().take(60).collect();
        Error::invalid("timezone", format!("`{shown}` is no IANA time zone, such as Europe/Berlin or UTC"))
    })
}

/// Parses text as [`parse_time`] does, and text without an offset (`2020-12-14 14:41:48`) as the local time of a zone.
///
/// # Errors
/// As [`parse_time`]; names the field `time` for a local time that the zone skips or has twice.
pub fn parse_time_in(text: &str, zone: &TimeZone) -> Result<Timestamp> {
    parse_time(text).or_else(|error| {
        let civil = local_time(text).ok_or(error)?;
        zone.to_ambiguous_timestamp(civil).unambiguous().map_err(|_| {
            let zone = zone.iana_name().unwrap_or("its time zone");
            let message =
                format!("{zone} skips this local time or has it twice; write the offset, such as +02:00");
            Error::invalid("time", message)
        })
    })
}

/// Text without an offset that names a date and time.
fn local_time(text: &str) -> Option<DateTime> {
    let is_local = !has_offset(text) && !names_leap_second(text);
    is_local.then(|| text.parse().ok()).flatten()
}

/// The hours of an offset at the end, such as `+08:00`.
fn offset_hours(text: &str) -> Option<u32> {
    let offset = text.get(text.len().checked_sub(6)?..)?;
    offset.strip_prefix(['+', '-'])?.get(..2)?.parse().ok()
}

/// The library takes a leap second for the second before it.
fn names_leap_second(text: &str) -> bool {
    text.get(16..19) == Some(":60")
}

fn has_offset(text: &str) -> bool {
    text.ends_with(['Z', 'z']) || offset_hours(text).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_times_are_those_of_their_zone() {
        let zone = parse_time_zone("Europe/Berlin").expect("a zone");
        let at = |text: &str| parse_time_in(text, &zone).map(|time| time.to_string());
        assert_eq!(at("2026-01-01 10:00:00").expect("winter"), "2026-01-01T09:00:00Z");
        assert_eq!(at("2026-07-01T10:00:00.5").expect("summer"), "2026-07-01T08:00:00.5Z");
        for offset in ["+05:00", "+0500", "+05"] {
            let time = at(&format!("2026-07-01T10:00:00{offset}"));
            assert_eq!(time.expect("an offset"), "2026-07-01T05:00:00Z");
        }
        for text in ["2026-03-29 02:30:00", "2026-10-25 02:30:00", "2026-12-31 23:59:60", "yesterday"] {
            at(text).expect_err(text);
        }
        parse_time_zone("Mars/Olympus").expect_err("no zone");
    }

    #[test]
    fn times_that_do_not_exist_are_refused_and_named() {
        for (text, message) in [
            ("2020-12-14T14:41:60Z", "second 60"),
            ("2020-12-14T14:41:60.5+08:00", "second 60"),
            ("2020-12-14T14:41:48+25:00", "offset"),
            ("2020-12-14T14:41:48-24:00", "offset"),
            ("9999-12-31T23:59:59Z", "9999"),
            ("2020-12-14T14:41:48", "`timezone`"),
            ("2020-13-14T14:41:48Z", "RFC 3339"),
            ("yesterday", "RFC 3339"),
            ("", "RFC 3339"),
            ("é2020-12-14T14:41:6", "RFC 3339"),
        ] {
            let refused = parse_time(text).expect_err(text).to_string();
            assert!(refused.starts_with("time: ") && refused.contains(message), "{text}: {refused}");
        }
        for text in ["2020-12-14T14:41:48+08:00", "2020-12-14T06:41:48Z", "2020-12-14T06:41:48.123456-23:59"]
        {
            assert!(parse_time(text).is_ok(), "{text}");
        }
    }
}
