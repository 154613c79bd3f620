//! The GNSS receivers that targets carry: whose each is, and how far its clock is off.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};

use super::error::{Error, Result};
use super::names::{ReceiverId, TargetId};

/// What has to be added to a receiver's time to get the camera's: at most a day, to the microsecond.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct ClockOffset(SignedDuration);

impl ClockOffset {
    /// A day covers a receiver that writes local time as if it were UTC; more is a wrong date.
    const LARGEST_US: i64 = 86_400_000_000;
    /// Clocks agree.
    pub const ZERO: Self = Self(SignedDuration::ZERO);

    /// Rounds to the microsecond, which is what is stored.
    ///
    /// # Errors
    /// Refuses what is not finite or beyond a day; the field is named `clock_offset_s`.
    pub fn from_seconds(seconds: f64) -> Result<Self> {
        // What is not finite becomes 0 or the largest number, so it is looked at by itself.
        if seconds.is_finite() { Self::from_microseconds((seconds * 1e6).round() as i64) } else { refused() }
    }

    /// # Errors
    /// Refuses what is beyond a day; the field is named `clock_offset_s`.
    pub fn from_microseconds(microseconds: i64) -> Result<Self> {
        if (-Self::LARGEST_US..=Self::LARGEST_US).contains(&microseconds) {
            Ok(Self(SignedDuration::from_micros(microseconds)))
        } else {
            refused()
        }
    }

    /// Seconds.
    #[must_use]
    pub fn seconds(self) -> f64 {
        self.microseconds() as f64 / 1e6
    }

    /// Microseconds.
    #[must_use]
    pub fn microseconds(self) -> i64 {
        // Within a day, so it fits.
        self.0.as_micros() as i64
    }

    /// The camera's time of a receiver's.
    #[must_use]
    pub fn applied_to(self, time: Timestamp) -> Timestamp {
        time.saturating_add(self.0).unwrap_or(time)
    }
}

fn refused<T>() -> Result<T> {
    Err(Error::invalid("clock_offset_s", "must be a number of seconds from -86400 to 86400"))
}

/// Whose a receiver is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Receiver {
    /// The receiver.
    pub receiver_id: ReceiverId,
    /// The target that carries it.
    pub target_id: TargetId,
    /// Its clock against the camera's.
    pub clock_offset: ClockOffset,
}

impl Receiver {
    /// A receiver of which nothing is said: its id is the target's, and its clock is right.
    #[must_use]
    pub fn named(receiver_id: ReceiverId) -> Self {
        Self { target_id: TargetId::from(receiver_id.clone()), receiver_id, clock_offset: ClockOffset::ZERO }
    }
}

/// The receivers of a camera, each named once, in the order of their ids.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Receivers(BTreeMap<ReceiverId, Receiver>);

impl Receivers {
    /// Receivers that a camera may have.
    pub const MOST: usize = 1_024;

    /// # Errors
    /// Refuses more than [`Receivers::MOST`] and a receiver that stands twice; fields are named
    /// below `receivers`.
    pub fn new(receivers: impl IntoIterator<Item = Receiver>) -> Result<Self> {
        let mut named = BTreeMap::new();
        for (index, receiver) in receivers.into_iter().enumerate() {
            if index == Self::MOST {
                return Err(Error::invalid("receivers", format!("must be at most {}", Self::MOST)));
            }
            if named.insert(receiver.receiver_id.clone(), receiver).is_some() {
                let field = format!("receivers[{index}].receiver_id");
                return Err(Error::invalid(field, "stands twice; name each receiver once"));
            }
        }
        Ok(Self(named))
    }

    /// By receiver id.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Receiver> {
        self.0.values()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// What is said of a receiver.
    #[must_use]
    pub fn get(&self, receiver_id: &ReceiverId) -> Option<&Receiver> {
        self.0.get(receiver_id)
    }

    /// The receiver, if there is but one.
    #[must_use]
    pub fn only(&self) -> Option<&Receiver> {
        self.0.values().next().filter(|_| self.0.len() == 1)
    }

    /// Target and camera time of what a receiver sent at a time of its own clock. A receiver that
    /// is not named here carries its own id as target id.
    #[must_use]
    pub fn resolve(&self, receiver_id: &ReceiverId, time: Timestamp) -> (TargetId, Timestamp) {
        match self.0.get(receiver_id) {
            Some(receiver) => (receiver.target_id.clone(), receiver.clock_offset.applied_to(time)),
            None => (TargetId::from(receiver_id.clone()), time),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn receiver(name: &str) -> Receiver {
        Receiver::named(ReceiverId::new(name).expect("a name"))
    }

    #[test]
    fn an_offset_is_bounded_and_comes_back_as_it_was_given() {
        for seconds in [0.0, -18.0, 0.1, 1.000_001, 86_400.0, -86_400.0, 3.3, -0.7] {
            let offset = ClockOffset::from_seconds(seconds).expect("within a day");
            assert_eq!(offset.seconds().to_bits(), seconds.to_bits(), "{seconds}");
            assert_eq!(ClockOffset::from_microseconds(offset.microseconds()).expect("the same"), offset);
        }
        for seconds in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 86_400.001, -1e300] {
            let refused = ClockOffset::from_seconds(seconds).expect_err("no offset").to_string();
            assert!(refused.starts_with("clock_offset_s"), "{refused}");
        }
        assert!(ClockOffset::from_microseconds(i64::MIN).is_err());
    }

    #[test]
    fn receivers_are_named_once_and_not_too_many() {
        let twice = Receivers::new([receiver("b"), receiver("a"), receiver("b")]).expect_err("doubled");
        assert!(twice.to_string().starts_with("receivers[2].receiver_id"), "{twice}");
        let many = |count: usize| Receivers::new((0..count).map(|n| receiver(&n.to_string())));
        assert!(many(Receivers::MOST).is_ok());
        assert!(many(Receivers::MOST + 1).expect_err("too many").to_string().starts_with("receivers"));
        let two = Receivers::new([receiver("b"), receiver("a")]).expect("good");
        assert_eq!(two.iter().map(|it| it.receiver_id.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        assert_eq!((two.only(), two.is_empty()), (None, false));
        assert_eq!(Receivers::new([receiver("a")]).expect("good").only(), Some(&receiver("a")));
    }

    #[test]
    fn a_receiver_is_resolved_to_target_and_camera_time() {
        let time = Timestamp::from_second(1_000).expect("in range");
        let bound = Receiver {
            target_id: TargetId::new("person-1").expect("a name"),
            clock_offset: ClockOffset::from_seconds(-2.5).expect("small"),
            ..receiver("phone")
        };
        let receivers = Receivers::new([bound]).expect("good");
        let resolve = |name: &str| receivers.resolve(&ReceiverId::new(name).expect("a name"), time);
        let (target_id, at) = resolve("phone");
        assert_eq!((target_id.as_str(), at.as_millisecond()), ("person-1", 997_500));
        let (target_id, at) = resolve("other");
        assert_eq!((target_id.as_str(), at), ("other", time));
        let early = ClockOffset::from_seconds(-60.0).expect("small").applied_to(Timestamp::MIN);
        assert_eq!(early, Timestamp::MIN, "an instant cannot leave the calendar");
    }
}
