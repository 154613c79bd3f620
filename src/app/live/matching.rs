//! Live boxes that have only a tracker's id, matched with the receivers whose fixes come beside them.
//!
//! Boxes and fixes go into a window of their camera. Every few seconds a thread matches the window and publishes
//! which tracker's id shows the carrier of which receiver; an answer reads what was published last and
//! waits for nothing.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use arc_swap::ArcSwap;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::sync::lock;
use crate::app::App;
use crate::app::registry::ActiveCamera;
use crate::domain::{Detection, Observation, ReceivedFix, ReceiverId, ReceiverMatch, Receivers, TargetId};
use crate::fusion::association::{
    LiveMatchSettings, LiveMatches, LiveWindow, MatchSettings, match_with_model,
};

/// Time between two rounds of matching at least.
const LEAST_PERIOD: Duration = Duration::from_secs(1);
/// Matching of one camera takes at most this share of a core.
const LARGEST_LOAD: f64 = 0.1;
/// Seed of the sampler: the same window gives the same matches.
const SEED: u64 = 1;

/// The matching of one camera.
pub(super) struct LiveMatching {
    state: Mutex<State>,
    matches: ArcSwap<LiveMatches>,
}

struct State {
    window: LiveWindow,
    is_running: bool,
    /// Earliest begin of the next round, by the monotonic clock.
    next_at: Duration,
}

impl Default for LiveMatching {
    fn default() -> Self {
        let window = LiveWindow::new(LiveMatchSettings::default());
        let state = State { window, is_running: false, next_at: Duration::ZERO };
        Self { state: Mutex::new(state), matches: ArcSwap::default() }
    }
}

/// An observation with the target that its box was matched with.
pub(super) struct Identified {
    /// Its target is that of the receiver, else the tracker's id.
    pub(super) observation: Observation,
    /// The receiver, if the match is sure.
    pub(super) receiver_match: Option<ReceiverMatch>,
}

impl Identified {
    /// Whether nobody knows whose box it is.
    pub(super) const fn is_unmatched(&self) -> bool {
        self.observation.tracker_id().is_some() && self.receiver_match.is_none()
    }
}

impl LiveMatching {
    /// Takes a box of a tracker's id, or a fix of a receiver; the receiver of the box as published last.
    fn observe(&self, observation: &Observation) -> Option<ReceiverMatch> {
        match (observation.tracker_id(), observation.bounding_box(), observation.fix()) {
            (Some(tracker_id), Some(bounding_box), _) => {
                let time = observation.time();
                let target_id = tracker_id.clone();
                let detection = Detection { time, target_id, bounding_box, class: None, score: None };
                lock(&self.state).window.push_detection(detection);
                self.matches.load().get(tracker_id).cloned()
            }
            (None, None, Some(fix)) => {
                // The target of a receiver that nobody has bound is its own id.
                let receiver_id = ReceiverId::from(observation.target_id()?.clone());
                let received =
                    ReceivedFix { time: observation.time(), receiver_id: Some(receiver_id.clone()), fix };
                lock(&self.state).window.push_fix(&receiver_id, received);
                None
            }
            _ => None,
        }
    }

    /// Whether a round is to begin now; then it must be ended by [`Self::end_round`].
    fn begin_round(&self, now: Duration) -> bool {
        let mut state = lock(&self.state);
        if state.is_running || now < state.next_at {
            return false;
        }
        state.next_at = now + LEAST_PERIOD;
        state.window.prune();
        state.is_running = state.window.can_be_matched();
        state.is_running
    }

    fn end_round(&self, begun: Duration, ended: Duration) {
        let taken = ended.saturating_sub(begun);
        let mut state = lock(&self.state);
        state.is_running = false;
        state.next_at = begun + LEAST_PERIOD.max(taken.div_f64(LARGEST_LOAD));
    }

    /// Matches the window and publishes the matches.
    fn run_round(&self, camera: &ActiveCamera) {
        let Some((regressor, _)) = camera.model() else { return };
        let (detections, fixes) = lock(&self.state).window.recording();
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        // Clocks are corrected before fixes come into the window.
        let (receivers, settings) = (Receivers::default(), MatchSettings::default());
        match match_with_model(&detections, &fixes, &receivers, regressor, &settings, &mut random) {
            Ok(matching) => {
                let matches =
                    self.matches.load().updated(&matching, &detections, &LiveMatchSettings::default());
                self.matches.store(Arc::new(matches));
            }
            Err(error) => {
                tracing::warn!(camera.id = %camera.id, %error, "live boxes cannot be matched with receivers");
            }
        }
    }
}

impl App {
    /// Gives a box that has only a tracker's id the target of the receiver that it was matched with, and takes boxes and
    /// fixes into the matching.
    pub(super) fn identify(&self, camera: &Arc<ActiveCamera>, observation: Observation) -> Identified {
        let matching = &camera.live.matching;
        let receiver_match = matching.observe(&observation);
        let is_candidate = observation.tracker_id().is_some() && camera.model.is_some();
        let now = self.clock.monotonic();
        if is_candidate && matching.begin_round(now) {
            let (camera, clock) = (camera.clone(), self.clock.clone());
            self.tasks.spawn_blocking(move || {
                camera.live.matching.run_round(&camera);
                camera.live.matching.end_round(now, clock.monotonic());
            });
        }
        let target_id = match (&receiver_match, observation.tracker_id()) {
            (Some(matched), _) => Some(TargetId::from(matched.receiver_id.clone())),
            (None, Some(tracker_id)) => Some(tracker_id.clone()),
            (None, None) => None,
        };
        let observation = match target_id {
            Some(target_id) => observation.with_target(target_id),
            None => observation,
        };
        Identified { observation, receiver_match }
    }
}
