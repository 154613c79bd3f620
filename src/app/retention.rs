//! Deletion of samples by their age, where the operator has chosen so.
//!
//! One wrong clock must not delete what everybody has stored: the clock is that of the database where there is one, and
//! nothing is deleted while it is far from the newest sample.

use std::fmt;

use jiff::{SignedDuration, Timestamp};

use super::samples::Samples;
use crate::clock::Clock;
use crate::domain::Result;
use crate::store::Store;

/// Farther from the newest sample a clock is not believed; nor beyond the age of what is to be deleted, so that a clock
/// never empties the store.
const BELIEVED: SignedDuration = SignedDuration::from_hours(7 * 24);

/// The outcome of the deletion of old samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Retention {
    /// Number of samples that were deleted.
    Deleted(u64),
    /// None was, for the clock is not believed.
    Refused(ClockDoubt),
}

/// A clock that is too far from the newest sample to delete by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockDoubt {
    now: Timestamp,
    newest_sample: Timestamp,
}

impl ClockDoubt {
    /// Returns the doubt if the clock is far from the newest sample, for samples up to `age` old; `None` otherwise.
    fn of(now: Timestamp, newest_sample: Timestamp, age: SignedDuration) -> Option<Self> {
        let is_far = now.duration_since(newest_sample).abs() > BELIEVED.min(age);
        is_far.then_some(Self { now, newest_sample })
    }
}

impl fmt::Display for ClockDoubt {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ahead = self.now.duration_since(self.newest_sample);
        let days = ahead.abs().as_secs_f64() / 86_400.0;
        let side = if ahead.is_negative() { "behind" } else { "ahead of" };
        let Self { now, newest_sample } = self;
        write!(out, "the clock shows {now:.0}, {days:.1} days {side} the newest sample ({newest_sample:.0})")
    }
}

/// Why no samples would be deleted by their age now; `None` also where the settings delete none.
///
/// # Errors
/// The store cannot be read.
pub async fn retention_doubt(store: &Store, clock: &Clock, sample_days: u32) -> Result<Option<ClockDoubt>> {
    if sample_days == 0 {
        return Ok(None);
    }
    let now = store.time(clock.now()).await?;
    let newest = store.newest_sample().await?;
    Ok(newest.and_then(|newest| ClockDoubt::of(now, newest, days(sample_days))))
}

fn days(days: u32) -> SignedDuration {
    SignedDuration::from_hours(24 * i64::from(days))
}

impl Samples<'_> {
    /// Deletes the samples that are older than `limits.sample_days`, and prepares the store for those of the time to come.
    ///
    /// # Errors
    /// The store cannot be read or written; the next call goes on.
    pub async fn retain(&self) -> Result<Retention> {
        let sample_days = self.limits.sample_days;
        let now = self.store.time(self.clock.now()).await?;
        let doubt = retention_doubt(self.store, self.clock, sample_days).await?;
        let is_wanted = sample_days > 0 && doubt.is_none();
        let since = is_wanted.then(|| now.checked_sub(days(sample_days)).ok()).flatten();
        let deleted = self.store.retain_samples(since, now).await?;
        self.metrics.retention_refused(doubt.is_some());
        Ok(doubt.map_or(Retention::Deleted(deleted), Retention::Refused))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_believed_near_the_newest_sample_alone() {
        let day = |day: i64| Timestamp::from_second(1_800_000_000 + day * 86_400).expect("in range");
        let is_believed = |now, age| ClockDoubt::of(day(now), day(0), days(age)).is_none();
        for (now, age, expected) in [
            (0, 30, true),
            (7, 30, true),
            (8, 30, false),
            (-7, 30, true),
            (-8, 30, false),
            (1, 1, true),
            (2, 1, false),
        ] {
            assert_eq!(is_believed(now, age), expected, "{now} days from the newest sample, {age} days kept");
        }
        let doubt = ClockDoubt::of(day(400), day(0), days(30)).expect("too far");
        assert!(doubt.to_string().contains("400.0 days ahead of the newest sample"), "{doubt}");
    }
}
