//! The boxes and fixes of one target in order of time, and which of them are partners.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};

use super::outcome::{ItemOutcome, PairedItems, Released};
use super::{PairingRule, PairingSettings, Unpaired};
use crate::domain::{Detection, Fix, Sample};
use crate::geo::{EastNorth, LocalPlane};

/// A run of items of one source at least this long, without one of the other, makes the other idle: it no
/// longer holds the watermark back.
const IDLE_AFTER_ITEMS: u32 = 64;

/// The items of one target that may still find a partner.
#[derive(Debug, Clone)]
pub(super) struct TargetBuffer<T> {
    pub(super) detections: VecDeque<Buffered<Detection, T>>,
    pub(super) fixes: VecDeque<Buffered<Fix, T>>,
    pub(super) watermark: Watermark,
    /// Number of the push that came last for this target, over all targets.
    pub(super) last_push: u64,
    /// Everything up to here has been decided.
    decided: Option<Timestamp>,
}

#[derive(Debug, Clone)]
pub(super) struct Buffered<I, T> {
    time: Timestamp,
    item: I,
    tag: T,
    /// Tags of items of the same source and instant that came after this one.
    duplicates: Vec<T>,
    is_paired: bool,
    /// True for a box whose nearest fix is nearer to another box.
    is_fix_claimed: bool,
}

/// How far one target's stream has come, by the times of its items.
///
/// The watermark is the earlier of what its two sources have reached, so one source whose clock is ahead
/// cannot make the other late; and a source has reached what two consecutive items of it confirm, so one
/// wrong instant moves nothing.
#[derive(Debug, Clone, Default)]
pub(super) struct Watermark {
    detections: SourceProgress,
    fixes: SourceProgress,
}

#[derive(Debug, Clone, Default)]
struct SourceProgress {
    previous: Option<Timestamp>,
    reached: Option<Timestamp>,
    /// Items since the other source's last.
    run: u32,
}

impl SourceProgress {
    fn advance(&mut self, time: Timestamp, other: &mut Self) {
        let confirmed = self.previous.map(|previous| previous.min(time));
        self.reached = self.reached.max(confirmed);
        self.previous = Some(time);
        self.run = self.run.saturating_add(1);
        other.run = 0;
    }
}

impl Watermark {
    pub(super) fn detection_at(&mut self, time: Timestamp) {
        self.detections.advance(time, &mut self.fixes);
    }

    pub(super) fn fix_at(&mut self, time: Timestamp) {
        self.fixes.advance(time, &mut self.detections);
    }

    fn reached(&self) -> Option<Timestamp> {
        if self.detections.run >= IDLE_AFTER_ITEMS {
            self.detections.reached
        } else if self.fixes.run >= IDLE_AFTER_ITEMS {
            self.fixes.reached
        } else {
            Some(self.detections.reached?.min(self.fixes.reached?))
        }
    }
}

impl<T> Default for TargetBuffer<T> {
    fn default() -> Self {
        Self {
            detections: VecDeque::new(),
            fixes: VecDeque::new(),
            watermark: Watermark::default(),
            last_push: 0,
            decided: None,
        }
    }
}

/// How far beyond an item its decision looks.
fn lookahead(settings: &PairingSettings) -> SignedDuration {
    match settings.rule {
        // A partner's own partner may lie one window further on.
        PairingRule::Nearest => settings.window + settings.window,
        PairingRule::Interpolated => settings.longest_gap,
    }
}

impl<T> TargetBuffer<T> {
    /// Tags of everything buffered.
    pub(super) fn tags(&self) -> impl Iterator<Item = &T> {
        self.detections.iter().flat_map(Buffered::tags).chain(self.fixes.iter().flat_map(Buffered::tags))
    }

    pub(super) fn is_decided(&self, time: Timestamp) -> bool {
        self.decided.is_some_and(|decided| time <= decided)
    }

    /// Decides what the watermark allows, and releases what no later decision looks at.
    pub(super) fn decide_by_watermark(
        &mut self,
        settings: &PairingSettings,
        unpaired: &mut Unpaired,
    ) -> Option<PairedItems<T>> {
        let lookahead = lookahead(settings);
        let until = self.watermark.reached()?.checked_sub(lookahead + settings.allowed_lateness).ok()?;
        if self.is_decided(until) {
            return None;
        }
        let samples = self.decide(settings, Some(until));
        self.decided = Some(until);
        let released = self.release(Some(until.checked_sub(lookahead).ok()?), unpaired);
        Some(PairedItems { samples, ..released })
    }

    /// Decides everything and releases it.
    pub(super) fn decide_all(
        &mut self,
        settings: &PairingSettings,
        unpaired: &mut Unpaired,
    ) -> PairedItems<T> {
        let samples = self.decide(settings, None);
        PairedItems { samples, ..self.release(None, unpaired) }
    }

    /// The samples of the boxes up to an instant; of all of them for `None`.
    fn decide(&mut self, settings: &PairingSettings, until: Option<Timestamp>) -> Vec<Sample> {
        let mut samples = Vec::new();
        let begin =
            self.decided.map_or(0, |decided| self.detections.partition_point(|it| it.time <= decided));
        for index in begin..self.detections.len() {
            let time = self.detections[index].time;
            if until.is_some_and(|until| time > until) {
                break;
            }
            let fix = match settings.rule {
                PairingRule::Nearest => self.mutually_nearest_fix(settings, index),
                PairingRule::Interpolated => self.interpolated_fix(settings, time),
            };
            if let Some(fix) = fix {
                self.detections[index].is_paired = true;
                samples.push(sample(&self.detections[index].item, fix));
            }
        }
        samples
    }

    /// The fix that is nearest to a box and whose nearest box this is.
    fn mutually_nearest_fix(&mut self, settings: &PairingSettings, index: usize) -> Option<Fix> {
        let time = self.detections[index].time;
        let found = nearest(&self.fixes, time)?;
        let fix_time = self.fixes[found].time;
        if fix_time.duration_since(time).abs() > settings.window {
            return None;
        }
        if nearest(&self.detections, fix_time)? != index {
            self.detections[index].is_fix_claimed = true;
            return None;
        }
        self.fixes[found].is_paired = true;
        Some(self.fixes[found].item)
    }

    /// The fix of an instant on the straight line between its neighbours.
    fn interpolated_fix(&mut self, settings: &PairingSettings, time: Timestamp) -> Option<Fix> {
        let after = self.fixes.partition_point(|it| it.time < time);
        if let Some(exact) = self.fixes.get_mut(after).filter(|it| it.time == time) {
            exact.is_paired = true;
            return Some(exact.item);
        }
        let before = after.checked_sub(1)?;
        let (first, second) = (self.fixes.get(before)?, self.fixes.get(after)?);
        let gap = second.time.duration_since(first.time);
        if gap > settings.longest_gap {
            return None;
        }
        let share = time.duration_since(first.time).as_secs_f64() / gap.as_secs_f64();
        let fix = between(first.item, second.item, share);
        self.fixes[before].is_paired = true;
        self.fixes[after].is_paired = true;
        Some(fix)
    }

    /// Removes what lies before an instant (all for `None`), and counts what found no partner.
    fn release(&mut self, until: Option<Timestamp>, unpaired: &mut Unpaired) -> PairedItems<T> {
        let mut items = PairedItems::default();
        let is_old = |time: Timestamp| until.is_none_or(|until| time < until);
        while let Some(it) = self.detections.pop_front_if(|it| is_old(it.time)) {
            unpaired.detections += u64::from(!it.is_paired);
            unpaired.fix_claimed_by_nearer_box += u64::from(!it.is_paired && it.is_fix_claimed);
            let is_paired = it.is_paired;
            let detection = it.release_into(&mut items.released);
            items.unpaired_detections.extend((!is_paired).then_some(detection));
        }
        while let Some(it) = self.fixes.pop_front_if(|it| is_old(it.time)) {
            unpaired.fixes += u64::from(!it.is_paired);
            it.release_into(&mut items.released);
        }
        items
    }
}

impl<I, T> Buffered<I, T> {
    fn tags(&self) -> impl Iterator<Item = &T> {
        std::iter::once(&self.tag).chain(&self.duplicates)
    }

    /// Returns the item.
    fn release_into(self, released: &mut Vec<Released<T>>) -> I {
        let outcome = if self.is_paired { ItemOutcome::Paired } else { ItemOutcome::Unpaired };
        released.push(Released { tag: self.tag, outcome });
        let duplicate = |tag| Released { tag, outcome: ItemOutcome::Duplicate };
        released.extend(self.duplicates.into_iter().map(duplicate));
        self.item
    }
}

/// Inserts an item in order of time; false for one of an instant that is there already. Its tag waits with
/// that item, for nothing is acknowledged before the item that it repeats is decided.
pub(super) fn insert<I, T>(
    buffered: &mut VecDeque<Buffered<I, T>>,
    time: Timestamp,
    item: I,
    tag: T,
) -> bool {
    let place = buffered.partition_point(|other| other.time < time);
    if let Some(same) = buffered.get_mut(place).filter(|other| other.time == time) {
        same.duplicates.push(tag);
        return false;
    }
    let new = Buffered { time, item, tag, duplicates: Vec::new(), is_paired: false, is_fix_claimed: false };
    buffered.insert(place, new);
    true
}

/// Index of the item nearest in time, the earlier of two equally near.
fn nearest<I, T>(buffered: &VecDeque<Buffered<I, T>>, time: Timestamp) -> Option<usize> {
    let after = buffered.partition_point(|other| other.time < time);
    let apart = |index: &usize| buffered[*index].time.duration_since(time).abs();
    [after.checked_sub(1), (after < buffered.len()).then_some(after)].into_iter().flatten().min_by_key(apart)
}

/// The fix a share of the way from one to another; its sigma is the larger of the two.
fn between(first: Fix, second: Fix, share: f64) -> Fix {
    // In a plane, because degrees are discontinuous at the antimeridian.
    let plane = LocalPlane::new(first.position);
    let far = plane.to_plane(second.position);
    let point = EastNorth { east_m: share * far.east_m, north_m: share * far.north_m };
    let sigma_m = match (first.sigma_m, second.sigma_m) {
        (Some(one), Some(other)) => Some(if one > other { one } else { other }),
        (one, other) => one.or(other),
    };
    Fix { position: plane.to_position(point), sigma_m }
}

fn sample(detection: &Detection, fix: Fix) -> Sample {
    Sample {
        time: detection.time,
        target_id: detection.target_id.clone(),
        bounding_box: detection.bounding_box,
        fix,
        class: detection.class.clone(),
        score: detection.score,
        truth: None,
    }
}
