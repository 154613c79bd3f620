//! Valid times of samples and observations, and their text format.

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
/// Names the field `time` for text that is not such an instant or has no offset.
pub fn parse_time(text: &str) -> Result<Timestamp> {
    text.parse().map_err(|_| {
        Error::invalid(
            "time",
            "must be RFC 3339 with an offset, such as 2020-12-14T14:41:48+08:00 or 2020-12-14T06:41:48Z",
        )
    })
}
