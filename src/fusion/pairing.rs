//! Detections and fixes that come apart, brought together by time.
//!
//! Each receiver is bound to a target and has a fixed clock offset ([`Receivers`]). Under [`PairingRule::Nearest`] a
//! fix and a box make a sample when each is the other's nearest within the window, so no fix labels
//! two boxes; under [`PairingRule::Interpolated`] every box between two neighbouring fixes gets a
//! fix of its own time. What never happens here: files, clocks, unbounded memory on a live stream.

use std::collections::{BTreeMap, VecDeque};

use jiff::{SignedDuration, Timestamp};

use crate::domain::{Detection, Fix, ReceiverId, Receivers, Sample, TargetId};
use crate::geo::{EastNorth, LocalPlane};

/// A fix as a receiver sent it, by the receiver's own clock.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceivedFix {
    /// When, by the receiver's clock.
    pub time: Timestamp,
    /// Which receiver; a fix that names none belongs to nobody.
    pub receiver_id: Option<ReceiverId>,
    /// Where it says it is.
    pub fix: Fix,
}

/// How a box finds its fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum PairingRule {
    /// Box and fix that are each other's nearest within the window.
    #[default]
    Nearest,
    /// The straight line between the fixes before and after the box.
    Interpolated,
}

/// How to pair, and how much to keep on a live stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairingSettings {
    /// How a box finds its fix.
    pub rule: PairingRule,
    /// Box and fix are at most this far apart (nearest).
    pub window: SignedDuration,
    /// Fixes are joined by a line over at most this long a gap (interpolated).
    pub longest_gap: SignedDuration,
    /// On a stream, items may come this late and still find their partner.
    pub lateness: SignedDuration,
    /// On a stream, items kept per target and kind; beyond, the target is decided early.
    pub items_per_target: usize,
    /// On a stream, targets kept; beyond, the one heard of longest ago is decided early.
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
            lateness: SignedDuration::from_secs(3),
            items_per_target: 512,
            targets: 1_024,
        }
    }
}

/// What did not become part of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Unpaired {
    /// Boxes without a partner.
    pub detections: u64,
    /// Fixes without a partner (nearest), or that came too late to be used (interpolated).
    pub fixes: u64,
    /// Boxes or fixes of a target and instant that was there already.
    pub duplicates: u64,
    /// Fixes that name no receiver.
    pub unbound: u64,
}

/// Two recorded lists as training samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Paired {
    /// In order of time, then target.
    pub samples: Vec<Sample>,
    /// The rest, counted.
    pub unpaired: Unpaired,
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
        pairer.insert_detection(detection);
    }
    for received in fixes {
        let Some(receiver_id) = &received.receiver_id else {
            pairer.unpaired.unbound += 1;
            continue;
        };
        let (target_id, time) = receivers.resolve(receiver_id, received.time);
        pairer.insert_fix(&target_id, time, received.fix);
    }
    let samples = pairer.finish();
    Paired { samples, unpaired: pairer.unpaired }
}

/// What has become certain of one target.
#[derive(Debug, Clone, PartialEq)]
pub struct Decided {
    /// Whose.
    pub target_id: TargetId,
    /// New samples, in order of time.
    pub samples: Vec<Sample>,
    /// Items of that target from before this instant will never be looked at again.
    pub settled_before: Timestamp,
}

/// Pairs a live stream in bounded memory. A sample comes out once nothing that may still arrive in
/// time could change it; [`Pairer::finish`] gives what is left. Where memory is short, targets are
/// decided early and nothing is dropped.
#[derive(Debug, Clone)]
pub struct Pairer {
    settings: PairingSettings,
    lanes: BTreeMap<TargetId, Lane>,
    unpaired: Unpaired,
}

/// What is kept of one target, in order of time.
#[derive(Debug, Clone, Default)]
struct Lane {
    detections: VecDeque<Kept<Detection>>,
    fixes: VecDeque<Kept<Fix>>,
    latest: Option<Timestamp>,
    /// Everything up to here has been decided.
    decided: Option<Timestamp>,
}

#[derive(Debug, Clone)]
struct Kept<T> {
    time: Timestamp,
    item: T,
    used: bool,
}

impl Pairer {
    /// Nothing kept yet.
    #[must_use]
    pub fn new(settings: PairingSettings) -> Self {
        Self { settings, lanes: BTreeMap::new(), unpaired: Unpaired::default() }
    }

    /// What has not become part of a sample so far.
    #[must_use]
    pub const fn unpaired(&self) -> Unpaired {
        self.unpaired
    }

    /// Takes a box; returns what is now certain.
    pub fn push_detection(&mut self, detection: Detection) -> Vec<Decided> {
        let target_id = detection.target_id.clone();
        let mut decided = self.make_room(&target_id);
        self.insert_detection(detection);
        decided.extend(self.decide(&target_id));
        decided
    }

    /// Takes the fix of a target, at the camera's time; returns what is now certain.
    pub fn push_fix(&mut self, target_id: &TargetId, time: Timestamp, fix: Fix) -> Vec<Decided> {
        let mut decided = self.make_room(target_id);
        self.insert_fix(target_id, time, fix);
        decided.extend(self.decide(target_id));
        decided
    }

    /// Decides all that is kept of a target, as if its stream had ended.
    pub fn end(&mut self, target_id: &TargetId) -> Option<Decided> {
        let mut lane = self.lanes.remove(target_id)?;
        let mut samples = Vec::new();
        lane.decide(&self.settings, None, &mut samples);
        lane.forget(None, &mut self.unpaired, self.settings.rule);
        Some(Decided { target_id: target_id.clone(), samples, settled_before: Timestamp::MAX })
    }

    /// Decides everything kept, as if the stream had ended. In order of time, then target.
    pub fn finish(&mut self) -> Vec<Sample> {
        let targets: Vec<TargetId> = self.lanes.keys().cloned().collect();
        let ended = targets.iter().filter_map(|target_id| self.end(target_id));
        let mut samples: Vec<Sample> = ended.flat_map(|decided| decided.samples).collect();
        samples.sort_by(|a, b| (a.time, &a.target_id).cmp(&(b.time, &b.target_id)));
        samples
    }

    /// Ends the target itself if too much of it is kept, and the one heard of longest ago if there
    /// are too many.
    fn make_room(&mut self, target_id: &TargetId) -> Vec<Decided> {
        let crowded = match self.lanes.get(target_id) {
            Some(lane) => {
                let most = self.settings.items_per_target;
                (lane.detections.len() >= most || lane.fixes.len() >= most).then(|| target_id.clone())
            }
            None if self.lanes.len() >= self.settings.targets => {
                let stalest = self.lanes.iter().min_by_key(|(_, lane)| lane.latest);
                stalest.map(|(stalest, _)| stalest.clone())
            }
            None => None,
        };
        crowded.and_then(|target_id| self.end(&target_id)).into_iter().collect()
    }

    fn insert_detection(&mut self, detection: Detection) {
        let time = detection.time;
        let lane = self.lanes.entry(detection.target_id.clone()).or_default();
        if lane.is_decided(time) {
            self.unpaired.detections += 1;
            return;
        }
        lane.latest = lane.latest.max(Some(time));
        keep(&mut lane.detections, time, detection, &mut self.unpaired);
    }

    fn insert_fix(&mut self, target_id: &TargetId, time: Timestamp, fix: Fix) {
        let lane = self.lanes.entry(target_id.clone()).or_default();
        if lane.is_decided(time) {
            self.unpaired.fixes += 1;
            return;
        }
        lane.latest = lane.latest.max(Some(time));
        keep(&mut lane.fixes, time, fix, &mut self.unpaired);
    }

    fn decide(&mut self, target_id: &TargetId) -> Option<Decided> {
        let settings = &self.settings;
        let lane = self.lanes.get_mut(target_id)?;
        // A partner's own partner may lie one window further on.
        let reach = reach(settings);
        let until = lane.latest?.checked_sub(reach + settings.lateness).ok()?;
        if lane.is_decided(until) {
            return None;
        }
        let mut samples = Vec::new();
        lane.decide(settings, Some(until), &mut samples);
        lane.decided = Some(until);
        let settled_before = until.checked_sub(reach).ok()?;
        lane.forget(Some(settled_before), &mut self.unpaired, settings.rule);
        Some(Decided { target_id: target_id.clone(), samples, settled_before })
    }
}

/// How far beyond an item its decision looks.
fn reach(settings: &PairingSettings) -> SignedDuration {
    match settings.rule {
        PairingRule::Nearest => settings.window + settings.window,
        PairingRule::Interpolated => settings.longest_gap,
    }
}

/// Puts an item at its place in time.
fn keep<T>(kept: &mut VecDeque<Kept<T>>, time: Timestamp, item: T, unpaired: &mut Unpaired) {
    let place = kept.partition_point(|other| other.time < time);
    if kept.get(place).is_some_and(|other| other.time == time) {
        unpaired.duplicates += 1;
    } else {
        kept.insert(place, Kept { time, item, used: false });
    }
}

/// Index of the item nearest in time, the earlier of two equally near.
fn nearest<T>(kept: &VecDeque<Kept<T>>, time: Timestamp) -> Option<usize> {
    let after = kept.partition_point(|other| other.time < time);
    let apart = |index: &usize| kept[*index].time.duration_since(time).abs();
    [after.checked_sub(1), (after < kept.len()).then_some(after)].into_iter().flatten().min_by_key(apart)
}

impl Lane {
    fn is_decided(&self, time: Timestamp) -> bool {
        self.decided.is_some_and(|decided| time <= decided)
    }

    /// Makes the samples of the boxes up to an instant; of all of them for `None`.
    fn decide(&mut self, settings: &PairingSettings, until: Option<Timestamp>, samples: &mut Vec<Sample>) {
        let begin =
            self.decided.map_or(0, |decided| self.detections.partition_point(|kept| kept.time <= decided));
        for index in begin..self.detections.len() {
            let time = self.detections[index].time;
            if until.is_some_and(|until| time > until) {
                break;
            }
            let fix = match settings.rule {
                PairingRule::Nearest => self.partner(settings, index),
                PairingRule::Interpolated => self.interpolated(settings, time),
            };
            if let Some(fix) = fix {
                self.detections[index].used = true;
                samples.push(sample(&self.detections[index].item, fix));
            }
        }
    }

    /// The fix that is nearest to a box and whose nearest box this is.
    fn partner(&mut self, settings: &PairingSettings, index: usize) -> Option<Fix> {
        let time = self.detections[index].time;
        let found = nearest(&self.fixes, time)?;
        let fix_time = self.fixes[found].time;
        let near = fix_time.duration_since(time).abs() <= settings.window;
        if !near || nearest(&self.detections, fix_time)? != index {
            return None;
        }
        self.fixes[found].used = true;
        Some(self.fixes[found].item)
    }

    /// The fix of an instant on the straight line between its neighbours.
    fn interpolated(&mut self, settings: &PairingSettings, time: Timestamp) -> Option<Fix> {
        let after = self.fixes.partition_point(|kept| kept.time < time);
        if let Some(exact) = self.fixes.get_mut(after).filter(|kept| kept.time == time) {
            exact.used = true;
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
        self.fixes[before].used = true;
        self.fixes[after].used = true;
        Some(fix)
    }

    /// Lets go of what no decision will look at again, and counts what found no partner.
    fn forget(&mut self, until: Option<Timestamp>, unpaired: &mut Unpaired, rule: PairingRule) {
        let old = |time: Timestamp| until.is_none_or(|until| time < until);
        while self.detections.front().is_some_and(|kept| old(kept.time)) {
            let unused = self.detections.pop_front().is_some_and(|kept| !kept.used);
            unpaired.detections += u64::from(unused);
        }
        while self.fixes.front().is_some_and(|kept| old(kept.time)) {
            let unused = self.fixes.pop_front().is_some_and(|kept| !kept.used);
            unpaired.fixes += u64::from(unused && rule == PairingRule::Nearest);
        }
    }
}

/// The fix a share of the way from one to another; its sigma is the larger of the two.
fn between(first: Fix, second: Fix, share: f64) -> Fix {
    // The plane is right across the antimeridian, where degrees are not.
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

#[cfg(test)]
mod tests;
