//! Detections and fixes recorded apart, paired by time into samples.
//!
//! Each receiver is bound to a target and has a fixed clock offset ([`Receivers`]). Under
//! [`PairingRule::Nearest`] a fix and a box make a sample when each is the other's nearest within the
//! window, so no fix labels two boxes; under [`PairingRule::Interpolated`] every box between two
//! neighbouring fixes gets a fix of its own time. [`pair`] takes whole lists, [`Pairer`] a live stream in
//! bounded memory. Neither opens files nor reads clocks.

mod buffer;
mod outcome;
mod stream;

use std::str::FromStr;

use jiff::SignedDuration;

use crate::domain::{Detection, Error, Receivers, Result, Sample, StoredSample};

pub use self::outcome::{ItemOutcome, PairedItems, Released};
pub use self::stream::Pairer;
pub use crate::domain::ReceivedFix;

/// How a box finds its fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum PairingRule {
    /// Box and fix that are each other's nearest within the window.
    #[default]
    Nearest,
    /// The straight line between the fixes before and after the box.
    Interpolated,
}

impl PairingRule {
    /// Both of them.
    pub const ALL: [Self; 2] = [Self::Nearest, Self::Interpolated];

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Interpolated => "interpolate",
        }
    }
}

impl FromStr for PairingRule {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|rule| rule.as_str() == name)
            .ok_or_else(|| Error::invalid("method", "must be nearest or interpolate"))
    }
}

/// How to pair, and how much a live stream buffers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairingSettings {
    /// How a box finds its fix.
    pub rule: PairingRule,
    /// Box and fix are at most this far apart (nearest).
    pub window: SignedDuration,
    /// Fixes are joined by a line over at most this long a gap (interpolated).
    pub longest_gap: SignedDuration,
    /// On a stream, items this much earlier than the watermark still find their partner.
    pub allowed_lateness: SignedDuration,
    /// On a stream, items buffered per target and source; beyond, the target is decided early.
    pub items_per_target: usize,
    /// On a stream, targets buffered; beyond, the one without an item for longest is decided early.
    pub targets: usize,
}

impl Default for PairingSettings {
    /// Half a second: half the interval of the slowest common receivers, so that neighbours in time
    /// are never mistaken for partners.
    fn default() -> Self {
        Self {
            rule: PairingRule::Nearest,
            window: SignedDuration::from_millis(500),
            longest_gap: SignedDuration::from_millis(2_500),
            allowed_lateness: SignedDuration::from_secs(3),
            items_per_target: 512,
            targets: 1_024,
        }
    }
}

impl PairingSettings {
    /// The defaults but for what is given.
    ///
    /// # Errors
    /// Names `window_s` or `longest_gap_s` if it is not from 0.001 to 3600 s.
    pub fn new(rule: PairingRule, window_s: Option<f64>, longest_gap_s: Option<f64>) -> Result<Self> {
        let default = Self::default();
        let checked = |field: &str, seconds: Option<f64>, default: SignedDuration| match seconds {
            None => Ok(default),
            Some(seconds) if (0.001..=3_600.0).contains(&seconds) => {
                Ok(SignedDuration::from_secs_f64(seconds))
            }
            Some(_) => Err(Error::invalid(field, "must be a number of seconds from 0.001 to 3600")),
        };
        Ok(Self {
            rule,
            window: checked("window_s", window_s, default.window)?,
            longest_gap: checked("longest_gap_s", longest_gap_s, default.longest_gap)?,
            ..default
        })
    }
}

/// Numbers of boxes and fixes that did not become part of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Unpaired {
    /// Boxes without a partner.
    pub detections: u64,
    /// Number of these boxes whose nearest fix is nearer to another box (nearest).
    pub fix_claimed_by_nearer_box: u64,
    /// Fixes without a partner.
    pub fixes: u64,
    /// Boxes or fixes of a target and instant that was there already.
    pub duplicates: u64,
    /// Number of these that are fixes.
    pub duplicate_fixes: u64,
    /// Fixes that name no receiver.
    pub receiver_missing: u64,
}

/// Two recorded lists as training samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Paired {
    /// In order of time, then target.
    pub samples: Vec<Sample>,
    /// Boxes without a partner, in order of time, then target.
    pub unpaired_detections: Vec<Detection>,
    /// All that is part of no sample, counted.
    pub unpaired: Unpaired,
    /// Number of the boxes without a partner whose targets have no fix.
    pub detections_without_fixes: u64,
    /// Number of the fixes without a partner whose targets no box shows.
    pub fixes_without_detections: u64,
}

impl Paired {
    /// The samples in order of time, then target; with the boxes that found no fix, if they are kept.
    #[must_use]
    pub fn into_samples(self, keeps_unpaired: bool) -> Vec<StoredSample> {
        let mut samples: Vec<StoredSample> = self.samples.into_iter().map(Into::into).collect();
        if keeps_unpaired {
            samples.extend(self.unpaired_detections.into_iter().map(StoredSample::from));
            samples.sort_by(|one, other| (one.time, &one.target_id).cmp(&(other.time, &other.target_id)));
        }
        samples
    }
}

/// Pairs two recorded lists, in any order.
#[must_use]
pub fn pair(
    mut detections: Vec<Detection>,
    mut fixes: Vec<ReceivedFix>,
    receivers: &Receivers,
    settings: &PairingSettings,
) -> Paired {
    detections.sort_by_key(|detection| detection.time);
    fixes.sort_by_key(|fix| fix.time);
    let settings = PairingSettings { items_per_target: usize::MAX, targets: usize::MAX, ..*settings };
    let mut pairer = Pairer::new(settings);
    for detection in detections {
        pairer.insert_detection(detection, ());
    }
    for received in fixes {
        let Some(receiver_id) = &received.receiver_id else {
            pairer.unpaired.receiver_missing += 1;
            continue;
        };
        let (target_id, time) = receivers.resolve(receiver_id, received.time);
        pairer.insert_fix(&target_id, time, receivers.with_sigma(receiver_id, received.fix), ());
    }
    let (detections, fixes) = pairer.items_of_lone_sources();
    let PairedItems { samples, unpaired_detections, .. } = pairer.finish();
    Paired {
        samples,
        unpaired_detections,
        unpaired: pairer.unpaired,
        detections_without_fixes: detections as u64,
        fixes_without_detections: fixes as u64,
    }
}

#[cfg(test)]
mod tests;
