//! Sequence fusion: where one target is, from all that was measured of it so far.
//!
//! A [`Track`] holds position, velocity, a slowly changing bias of the receiver and one of the
//! camera's model (METHOD "Sequence fusion"). Fixes and regressed positions come with their error
//! variances, together or apart, late or never; what lies beyond the gate is rejected with a reason,
//! which is data and not an error. What never happens here: clocks, I/O, pixels, degrees; and the
//! same items in another order within the window give the same state to the last bit.

mod bank;
mod learnt;
mod noise;
mod settings;
#[cfg(test)]
pub(in crate::fusion) mod simulated;
#[cfg(test)]
mod tests;

use std::cmp::Ordering;
use std::collections::VecDeque;

use jiff::Timestamp;

pub use learnt::{Pass, passes};
pub use noise::{GnssNoiseEstimate, ResidualAt, estimate_gnss_noise};
pub use settings::{GnssNoise, Motion, RegressionNoise, TrackSettings};

use self::bank::{Bank, Judgement};
use super::plane_covariance::PlaneCovariance;
use crate::geo::EastNorth;

/// Items between two stored states: what a late item costs at most, beside those behind it.
const CHECKPOINT_ITEMS: usize = 8;

/// A position with the covariance of its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Where, in the camera's plane.
    pub position: EastNorth,
    /// Covariance of the error, bias included, m2.
    pub covariance: PlaneCovariance,
}

impl Measured {
    /// A position whose error has the same variance in every direction: sigma squared of a fix,
    /// or `e_regression_m2`.
    #[must_use]
    pub const fn isotropic(position: EastNorth, variance_m2: f64) -> Self {
        Self { position, covariance: PlaneCovariance::isotropic(variance_m2) }
    }
}

/// What was measured at one instant; either half may be missing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// When.
    pub time: Timestamp,
    /// The receiver's fix.
    pub fix: Option<Measured>,
    /// The position regressed from the box.
    pub regressed: Option<Measured>,
}

/// Where a measured position came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Source {
    /// The box, through the camera's model.
    Regressed,
    /// The receiver.
    Fix,
}

impl Source {
    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Regressed => "regressed",
            Self::Fix => "fix",
        }
    }
}

/// Why a measured position was not taken up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RejectionReason {
    /// Too far from where the track expects it, by the chi-square gate.
    OutsideGate,
    /// Older than the window of late items.
    TooLate,
    /// The same source has spoken for this instant before.
    Duplicate,
    /// Its covariance is not positive.
    UnusableVariance,
    /// Farther than 20 km from the origin of the track's plane.
    OutOfRange,
}

impl RejectionReason {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::OutsideGate, Self::TooLate, Self::Duplicate, Self::UnusableVariance, Self::OutOfRange];

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::OutsideGate => "outside_gate",
            Self::TooLate => "too_late",
            Self::Duplicate => "duplicate",
            Self::UnusableVariance => "unusable_variance",
            Self::OutOfRange => "out_of_range",
        }
    }
}

/// A measured position that was not taken up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rejection {
    /// Which half of the measurement.
    pub source: Source,
    /// Why.
    pub reason: RejectionReason,
    /// Squared Mahalanobis length of its innovation, where one was computed.
    pub nis: Option<f64>,
}

/// What one update says of the filter's consistency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// Which half of the measurement.
    pub source: Source,
    /// Measured less expected.
    pub difference: EastNorth,
    /// Squared Mahalanobis length of the difference: chi-square of 2 degrees, mean 2, for a
    /// consistent filter.
    pub nis: f64,
}

/// A velocity in the camera's plane.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Velocity {
    /// Towards east, m/s.
    pub east_m_s: f64,
    /// Towards north, m/s.
    pub north_m_s: f64,
}

impl Velocity {
    /// m/s along the direction of motion.
    #[must_use]
    pub fn speed_m_s(self) -> f64 {
        self.east_m_s.hypot(self.north_m_s)
    }
}

/// What a track says of its target at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackState {
    /// When.
    pub time: Timestamp,
    /// Where.
    pub position: EastNorth,
    /// How fast and where to.
    pub velocity: Velocity,
    /// Covariance of the position's error, m2.
    pub covariance: PlaneCovariance,
    /// Radius about `position` that holds the truth with 95 % probability, m.
    pub r95_m: f64,
    /// Probability that the target stands, 0 to 1.
    pub still: f64,
    /// NIS of what the latest measurement brought, summed over the halves taken up (2 degrees each).
    pub nis: Option<f64>,
    /// The innovations taken up, one per half.
    pub innovations: Vec<Innovation>,
    /// The halves not taken up.
    pub rejected: Vec<Rejection>,
    /// Whether the track began anew at this measurement, because it had contradicted all it was
    /// told for a while.
    pub restarted: bool,
}

/// One item of the window, with the state after it now and then.
#[derive(Debug, Clone)]
struct Entry {
    measurement: Measurement,
    checkpoint: Option<Box<Bank>>,
}

/// The sequence fusion of one target.
#[derive(Debug, Clone)]
pub struct Track {
    settings: TrackSettings,
    /// The state before the first entry.
    base: Box<Bank>,
    entries: VecDeque<Entry>,
    now: Box<Bank>,
    first: Measurement,
}

impl Track {
    /// A track from the first measurement of its target; `None` if that has neither a usable fix
    /// nor a usable regressed position.
    #[must_use]
    pub fn start(settings: TrackSettings, first: &Measurement) -> Option<Self> {
        let usable = |measured: Option<Measured>| measured.filter(|it| it.covariance.is_positive());
        let (source, measured, rest) = match (usable(first.regressed), usable(first.fix)) {
            (Some(regressed), fix) => (Source::Regressed, regressed, fix),
            (None, Some(fix)) => (Source::Fix, fix, None),
            (None, None) => return None,
        };
        let mut bank = Bank::start(&settings, first.time, source, measured);
        if rest.is_some() {
            bank.step(&settings, &Measurement { time: first.time, fix: rest, regressed: None });
        }
        let base = Box::new(bank);
        Some(Self { settings, now: base.clone(), base, entries: VecDeque::new(), first: *first })
    }

    /// When the target was measured first.
    #[must_use]
    pub const fn started_at(&self) -> Timestamp {
        self.first.time
    }

    /// When the target was measured last.
    #[must_use]
    pub fn measured_at(&self) -> Timestamp {
        self.now.time
    }

    /// Whether the target has not been measured for longer than its time to live.
    #[must_use]
    pub fn is_gone(&self, at: Timestamp) -> bool {
        at.duration_since(self.now.time).as_secs_f64() > self.settings.time_to_live_s
    }

    /// The beliefs in force.
    #[must_use]
    pub const fn settings(&self) -> &TrackSettings {
        &self.settings
    }

    /// Takes up a measurement, late ones at their place in time, and says where the target is at
    /// the latest instant measured.
    pub fn update(&mut self, measurement: &Measurement) -> TrackState {
        let (measurement, mut rejected) = self.admit(measurement);
        if measurement.fix.is_none() && measurement.regressed.is_none() {
            return self.state(&[None, None], rejected);
        }
        let place = self.entries.partition_point(|entry| precedes(&entry.measurement, &measurement));
        self.entries.insert(place, Entry { measurement, checkpoint: None });
        let judgements = if place + 1 == self.entries.len() {
            let judgements = self.now.step(&self.settings, &measurement);
            self.keep(place);
            judgements
        } else {
            self.refilter(place)
        };
        self.shrink();
        for judgement in judgements.iter().flatten() {
            if let Some(reason) = judgement.rejected {
                let nis = judgement.nis.is_finite().then_some(judgement.nis);
                rejected.push(Rejection { source: judgement.source, reason, nis });
            }
        }
        self.state(&judgements, rejected)
    }

    /// What the track says of another instant: foretold beyond the latest measurement, as then
    /// filtered within the window, and as at the window's beginning before that.
    #[must_use]
    pub fn state_at(&self, time: Timestamp) -> TrackState {
        let mut bank = if time >= self.now.time {
            (*self.now).clone()
        } else {
            let end = self.entries.partition_point(|entry| entry.measurement.time <= time);
            let (mut bank, begin) = self.resume(end);
            for entry in self.entries.range(begin..end) {
                bank.step(&self.settings, &entry.measurement);
            }
            bank
        };
        bank.predict(&self.settings, time);
        describe(&bank)
    }

    /// The measurement without what the window refuses, and the refusals.
    fn admit(&self, measurement: &Measurement) -> (Measurement, Vec<Rejection>) {
        let mut rejected = Vec::new();
        let mut admitted = *measurement;
        let age_s = self.now.time.duration_since(measurement.time).as_secs_f64();
        let forgotten = match measurement.time.cmp(&self.base.time) {
            Ordering::Less => true,
            // Whether a source has spoken at that instant is known of the very first one alone.
            Ordering::Equal => measurement.time != self.first.time,
            Ordering::Greater => false,
        };
        let too_late = age_s > self.settings.window_s || forgotten;
        for source in [Source::Regressed, Source::Fix] {
            let half = match source {
                Source::Regressed => &mut admitted.regressed,
                Source::Fix => &mut admitted.fix,
            };
            let Some(measured) = half else { continue };
            let reason = if too_late {
                RejectionReason::TooLate
            } else if !measured.covariance.is_positive() {
                RejectionReason::UnusableVariance
            } else if self.has_heard(measurement.time, source) {
                RejectionReason::Duplicate
            } else {
                continue;
            };
            *half = None;
            rejected.push(Rejection { source, reason, nis: None });
        }
        (admitted, rejected)
    }

    fn has_heard(&self, time: Timestamp, source: Source) -> bool {
        let begin = self.entries.partition_point(|entry| entry.measurement.time < time);
        self.entries
            .range(begin..)
            .map(|entry| &entry.measurement)
            .take_while(|measurement| measurement.time == time)
            .chain((self.first.time == time).then_some(&self.first))
            .any(|measurement| match source {
                Source::Regressed => measurement.regressed.is_some(),
                Source::Fix => measurement.fix.is_some(),
            })
    }

    /// The latest stored state before an entry, and the first entry that it has not seen.
    fn resume(&self, before: usize) -> (Bank, usize) {
        (0..before)
            .rev()
            .find_map(|index| Some(((**self.entries[index].checkpoint.as_ref()?).clone(), index + 1)))
            .unwrap_or_else(|| ((*self.base).clone(), 0))
    }

    /// Filters anew from an inserted entry on, and returns what became of that entry.
    fn refilter(&mut self, place: usize) -> [Option<Judgement>; 2] {
        let (bank, begin) = self.resume(place);
        *self.now = bank;
        let mut judgements = [None, None];
        for index in begin..self.entries.len() {
            let stepped = self.now.step(&self.settings, &self.entries[index].measurement);
            if index == place {
                judgements = stepped;
            }
            self.entries[index].checkpoint = None;
            self.keep(index);
        }
        judgements
    }

    /// Stores the state after an entry if none was stored for a while.
    fn keep(&mut self, index: usize) {
        let begin = (index + 1).saturating_sub(CHECKPOINT_ITEMS);
        let recent = self.entries.range(begin..index).any(|entry| entry.checkpoint.is_some());
        if !recent && index + 1 >= CHECKPOINT_ITEMS {
            self.entries[index].checkpoint = Some(self.now.clone());
        }
    }

    /// Forgets what lies before the window, up to a stored state.
    fn shrink(&mut self) {
        let window_s = self.settings.window_s;
        loop {
            let Some(index) = self.entries.iter().position(|entry| entry.checkpoint.is_some()) else {
                return;
            };
            let age_s = self.now.time.duration_since(self.entries[index].measurement.time).as_secs_f64();
            let crowded = self.entries.len() > self.settings.window_items.max(2 * CHECKPOINT_ITEMS);
            if age_s <= window_s && !crowded {
                return;
            }
            if let Some(checkpoint) = self.entries[index].checkpoint.take() {
                self.base = checkpoint;
            }
            self.entries.drain(..=index);
        }
    }

    fn state(&self, judgements: &[Option<Judgement>; 2], rejected: Vec<Rejection>) -> TrackState {
        let mut state = describe(&self.now);
        let taken = judgements.iter().flatten().filter(|it| it.rejected.is_none());
        state.innovations = taken
            .clone()
            .filter(|it| !it.restarted)
            .map(|it| Innovation { source: it.source, difference: it.innovation, nis: it.nis })
            .collect();
        state.restarted = taken.clone().any(|it| it.restarted);
        state.nis = (!state.innovations.is_empty()).then(|| state.innovations.iter().map(|it| it.nis).sum());
        state.rejected = rejected;
        state
    }
}

/// The order of the window: by time, and at one instant the box before the fix, so that the order
/// of arrival leaves no trace.
fn precedes(earlier: &Measurement, later: &Measurement) -> bool {
    let rank = |measurement: &Measurement| u8::from(measurement.regressed.is_none());
    (earlier.time, rank(earlier)) <= (later.time, rank(later))
}

fn describe(bank: &Bank) -> TrackState {
    let belief = bank.belief();
    TrackState {
        time: bank.time,
        position: belief.position,
        velocity: Velocity { east_m_s: belief.velocity[0], north_m_s: belief.velocity[1] },
        covariance: belief.covariance,
        r95_m: belief.covariance.r95_m(),
        still: belief.still,
        nis: None,
        innovations: Vec::new(),
        rejected: Vec::new(),
        restarted: false,
    }
}
