//! Pairing of a live stream: items in, decisions out, in bounded memory.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::buffer::{TargetBuffer, insert};
use super::outcome::{ItemOutcome, PairedItems, Released};
use super::{PairingSettings, Unpaired};
use crate::domain::{Detection, Fix, TargetId};

/// Pairs a live stream in bounded memory. A sample comes out once no item within the allowed lateness
/// could change it; [`Pairer::finish`] gives the rest. Where memory is short, targets are decided early
/// and nothing is dropped.
#[derive(Debug, Clone)]
pub struct Pairer<T> {
    settings: PairingSettings,
    targets: BTreeMap<TargetId, TargetBuffer<T>>,
    pushes: u64,
    pub(super) unpaired: Unpaired,
}

impl<T> Pairer<T> {
    /// Nothing buffered yet.
    #[must_use]
    pub const fn new(settings: PairingSettings) -> Self {
        let unpaired = Unpaired {
            detections: 0,
            fix_claimed_by_nearer_box: 0,
            fixes: 0,
            duplicates: 0,
            duplicate_fixes: 0,
            receiver_missing: 0,
        };
        Self { settings, targets: BTreeMap::new(), pushes: 0, unpaired }
    }

    /// Returns the counts of items that have not become part of a sample so far.
    #[must_use]
    pub const fn unpaired(&self) -> Unpaired {
        self.unpaired
    }

    /// Takes a box; returns what is now decided.
    pub fn push_detection(&mut self, detection: Detection, tag: T) -> PairedItems<T> {
        let target_id = detection.target_id.clone();
        let mut decided = self.make_room(&target_id);
        decided.released.extend(self.insert_detection(detection, tag));
        self.decide(&target_id, &mut decided);
        decided
    }

    /// Takes the fix of a target, at the camera's time; returns what is now decided.
    pub fn push_fix(&mut self, target_id: &TargetId, time: Timestamp, fix: Fix, tag: T) -> PairedItems<T> {
        let mut decided = self.make_room(target_id);
        decided.released.extend(self.insert_fix(target_id, time, fix, tag));
        self.decide(target_id, &mut decided);
        decided
    }

    /// Decides all that is buffered of a target, as if its stream had ended.
    pub fn end(&mut self, target_id: &TargetId) -> PairedItems<T> {
        let Some(mut buffer) = self.targets.remove(target_id) else { return PairedItems::default() };
        buffer.decide_all(&self.settings, &mut self.unpaired)
    }

    /// Decides everything buffered, as if the stream had ended. In order of time, then target.
    pub fn finish(&mut self) -> PairedItems<T> {
        let targets: Vec<TargetId> = self.targets.keys().cloned().collect();
        let mut items = PairedItems::default();
        for target_id in targets {
            items.append(self.end(&target_id));
        }
        items.samples.sort_by(|a, b| (a.time, &a.target_id).cmp(&(b.time, &b.target_id)));
        items.unpaired_detections.sort_by(|a, b| (a.time, &a.target_id).cmp(&(b.time, &b.target_id)));
        items
    }

    /// Buffered boxes of targets without a fix, and fixes of targets without a box.
    pub(super) fn items_of_lone_sources(&self) -> (usize, usize) {
        let (mut detections, mut fixes) = (0, 0);
        for buffer in self.targets.values() {
            detections += if buffer.fixes.is_empty() { buffer.detections.len() } else { 0 };
            fixes += if buffer.detections.is_empty() { buffer.fixes.len() } else { 0 };
        }
        (detections, fixes)
    }

    /// Ends the target itself if too much of it is buffered, and the one without an item for longest if
    /// there are too many.
    fn make_room(&mut self, target_id: &TargetId) -> PairedItems<T> {
        let crowded = match self.targets.get(target_id) {
            Some(buffer) => {
                let most = self.settings.items_per_target;
                let is_full = buffer.detections.len() >= most || buffer.fixes.len() >= most;
                is_full.then(|| target_id.clone())
            }
            None if self.targets.len() >= self.settings.targets => {
                let stalest = self.targets.iter().min_by_key(|(_, buffer)| buffer.last_push);
                stalest.map(|(stalest, _)| stalest.clone())
            }
            None => None,
        };
        crowded.map(|target_id| self.end(&target_id)).unwrap_or_default()
    }

    pub(super) fn insert_detection(&mut self, detection: Detection, tag: T) -> Option<Released<T>> {
        let time = detection.time;
        let target_id = detection.target_id.clone();
        let buffer = buffer_of(&mut self.targets, &mut self.pushes, &target_id);
        buffer.watermark.detection_at(time);
        if buffer.is_decided(time) {
            self.unpaired.detections += 1;
            return Some(Released { tag, outcome: ItemOutcome::TooLate });
        }
        self.unpaired.duplicates += u64::from(!insert(&mut buffer.detections, time, detection, tag));
        None
    }

    pub(super) fn insert_fix(
        &mut self,
        target_id: &TargetId,
        time: Timestamp,
        fix: Fix,
        tag: T,
    ) -> Option<Released<T>> {
        let buffer = buffer_of(&mut self.targets, &mut self.pushes, target_id);
        buffer.watermark.fix_at(time);
        if buffer.is_decided(time) {
            self.unpaired.fixes += 1;
            return Some(Released { tag, outcome: ItemOutcome::TooLate });
        }
        let is_duplicate = u64::from(!insert(&mut buffer.fixes, time, fix, tag));
        self.unpaired.duplicates += is_duplicate;
        self.unpaired.duplicate_fixes += is_duplicate;
        None
    }

    fn decide(&mut self, target_id: &TargetId, decided: &mut PairedItems<T>) {
        let Some(buffer) = self.targets.get_mut(target_id) else { return };
        if let Some(items) = buffer.decide_by_watermark(&self.settings, &mut self.unpaired) {
            decided.append(items);
        }
    }

    /// Tags of everything buffered.
    pub fn tags(&self) -> impl Iterator<Item = &T> {
        self.targets.values().flat_map(TargetBuffer::tags)
    }

    /// Targets with an item whose tag a rule selects.
    pub fn targets_with(&self, rule: impl Fn(&T) -> bool) -> Vec<TargetId> {
        let selected = self.targets.iter().filter(|(_, buffer)| buffer.tags().any(&rule));
        selected.map(|(target_id, _)| target_id.clone()).collect()
    }

    /// Items buffered of every target: boxes and fixes.
    #[cfg(test)]
    pub(super) fn buffered(&self) -> impl Iterator<Item = (usize, usize)> {
        self.targets.values().map(|buffer| (buffer.detections.len(), buffer.fixes.len()))
    }
}

fn buffer_of<'a, T>(
    targets: &'a mut BTreeMap<TargetId, TargetBuffer<T>>,
    pushes: &mut u64,
    target_id: &TargetId,
) -> &'a mut TargetBuffer<T> {
    *pushes += 1;
    let buffer = targets.entry(target_id.clone()).or_default();
    buffer.last_push = *pushes;
    buffer
}
