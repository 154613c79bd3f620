//! GNSS receivers: the targets that carry them, their clock offsets and their errors.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};

use super::error::{Error, Result};
use super::gnss_error::SigmaM;
use super::names::{ReceiverId, TargetId};
use super::observation::Fix;

/// The offset added to a receiver's time to get the camera's time: at most a day, to the microsecond.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct ClockOffset(SignedDuration);

impl ClockOffset {
    /// A day covers a receiver that reports local time as UTC; more is a wrong date.
    const MAX_US: i64 = 86_400_000_000;
    /// No offset.
    pub const ZERO: Self = Self(SignedDuration::ZERO);

    /// Rounds to the microsecond, the resolution of stored offsets.
    ///
    /// # Errors
    /// Refuses what is not finite or beyond a day; the field is named `clock_offset_s`.
    pub fn from_seconds(seconds: f64) -> Result<Self> {
        // The cast would turn NaN into 0.
        if seconds.is_finite() { Self::from_microseconds((seconds * 1e6).round() as i64) } else { refused() }
    }

    /// # Errors
    /// Refuses what is beyond a day; the field is named `clock_offset_s`.
    pub fn from_microseconds(microseconds: i64) -> Result<Self> {
        if (-Self::MAX_US..=Self::MAX_US).contains(&microseconds) {
            Ok(Self(SignedDuration::from_micros(microseconds)))
        } else {
            refused()
        }
    }

    /// The offset, s.
    #[must_use]
    pub fn seconds(self) -> f64 {
        self.microseconds() as f64 / 1e6
    }

    /// The offset, us.
    #[must_use]
    pub fn microseconds(self) -> i64 {
        // Within a day, so it fits.
        self.0.as_micros() as i64
    }

    /// The camera's time for a receiver's time.
    #[must_use]
    pub fn applied_to(self, time: Timestamp) -> Timestamp {
        time.saturating_add(self.0).unwrap_or(time)
    }
}

fn refused<T>() -> Result<T> {
    Err(Error::invalid("clock_offset_s", "must be a number of seconds from -86400 to 86400"))
}

/// A fix as sent by a receiver, with the receiver's own time.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceivedFix {
    /// Time by the receiver's clock.
    pub time: Timestamp,
    /// The receiver; a fix without one cannot be assigned to a target.
    pub receiver_id: Option<ReceiverId>,
    /// The fix.
    pub fix: Fix,
}

/// A receiver and the target that carries it.
#[derive(Debug, Clone, PartialEq)]
pub struct Receiver {
    /// Id of the receiver.
    pub receiver_id: ReceiverId,
    /// The target that carries it.
    pub target_id: TargetId,
    /// Offset of its clock.
    pub clock_offset: ClockOffset,
    /// Standard deviation per axis of its fixes that state none; that of the camera's profile if `None`.
    pub sigma: Option<SigmaM>,
}

impl Receiver {
    /// A receiver with defaults: its id is also the target id, its clock has no offset, and its error is the camera's.
    #[must_use]
    pub fn named(receiver_id: ReceiverId) -> Self {
        Self {
            target_id: TargetId::from(receiver_id.clone()),
            receiver_id,
            clock_offset: ClockOffset::ZERO,
            sigma: None,
        }
    }
}

/// The receivers of a camera, each once, ordered by id.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Receivers(BTreeMap<ReceiverId, Receiver>);

impl Receivers {
    /// Largest number of receivers of a camera.
    pub const MAX: usize = 1_024;

    /// # Errors
    /// Refuses more than [`Receivers::MAX`] and a duplicate receiver; fields are named below
    /// `receivers`.
    pub fn new(receivers: impl IntoIterator<Item = Receiver>) -> Result<Self> {
        let mut named = BTreeMap::new();
        for (index, receiver) in receivers.into_iter().enumerate() {
            if index == Self::MAX {
                return Err(Error::invalid("receivers", format!("must be at most {}", Self::MAX)));
            }
            if named.insert(receiver.receiver_id.clone(), receiver).is_some() {
                let field = format!("receivers[{index}].receiver_id");
                return Err(Error::invalid(field, "is a duplicate; name each receiver once"));
            }
        }
        Ok(Self(named))
    }

    /// In the order of receiver ids.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Receiver> {
        self.0.values()
    }

    /// True if there are no receivers.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The receiver with that id.
    #[must_use]
    pub fn get(&self, receiver_id: &ReceiverId) -> Option<&Receiver> {
        self.0.get(receiver_id)
    }

    /// The receiver, if there is exactly one.
    #[must_use]
    pub fn only(&self) -> Option<&Receiver> {
        self.0.values().next().filter(|_| self.0.len() == 1)
    }

    /// Target and camera time of a fix that a receiver sent at a time of its own clock. An unknown
    /// receiver has its own id as target id and no offset.
    #[must_use]
    pub fn resolve(&self, receiver_id: &ReceiverId, time: Timestamp) -> (TargetId, Timestamp) {
        match self.0.get(receiver_id) {
            Some(receiver) => (receiver.target_id.clone(), receiver.clock_offset.applied_to(time)),
            None => (TargetId::from(receiver_id.clone()), time),
        }
    }

    /// A receiver's fix with the error that is taken for it: what the fix states, else what is known of the receiver.
    #[must_use]
    pub fn with_sigma(&self, receiver_id: &ReceiverId, fix: Fix) -> Fix {
        let of_receiver = || self.0.get(receiver_id).and_then(|receiver| receiver.sigma);
        Fix { sigma_m: fix.sigma_m.or_else(of_receiver), ..fix }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn receiver(name: &str) -> Receiver {
        Receiver::named(ReceiverId::new(name).expect("a name"))
    }

    #[test]
    fn an_offset_is_bounded_and_exact() {
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
    fn receivers_are_unique_and_limited() {
        let twice = Receivers::new([receiver("b"), receiver("a"), receiver("b")]).expect_err("duplicate");
        assert!(twice.to_string().starts_with("receivers[2].receiver_id"), "{twice}");
        let many = |count: usize| Receivers::new((0..count).map(|n| receiver(&n.to_string())));
        assert!(many(Receivers::MAX).is_ok());
        assert!(many(Receivers::MAX + 1).expect_err("too many").to_string().starts_with("receivers"));
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
        assert_eq!(early, Timestamp::MIN, "saturates at the end of the calendar");
    }

    #[test]
    fn what_a_fix_states_wins_over_what_is_known_of_its_receiver() {
        let sigma = |metres: f64| Some(SigmaM::new(metres).expect("a sigma"));
        let receivers = Receivers::new([Receiver { sigma: sigma(0.5), ..receiver("rover") }]).expect("good");
        let position = crate::geo::Position::new(11.0, 48.0).expect("a position");
        let taken = |name: &str, sigma_m| {
            receivers.with_sigma(&ReceiverId::new(name).expect("a name"), Fix { position, sigma_m }).sigma_m
        };
        assert_eq!(taken("rover", sigma(3.0)), sigma(3.0));
        assert_eq!(taken("rover", None), sigma(0.5));
        assert_eq!(taken("other", None), None);
    }
}
