//! The recording of a camera without a model: boxes that have only a tracker's id, and fixes of receivers.
//!
//! Rows wait in memory until a task stores them, about once a second, so an item never waits for the database.

use std::collections::{BTreeSet, HashMap};
use std::sync::Mutex;

use jiff::{SignedDuration, Timestamp};

use super::sync::lock;
use crate::app::recording::Recording;
use crate::domain::{Detection, Observation, ReceivedFix, ReceiverId, TargetId};

/// Least time between two recorded boxes of a tracker's id: matching needs no more of a walker.
const BOX_INTERVAL: SignedDuration = SignedDuration::from_millis(450);
/// Least time between two recorded fixes of a receiver.
const FIX_INTERVAL: SignedDuration = SignedDuration::from_millis(900);
/// Time is counted in intervals of this length, s; phones that save power send a fix every few seconds.
const COUNTED_S: i64 = 10;
/// Intervals and ids that are remembered. The oldest intervals are forgotten first.
const REMEMBERED: usize = 8_192;
/// Rows that wait for their storage; more are dropped, and counted.
const PENDING_ROWS: usize = 20_000;
/// Time with boxes and fixes that is recorded before the first attempt to match them, s. In simulated squares with one
/// phone among eleven walkers it is enough (docs/explanation/association.md).
const FIRST_NEEDED_S: u64 = 480;
/// An attempt that failed is repeated with this much more, s, or a quarter more.
const MORE_NEEDED_S: u64 = 120;

/// How much is recorded.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(in crate::app) struct RecordedExtent {
    pub(in crate::app) boxes: u64,
    pub(in crate::app) fixes: u64,
    pub(in crate::app) receivers: BTreeSet<ReceiverId>,
    /// Intervals with a box, and with a fix.
    seen: [BTreeSet<i64>; 2],
}

impl RecordedExtent {
    pub(in crate::app) fn of(recording: &Recording) -> Self {
        let mut extent = Self::default();
        extent.add(recording);
        extent
    }

    fn add(&mut self, recording: &Recording) {
        recording.detections.iter().for_each(|own| self.add_box(own.time));
        for fix in &recording.fixes {
            if let Some(receiver_id) = &fix.receiver_id {
                self.add_fix(fix.time, receiver_id);
            }
        }
    }

    fn add_box(&mut self, time: Timestamp) {
        self.boxes += 1;
        remember(&mut self.seen[0], time);
    }

    fn add_fix(&mut self, time: Timestamp, receiver_id: &ReceiverId) {
        self.fixes += 1;
        remember(&mut self.seen[1], time);
        if !self.receivers.contains(receiver_id) && self.receivers.len() < REMEMBERED {
            self.receivers.insert(receiver_id.clone());
        }
    }

    /// Time in which boxes and fixes came together, s.
    pub(in crate::app) fn common_s(&self) -> u64 {
        let [boxes, fixes] = &self.seen;
        boxes.intersection(fixes).count() as u64 * COUNTED_S.unsigned_abs()
    }
}

fn remember(intervals: &mut BTreeSet<i64>, time: Timestamp) {
    intervals.insert(time.as_second().div_euclid(COUNTED_S));
    if intervals.len() > REMEMBERED {
        intervals.pop_first();
    }
}

/// An attempt to match what was recorded.
#[derive(Debug, Clone)]
pub(in crate::app) struct LearningAttempt {
    pub(in crate::app) at: Timestamp,
    /// The outcome, as a sentence.
    pub(in crate::app) outcome: String,
    /// Time that had been recorded, s.
    common_s: u64,
}

/// The progress of a camera's learning.
#[derive(Debug, Clone)]
pub(in crate::app) struct LearningProgress {
    pub(in crate::app) extent: RecordedExtent,
    pub(in crate::app) needed_s: u64,
    pub(in crate::app) is_matching: bool,
    pub(in crate::app) attempt: Option<LearningAttempt>,
}

/// The recording of one camera.
#[derive(Default)]
pub(in crate::app) struct LiveLearning(Mutex<State>);

#[derive(Default)]
struct State {
    /// Not stored yet.
    pending: Recording,
    dropped: u64,
    extent: RecordedExtent,
    /// True if `extent` has what an earlier run of the server stored.
    is_complete: bool,
    kept_at: HashMap<TargetId, Timestamp>,
    is_matching: bool,
    attempt: Option<LearningAttempt>,
}

impl LiveLearning {
    /// Records a box that has only a tracker's id, or a fix of a receiver.
    pub(super) fn observe(&self, observation: &Observation) {
        let time = observation.time();
        match (observation.tracker_id(), observation.bounding_box(), observation.fix()) {
            (Some(tracker_id), Some(bounding_box), _) => {
                let target_id = TargetId::from(tracker_id);
                let class = observation.class().cloned();
                lock(&self.0).record_box(Detection { time, target_id, bounding_box, class, score: None });
            }
            (None, None, Some(fix)) => {
                if let Some(target_id) = observation.target_id() {
                    // The target of a receiver that nobody has bound is its own id.
                    let receiver_id = Some(ReceiverId::from(target_id.clone()));
                    lock(&self.0).record_fix(target_id, ReceivedFix { time, receiver_id, fix });
                }
            }
            _ => {}
        }
    }

    /// True if rows wait to be stored.
    pub(in crate::app) fn is_pending(&self) -> bool {
        let state = lock(&self.0);
        !state.pending.detections.is_empty() || !state.pending.fixes.is_empty()
    }

    /// Takes the rows that wait for their storage, and the number of those that were dropped since the last call.
    pub(in crate::app) fn take_pending(&self) -> (Recording, u64) {
        let mut state = lock(&self.0);
        (std::mem::take(&mut state.pending), std::mem::take(&mut state.dropped))
    }

    /// True if it is known how much was stored.
    pub(in crate::app) fn is_complete(&self) -> bool {
        lock(&self.0).is_complete
    }

    /// Takes what is stored as the truth; rows that wait are added.
    pub(in crate::app) fn set_stored(&self, stored: &Recording) {
        let mut state = lock(&self.0);
        state.extent = RecordedExtent::of(stored);
        let State { pending, extent, .. } = &mut *state;
        extent.add(pending);
        state.is_complete = true;
    }

    pub(in crate::app) fn progress(&self) -> LearningProgress {
        let state = lock(&self.0);
        LearningProgress {
            extent: state.extent.clone(),
            needed_s: state.needed_s(),
            is_matching: state.is_matching,
            attempt: state.attempt.clone(),
        }
    }

    /// True if an attempt begins now; [`Self::end_attempt`] ends it.
    pub(in crate::app) fn begin_attempt(&self) -> bool {
        let mut state = lock(&self.0);
        let begins = !state.is_matching && state.extent.common_s() >= state.needed_s();
        state.is_matching |= begins;
        begins
    }

    pub(in crate::app) fn end_attempt(&self, at: Timestamp, outcome: String) {
        let mut state = lock(&self.0);
        state.is_matching = false;
        state.attempt = Some(LearningAttempt { at, outcome, common_s: state.extent.common_s() });
    }

    /// Forgets everything: a model answers, or the profile switches the learning off.
    pub(in crate::app) fn reset(&self) {
        let mut state = lock(&self.0);
        // An attempt that is under way ends by itself.
        *state = State { is_matching: state.is_matching, ..State::default() };
    }
}

impl State {
    fn record_box(&mut self, detection: Detection) {
        if self.is_due(&detection.target_id, detection.time, BOX_INTERVAL) {
            self.extent.add_box(detection.time);
            self.pending.detections.push(detection);
        }
    }

    /// Fixes count from the first box on: a camera whose boxes have names of targets learns nothing from them.
    fn record_fix(&mut self, target_id: &TargetId, fix: ReceivedFix) {
        if self.extent.boxes > 0 && self.is_due(target_id, fix.time, FIX_INTERVAL) {
            self.extent.add_fix(fix.time, &ReceiverId::from(target_id.clone()));
            self.pending.fixes.push(fix);
        }
    }

    fn is_due(&mut self, id: &TargetId, time: Timestamp, interval: SignedDuration) -> bool {
        if self.kept_at.get(id).is_some_and(|kept_at| time.duration_since(*kept_at).abs() < interval) {
            return false;
        }
        if self.pending.detections.len() + self.pending.fixes.len() >= PENDING_ROWS {
            self.dropped += 1;
            return false;
        }
        if self.kept_at.len() >= REMEMBERED {
            self.kept_at.clear();
        }
        self.kept_at.insert(id.clone(), time);
        true
    }

    fn needed_s(&self) -> u64 {
        let after = |attempt: &LearningAttempt| attempt.common_s + MORE_NEEDED_S.max(attempt.common_s / 4);
        self.attempt.as_ref().map_or(FIRST_NEEDED_S, after)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{BoundingBox, Fix, TrackerId};
    use crate::geo::Position;

    fn at(second: f64) -> Timestamp {
        Timestamp::from_microsecond(1_600_000_000_000_000 + (second * 1e6) as i64).expect("in range")
    }

    fn seen(learning: &LiveLearning, second: f64) {
        let bounding_box = BoundingBox::new(1.0, 2.0, 3.0, 4.0).expect("a box");
        let observation = Observation::new(at(second), None, Some(bounding_box), None).expect("a box");
        let tracker_id = TrackerId::new("7").expect("an id");
        learning.observe(&observation.with_tracker_id(Some(tracker_id)).expect("no target"));
    }

    fn fixed(learning: &LiveLearning, second: f64) {
        let fix = Fix { position: Position::new(8.0, 47.0).expect("a place"), sigma_m: None };
        let phone = TargetId::new("phone").expect("an id");
        let observation = Observation::new(at(second), Some(phone), None, Some(fix)).expect("a fix");
        learning.observe(&observation);
    }

    #[test]
    fn boxes_and_fixes_are_thinned_and_fixes_count_from_the_first_box_on() {
        let learning = LiveLearning::default();
        fixed(&learning, -1.0);
        assert!(!learning.is_pending());
        for frame in 0..100 {
            seen(&learning, f64::from(frame) * 0.1);
            fixed(&learning, f64::from(frame) * 0.1);
        }
        let extent = learning.progress().extent;
        assert_eq!((extent.boxes, extent.fixes, extent.receivers.len()), (20, 12, 1));
        let (pending, dropped) = learning.take_pending();
        assert_eq!((pending.detections.len(), pending.fixes.len(), dropped), (20, 12, 0));
        assert!(!learning.is_pending());
        learning.set_stored(&pending);
        assert_eq!(learning.progress().extent, extent, "what is stored counts as what came");
    }

    #[test]
    fn an_attempt_begins_with_enough_of_both_and_again_with_more() {
        let learning = LiveLearning::default();
        let record = |seconds: std::ops::Range<i32>| {
            for second in seconds {
                seen(&learning, f64::from(second));
                fixed(&learning, f64::from(second));
            }
        };
        for second in 0..900 {
            seen(&learning, f64::from(second));
        }
        assert!(!learning.begin_attempt(), "without a fix");
        record(0..470);
        assert!(!learning.begin_attempt());
        record(470..480);
        assert!(learning.begin_attempt() && !learning.begin_attempt(), "one at a time");
        learning.end_attempt(at(480.0), "nothing was found".to_owned());
        record(480..590);
        assert_eq!((learning.begin_attempt(), learning.progress().needed_s), (false, 600));
        record(590..600);
        assert!(learning.begin_attempt());
    }
}
