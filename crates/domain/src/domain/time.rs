//! Valid times of samples and observations, and their text format.

use jiff::civil::DateTime;
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
    // The library takes a leap second for the second before it.
    if text.get(16..19) == Some(":60") {
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
        Err(_) => invalid(
            "must be RFC 3339 with an offset, such as 2020-12-14T14:41:48+08:00 or 2020-12-14T06:41:48Z",
        ),
    }
}

/// The hours of an offset at the end, such as `+08:00`.
fn offset_hours(text: &str) -> Option<u32> {
    let offset = text.get(text.len().checked_sub(6)?..)?;
    offset.strip_prefix(['+', '-'])?.get(..2)?.parse().ok()
}

fn has_offset(text: &str) -> bool {
    text.ends_with(['Z', 'z']) || offset_hours(text).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_that_do_not_exist_are_refused_and_named() {
        for (text, message) in [
            ("2020-12-14T14:41:60Z", "second 60"),
            ("2020-12-14T14:41:60.5+08:00", "second 60"),
            ("2020-12-14T14:41:48+25:00", "offset"),
            ("2020-12-14T14:41:48-24:00", "offset"),
            ("9999-12-31T23:59:59Z", "9999"),
            ("2020-12-14T14:41:48", "RFC 3339"),
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
