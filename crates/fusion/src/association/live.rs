//! Live matching: the latest boxes and fixes of one camera, and matches that do not flicker.
//!
//! A window of the recording is matched again and again by [`super::match_with_model`]. A tracker's id is matched
//! with a receiver when the posterior probability reaches an upper bound, and stays so until it falls below a lower
//! one (hysteresis). A match is that of the tracklet whose boxes it was found for: where a tracker uses a number again, or
//! it moved to another target, the match ends.

use std::collections::{BTreeMap, VecDeque};

use jiff::{SignedDuration, Timestamp};

use super::carriers::{MatchedPiece, Matching};
use super::recording::TRACKLET_GAP_S;
use crate::domain::{Detection, ReceivedFix, ReceiverId, ReceiverMatch, TargetId};

/// Bounds of a window and of matches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LiveMatchSettings {
    /// Length of the window.
    pub window: SignedDuration,
    /// Boxes of one tracker's id, and fixes of one receiver, closer than this to the one before are left out.
    pub min_interval: SignedDuration,
    /// Boxes within the window at most, and fixes; the oldest are left out.
    pub max_rows: usize,
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
            window: SignedDuration::from_secs(300),
            min_interval: SignedDuration::from_millis(400),
            max_rows: 12_000,
            max_receivers: 200,
            matched_from: 0.9,
            unmatched_below: 0.6,
        }
    }
}

impl LiveMatchSettings {
    /// Bounds for the world tracks of a site, which are smoother than boxes, and more.
    #[must_use]
    pub fn of_site() -> Self {
        Self { min_interval: SignedDuration::from_millis(900), max_rows: 30_000, ..Self::default() }
    }
}

/// After this number of boxes in a row that are older than the window, the recording has begun again.
const RESTART_AFTER: u32 = 50;

/// The latest boxes and fixes, in the order in which they came.
#[derive(Debug, Clone)]
pub struct LiveWindow {
    settings: LiveMatchSettings,
    detections: VecDeque<Detection>,
    fixes: VecDeque<ReceivedFix>,
    trackers: BTreeMap<TargetId, SeenTracker>,
    /// Time of the latest fix by receiver.
    receivers: BTreeMap<ReceiverId, Timestamp>,
    /// Time of the latest box.
    latest: Option<Timestamp>,
    /// Boxes in a row that were older than the window.
    outdated: u32,
}

/// The boxes of one tracker's id.
#[derive(Debug, Clone, Copy)]
struct SeenTracker {
    /// First box of the tracklet that goes on.
    since: Timestamp,
    /// Its latest box.
    last: Timestamp,
    /// The latest box that is in the window.
    kept: Timestamp,
}

impl LiveWindow {
    /// Without boxes and fixes.
    #[must_use]
    pub const fn new(settings: LiveMatchSettings) -> Self {
        Self {
            settings,
            detections: VecDeque::new(),
            fixes: VecDeque::new(),
            trackers: BTreeMap::new(),
            receivers: BTreeMap::new(),
            latest: None,
            outdated: 0,
        }
    }

    /// True if it has boxes and fixes.
    #[must_use]
    pub fn can_be_matched(&self) -> bool {
        !self.detections.is_empty() && !self.fixes.is_empty()
    }

    /// Takes a box whose target id is that of its tracker. Boxes that are late within their tracker's id are left out.
    pub fn push_detection(&mut self, detection: Detection) {
        let time = detection.time;
        if !self.advance(time) {
            return;
        }
        let Self { settings, trackers, detections, .. } = self;
        match trackers.get_mut(&detection.target_id) {
            Some(own) if time <= own.last => return,
            Some(own) => {
                if time.duration_since(own.last).as_secs_f64() > TRACKLET_GAP_S {
                    own.since = time;
                }
                own.last = time;
                if time.duration_since(own.kept) < settings.min_interval {
                    return;
                }
                own.kept = time;
            }
            None => {
                let own = SeenTracker { since: time, last: time, kept: time };
                trackers.insert(detection.target_id.clone(), own);
            }
        }
        detections.push_back(detection);
        self.prune();
    }

    /// Takes a fix by the camera's clock. Before the first box there is nothing to be matched with.
    pub fn push_fix(&mut self, receiver_id: ReceiverId, fix: ReceivedFix) {
        let Self { settings, receivers, fixes, .. } = self;
        if self.latest.is_none() {
            return;
        }
        let is_taken = match receivers.get(&receiver_id) {
            Some(last) => fix.time.duration_since(*last) >= settings.min_interval,
            None => receivers.len() < settings.max_receivers,
        };
        if !is_taken {
            return;
        }
        receivers.insert(receiver_id.clone(), fix.time);
        fixes.push_back(ReceivedFix { receiver_id: Some(receiver_id), ..fix });
        self.prune();
    }

    /// Since when a tracker's id is seen without a gap.
    #[must_use]
    pub fn seen_since(&self, tracker_id: &TargetId) -> Option<Timestamp> {
        self.trackers.get(tracker_id).map(|own| own.since)
    }

    /// True if a tracker's id is in view still.
    #[must_use]
    pub fn is_in_view(&self, tracker_id: &TargetId) -> bool {
        let last = self.trackers.get(tracker_id).map(|own| own.last);
        last.zip(self.latest)
            .is_some_and(|(last, latest)| latest.duration_since(last).as_secs_f64() <= TRACKLET_GAP_S)
    }

    /// Its boxes and fixes, as a recording.
    #[must_use]
    pub fn recording(&self) -> (Vec<Detection>, Vec<ReceivedFix>) {
        (self.detections.iter().cloned().collect(), self.fixes.iter().cloned().collect())
    }

    fn oldest(&self) -> Timestamp {
        self.latest.and_then(|latest| latest.checked_sub(self.settings.window).ok()).unwrap_or(Timestamp::MIN)
    }

    /// Moves the window on to a box; `false` if the box is older than the window.
    fn advance(&mut self, time: Timestamp) -> bool {
        if time < self.oldest() {
            self.outdated += 1;
            if self.outdated < RESTART_AFTER {
                return false;
            }
            *self = Self::new(self.settings);
        }
        self.outdated = 0;
        self.latest = Some(self.latest.map_or(time, |latest| latest.max(time)));
        true
    }

    /// Drops what is older than the window, and the oldest beyond the bound on its rows.
    fn prune(&mut self) {
        let oldest = self.oldest();
        let Self { settings, detections, fixes, trackers, receivers, .. } = self;
        while detections.front().is_some_and(|own| own.time < oldest || detections.len() > settings.max_rows)
        {
            let Some(own) = detections.pop_front() else { break };
            if trackers.get(&own.target_id).is_some_and(|seen| seen.kept == own.time) {
                trackers.remove(&own.target_id);
            }
        }
        while fixes.front().is_some_and(|own| own.time < oldest || fixes.len() > settings.max_rows) {
            let Some(own) = fixes.pop_front() else { break };
            let Some(receiver_id) = own.receiver_id else { continue };
            if receivers.get(&receiver_id) == Some(&own.time) {
                receivers.remove(&receiver_id);
            }
        }
    }
}

/// The receivers of trackers' ids.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LiveMatches(BTreeMap<TargetId, HeldMatch>);

#[derive(Debug, Clone, PartialEq)]
struct HeldMatch {
    receiver_match: ReceiverMatch,
    /// Latest box that it was found for.
    seen_until: Timestamp,
}

impl LiveMatches {
    /// The receiver that the target under a tracker's id carries, which is seen without a gap since then.
    #[must_use]
    pub fn get(&self, tracker_id: &TargetId, seen_since: Timestamp) -> Option<&ReceiverMatch> {
        let held = self.0.get(tracker_id).filter(|own| own.seen_until >= seen_since)?;
        Some(&held.receiver_match)
    }

    /// The trackers' ids that were matched with a receiver.
    pub fn trackers_of(&self, receiver_id: &ReceiverId) -> impl Iterator<Item = &TargetId> {
        let is_its = move |own: &&HeldMatch| own.receiver_match.receiver_id == *receiver_id;
        self.0.iter().filter(move |(_, own)| is_its(own)).map(|(tracker_id, _)| tracker_id)
    }

    /// The matches after the window's boxes were matched again. Of each tracker's id the piece with its latest box counts:
    /// what was found before a cut is no evidence about the target after it.
    #[must_use]
    pub fn updated(
        &self,
        matching: &Matching,
        detections: &[Detection],
        settings: &LiveMatchSettings,
    ) -> Self {
        let mut latest: BTreeMap<&TargetId, Timestamp> = BTreeMap::new();
        for own in detections {
            let last = latest.entry(&own.target_id).or_insert(own.time);
            *last = own.time.max(*last);
        }
        let held = |piece: &MatchedPiece| {
            let seen_until = detections[*piece.detections.last()?].time;
            let is_current = latest.get(&piece.tracker_id) == Some(&seen_until);
            let before = self.0.get(&piece.tracker_id).map(|own| &own.receiver_match.receiver_id);
            let is_held = before == Some(&piece.receiver_id);
            let bound = if is_held { settings.unmatched_below } else { settings.matched_from };
            let MatchedPiece { tracker_id, receiver_id, probability, .. } = piece;
            let receiver_match =
                ReceiverMatch { receiver_id: receiver_id.clone(), probability: *probability };
            (is_current && *probability >= bound)
                .then(|| (tracker_id.clone(), HeldMatch { receiver_match, seen_until }))
        };
        Self(matching.pieces.iter().filter_map(held).collect())
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

    fn target(id: &str) -> TargetId {
        TargetId::new(id).expect("an id")
    }

    fn detection(tracker_id: &str, seconds: i64) -> Detection {
        Detection {
            time: at(seconds),
            target_id: target(tracker_id),
            bounding_box: BoundingBox::new(10.0, 10.0, 20.0, 50.0).expect("a box"),
            class: None,
            score: None,
        }
    }

    fn push_fix(window: &mut LiveWindow, name: &str, seconds: i64) {
        let fix = Fix { position: Position::new(11.0, 48.0).expect("a position"), sigma_m: None };
        let received = ReceivedFix { time: at(seconds), receiver_id: None, fix };
        window.push_fix(ReceiverId::new(name).expect("an id"), received);
    }

    /// The matches after a round that found these pieces: receiver, probability, detections.
    fn after(
        matches: &LiveMatches,
        detections: &[Detection],
        pieces: &[(&str, f64, &[usize])],
    ) -> LiveMatches {
        let piece = |(receiver_id, probability, own): &(&str, f64, &[usize])| MatchedPiece {
            tracker_id: detections[own[0]].target_id.clone(),
            detections: own.to_vec(),
            receiver_id: ReceiverId::new(receiver_id).expect("an id"),
            probability: *probability,
        };
        let matching = Matching { pieces: pieces.iter().map(piece).collect(), ..Matching::default() };
        matches.updated(&matching, detections, &LiveMatchSettings::default())
    }

    fn receiver(matches: &LiveMatches, seen_since: i64) -> Option<&str> {
        matches.get(&target("7"), at(seen_since)).map(|own| own.receiver_id.as_str())
    }

    #[test]
    fn a_match_begins_when_sure_and_stays_until_it_is_unlikely() {
        let detections = [detection("7", 0), detection("7", 60)];
        let mut matches = LiveMatches::default();
        for (name, probability, expected) in [
            ("a", 0.85, None),
            ("a", 0.95, Some("a")),
            ("a", 0.65, Some("a")),
            ("b", 0.80, None),
            ("a", 0.65, None),
            ("b", 0.92, Some("b")),
        ] {
            matches = after(&matches, &detections, &[(name, probability, &[0, 1])]);
            assert_eq!(receiver(&matches, 0), expected, "{name} {probability}");
        }
    }

    #[test]
    fn the_piece_with_the_latest_box_counts() {
        let detections = [detection("7", 0), detection("7", 60)];
        let found = after(&LiveMatches::default(), &detections, &[("a", 0.99, &[0]), ("b", 0.95, &[1])]);
        assert_eq!(receiver(&found, 0), Some("b"));
        // The number has moved on to somebody without a receiver.
        let moved_on = after(&found, &detections, &[("b", 0.99, &[0])]);
        assert_eq!(receiver(&moved_on, 0), None);
    }

    #[test]
    fn a_number_that_is_used_again_is_not_matched() {
        let mut window = LiveWindow::new(LiveMatchSettings::default());
        let detections: Vec<Detection> = (0..20).map(|seconds| detection("7", seconds)).collect();
        detections.iter().for_each(|own| window.push_detection(own.clone()));
        let all: Vec<usize> = (0..20).collect();
        let matches = after(&LiveMatches::default(), &detections, &[("a", 0.99, &all)]);
        let since = |window: &LiveWindow| window.seen_since(&target("7")).expect("seen");
        assert!(matches.get(&target("7"), since(&window)).is_some());
        window.push_detection(detection("7", 22));
        assert!(matches.get(&target("7"), since(&window)).is_some());
        window.push_detection(detection("7", 26));
        assert!(matches.get(&target("7"), since(&window)).is_none());
    }

    #[test]
    fn a_window_is_bounded_in_time_and_number() {
        let settings =
            LiveMatchSettings { max_rows: 1_000, max_receivers: 1, ..LiveMatchSettings::default() };
        let mut window = LiveWindow::new(settings);
        for seconds in 0..1_000 {
            // The same number twice in a frame, and one that is never seen again.
            for tracker_id in ["1", "1", &format!("new-{seconds}")] {
                window.push_detection(detection(tracker_id, seconds));
            }
            push_fix(&mut window, "a", seconds);
            push_fix(&mut window, "b", seconds);
        }
        let (detections, fixes) = window.recording();
        assert_eq!((detections.len(), fixes.len()), (2 * 301, 301));
        assert_eq!((window.trackers.len(), window.receivers.len()), (302, 1));
        assert!(detections.iter().all(|own| own.time >= at(699)));
        // A thousand numbers at once.
        for number in 0..3_000 {
            window.push_detection(detection(&format!("many-{number}"), 1_000));
        }
        assert_eq!((window.detections.len(), window.trackers.len()), (1_000, 1_000));
    }

    #[test]
    fn a_recording_that_begins_again_begins_a_window() {
        let mut window = LiveWindow::new(LiveMatchSettings::default());
        window.push_detection(detection("7", 10_000));
        // A straggler does not move the window back.
        window.push_detection(detection("8", 0));
        assert_eq!(window.recording().0, [detection("7", 10_000)]);
        for seconds in 0..100 {
            window.push_detection(detection("9", seconds));
        }
        let times = window.recording().0.iter().map(|own| own.time).min();
        assert_eq!(times, Some(at(i64::from(RESTART_AFTER) - 2)));
    }
}
