//! Hours of UTC, by which files are divided.

use jiff::Timestamp;

use crate::domain::{Error, Result};

const SECONDS: i64 = 3_600;

/// An hour of UTC: full hours since 1970.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Hour(i64);

impl Hour {
    /// The hour that an instant is in.
    pub(crate) fn of(time: Timestamp) -> Self {
        // Truncated to seconds, an instant before 1970 is rounded up.
        let second = time.as_second() - i64::from(time.subsec_nanosecond() < 0);
        Self(second.div_euclid(SECONDS))
    }

    /// Its first instant.
    pub(crate) fn start(self) -> Result<Timestamp> {
        Timestamp::from_second(self.0 * SECONDS).map_err(Error::fault)
    }

    /// The hour after it.
    pub(crate) const fn next(self) -> Self {
        Self(self.0 + 1)
    }

    /// Its folder within that of a scope, such as `2026-11-24/07`.
    pub(crate) fn folder(self) -> Result<String> {
        Ok(self.start()?.strftime("%Y-%m-%d/%H").to_string())
    }

    /// The hour of a day's and an hour's folder; `None` for other folders.
    pub(crate) fn of_folder(day: &str, hour: &str) -> Option<Self> {
        let start: Timestamp = format!("{day}T{hour}:00:00Z").parse().ok()?;
        Some(Self::of(start))
    }
}
