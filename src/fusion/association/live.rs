//! Live matching: the latest boxes and fixes of one camera, and matches that do not flicker.
//!
//! A window of the recording is matched again and again by [`super::match_with_model`]. A tracker's id is matched
//! with a receiver when the posterior probability reaches an upper bound, and stays so until it falls below a lower
//! one (hysteresis).

use std::collections::{BTreeMap, VecDeque};

use jiff::{SignedDuration, Timestamp};

use super::matching::{MatchedPiece, Matching};
use crate::domain::{Detection, ReceivedFix, ReceiverId, ReceiverMatch, TargetId};

/// Bounds of a window and of matches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LiveMatchSettings {
    /// Length of the window.
    pub window: SignedDuration,
    /// Boxes of one tracker's id, and fixes of one receiver, closer than this to the one before are left out.
    pub min_interval: SignedDuration,
    /// Trackers' ids within the window at most.
    pub max_trackers: usize,
    /// Receivers within the window at most.
    pub max_receivers: usize,
    /// Posterior probability that makes a match.
    pub matched_from: f64,
    /// Posterior probability below which it ends.
    pub unmatched_below: f64,
}

impl Default for LiveMatchSettings {
    fn default() -> Self {
        Self {
            window: SignedDuration::from_secs(120),
            min_interval: SignedDuration::from_millis(400),
            max_trackers: 400,
            max_receivers: 64,
            matched_from: 0.9,
            unmatched_below: 0.6,
        }
    }
}

/// The latest boxes by tracker's id and the latest fixes by receiver.
#[derive(Debug, Clone)]
pub struct LiveWindow {
    settings: LiveMatchSettings,
    detections: BTreeMap<TargetId, VecDeque<Detection>>,
    fixes: BTreeMap<ReceiverId, VecDeque<ReceivedFix>>,
    /// Time of the latest box.
    latest: Option<Timestamp>,
}

impl LiveWindow {
    /// Without boxes and fixes.
    #[must_use]
    pub const fn new(settings: LiveMatchSettings) -> Self {
        Self { settings, detections: BTreeMap::new(), fixes: BTreeMap::new(), latest: None }
    }

    /// Whether it has boxes and fixes.
    #[must_use]
    pub fn can_be_matched(&self) -> bool {
        !self.detections.is_empty() && !self.fixes.is_empty()
    }

    /// Takes a box whose target id is that of its tracker. Boxes that are late within their tracker's id are left out.
    pub fn push_detection(&mut self, detection: Detection) {
        let Self { settings, detections, latest, .. } = self;
        let time = detection.time;
        if let Some(own) = detections.get_mut(&detection.target_id) {
            if own.back().is_none_or(|last| is_after(time, last.time, settings.min_interval)) {
                push_bounded(own, detection);
            }
        } else if detections.len() < settings.max_trackers {
            detections.insert(detection.target_id.clone(), VecDeque::from([detection]));
        }
        *latest = Some(latest.map_or(time, |latest| latest.max(time)));
    }

    /// Takes a fix by the camera's clock. Before the first box there is nothing to be matched with.
    pub fn push_fix(&mut self, receiver_id: &ReceiverId, fix: ReceivedFix) {
        let Self { settings, fixes, latest, .. } = self;
        if latest.is_none() {
            return;
        }
        if let Some(own) = fixes.get_mut(receiver_id) {
            if own.back().is_none_or(|last| is_after(fix.time, last.time, settings.min_interval)) {
                push_bounded(own, fix);
            }
        } else if fixes.len() < settings.max_receivers {
            fixes.insert(receiver_id.clone(), VecDeque::from([fix]));
        }
    }

    /// Forgets what is older than the window, by the latest box.
    pub fn prune(&mut self) {
        let Some(latest) = self.latest else { return };
        let oldest = latest.saturating_sub(self.settings.window).unwrap_or(Timestamp::MIN);
        self.detections.retain(|_, own| {
            own.drain(..own.partition_point(|detection| detection.time < oldest));
            !own.is_empty()
        });
        self.fixes.retain(|_, own| {
            own.drain(..own.partition_point(|fix| fix.time < oldest));
            !own.is_empty()
        });
    }

    /// Its boxes and fixes, as a recording.
    #[must_use]
    pub fn recording(&self) -> (Vec<Detection>, Vec<ReceivedFix>) {
        let detections = self.detections.values().flatten().cloned().collect();
        (detections, self.fixes.values().flatten().cloned().collect())
    }
}

/// Boxes of one tracker's id, or fixes of one receiver, at most.
const MAX_PER_ID: usize = 400;

fn push_bounded<T>(own: &mut VecDeque<T>, next: T) {
    if own.len() == MAX_PER_ID {
        own.pop_front();
    }
    own.push_back(next);
}

fn is_after(time: Timestamp, last: Timestamp, interval: SignedDuration) -> bool {
    time.duration_since(last) >= interval
}

/// The receivers of trackers' ids.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LiveMatches(BTreeMap<TargetId, ReceiverMatch>);

impl LiveMatches {
    /// The receiver that the target under a tracker's id carries.
    #[must_use]
    pub fn get(&self, tracker_id: &TargetId) -> Option<&ReceiverMatch> {
        self.0.get(tracker_id)
    }

    /// The matches after the window's boxes were matched again. The latest piece of each tracker's id counts.
    #[must_use]
    pub fn updated(
        &self,
        matching: &Matching,
        detections: &[Detection],
        settings: &LiveMatchSettings,
    ) -> Self {
        let end = |piece: &MatchedPiece| piece.detections.last().map(|at| detections[*at].time);
        let mut latest: BTreeMap<&TargetId, &MatchedPiece> = BTreeMap::new();
        for piece in &matching.pieces {
            let own = latest.entry(&piece.tracker_id).or_insert(piece);
            if end(piece) > end(own) {
                *own = piece;
            }
        }
        let is_match = |piece: &MatchedPiece| {
            let is_held = self.get(&piece.tracker_id).is_some_and(|own| own.receiver_id == piece.receiver_id);
            let bound = if is_held { settings.unmatched_below } else { settings.matched_from };
            piece.probability >= bound
        };
        let matched = latest.into_values().filter(|piece| is_match(piece)).map(|piece| {
            let MatchedPiece { tracker_id, receiver_id, probability, .. } = piece.clone();
            (tracker_id, ReceiverMatch { receiver_id, probability })
        });
        Self(matched.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{BoundingBox, Fix};
    use crate::geo::Position;

    fn at(seconds: i64) -> Timestamp {
        Timestamp::from_second(1_700_000_000 + seconds).expect("a time")
    }

    fn detection(tracker_id: &str, seconds: i64) -> Detection {
        Detection {
            time: at(seconds),
            target_id: TargetId::new(tracker_id).expect("an id"),
            bounding_box: BoundingBox::new(10.0, 10.0, 20.0, 50.0).expect("a box"),
            class: None,
            score: None,
        }
    }

    fn matched(
        tracker_id: &str,
        receiver_id: &str,
        probability: f64,
        detections: Vec<usize>,
    ) -> MatchedPiece {
        MatchedPiece {
            tracker_id: TargetId::new(tracker_id).expect("an id"),
            detections,
            receiver_id: ReceiverId::new(receiver_id).expect("an id"),
            probability,
        }
    }

    #[test]
    fn a_match_begins_when_sure_and_stays_until_it_is_unlikely() {
        let (settings, detections) = (LiveMatchSettings::default(), [detection("7", 0), detection("7", 60)]);
        let mut matches = LiveMatches::default();
        let tracker_id = TargetId::new("7").expect("an id");
        for (receiver, probability, expected) in [
            ("a", 0.85, None),
            ("a", 0.95, Some("a")),
            ("a", 0.65, Some("a")),
            ("b", 0.80, None),
            ("a", 0.65, None),
            ("b", 0.92, Some("b")),
        ] {
            let pieces = vec![matched("7", receiver, probability, vec![0, 1])];
            matches = matches.updated(&Matching { pieces, ..Matching::default() }, &detections, &settings);
            let found = matches.get(&tracker_id).map(|own| own.receiver_id.as_str());
            assert_eq!(found, expected, "{receiver} {probability}");
        }
    }

    #[test]
    fn the_latest_piece_of_an_id_counts() {
        let detections = [detection("7", 0), detection("7", 60)];
        let pieces = vec![matched("7", "a", 0.99, vec![0]), matched("7", "b", 0.95, vec![1])];
        let matching = Matching { pieces, ..Matching::default() };
        let matches = LiveMatches::default().updated(&matching, &detections, &LiveMatchSettings::default());
        let found = matches.get(&detections[0].target_id).map(|own| own.receiver_id.as_str());
        assert_eq!(found, Some("b"));
    }

    #[test]
    fn a_window_is_bounded_in_time_and_number() {
        let settings =
            LiveMatchSettings { max_trackers: 2, max_receivers: 1, ..LiveMatchSettings::default() };
        let mut window = LiveWindow::new(settings);
        let fix = Fix { position: Position::new(11.0, 48.0).expect("a position"), sigma_m: None };
        for seconds in 0..300 {
            for tracker_id in ["1", "2", "3"] {
                window.push_detection(detection(tracker_id, seconds));
                window.push_detection(detection(tracker_id, seconds));
            }
            for name in ["a", "b"] {
                let receiver_id = ReceiverId::new(name).expect("an id");
                let own = ReceivedFix { time: at(seconds), receiver_id: Some(receiver_id.clone()), fix };
                window.push_fix(&receiver_id, own);
            }
        }
        window.prune();
        let (detections, fixes) = window.recording();
        assert_eq!((detections.len(), fixes.len()), (2 * 121, 121));
        assert!(detections.iter().all(|own| own.time >= at(179)));
    }
}
