//! Valid times of samples and observations, and their text format.

use jiff::{SignedDuration, Timestamp};

use super::error::{Error, Result};

/// The range of valid times: from 1980-01-06, the start of GPS time, to one day ahead of the current
/// time.
#[derive(Debug, Clone, Copy)]
pub struct TimeBounds {
    latest: Timestamp,
}

impl TimeBounds {
    /// The start of GPS time, 1980-01-06T00:00:00Z, in seconds since 1970.
    const EARLIEST_S: i64 = 315_964_800;

    /// The bounds at a current time.
    #[must_use]
    pub fn at(now: Timestamp) -> Self {
        let latest = now.saturating_add(SignedDuration::from_hours(24)).unwrap_or(Timestamp::MAX);
        Self { latest }
    }

    /// The same instant truncated to the microsecond, the resolution of stored times, if it is valid.
    ///
    /// # Errors
    /// Names the field `time` for an instant before GPS time or more than a day ahead.
    pub fn check(&self, time: Timestamp) -> Result<Timestamp> {
        if time.as_second() < Self::EARLIEST_S {
            return Err(Error::invalid("time", "must not be before 1980-01-06, the start of GPS time"));
        }
        if time > self.latest {
            return Err(Error::invalid("time", "must not be more than one day ahead of the server's clock"));
        }
        Ok(Timestamp::from_microsecond(time.as_microsecond()).unwrap_or(time))
    }
}

/// Parses RFC 3339 text with an offset: `2020-12-14T14:41:48+08:00`.
///
/// # Errors
/// Names the field `time` for text that is not such an instant or has no offset.
pub fn parse_time(text: &str) -> Result<Timestamp> {
    text.parse().map_err(|_| {
        Error::invalid(
            "time",
            "must be RFC 3339 with an offset, such as 2020-12-14T14:41:48+08:00 or 2020-12-14T06:41:48Z",
        )
    })
}
