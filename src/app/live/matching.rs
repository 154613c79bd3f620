//! Live boxes that have only a tracker's id, matched with the receivers whose fixes come beside them.
//!
//! Boxes and fixes go into a window of their camera. At most once a second a thread of its own matches a copy of the
//! window and publishes which tracker's id shows the carrier of which receiver; an answer reads what was published last
//! and waits for nothing.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::sync::lock;
use crate::app::App;
use crate::app::registry::ActiveCamera;
use crate::clock::Clock;
use crate::domain::{Detection, Observation, ReceivedFix, ReceiverId, ReceiverMatch, Receivers, TargetId};
use crate::fusion::association::{
    LiveMatchSettings, LiveMatches, LiveWindow, MatchSettings, match_with_model,
};

/// Time from the begin of one round of matching to that of the next at least.
const MIN_PERIOD: Duration = Duration::from_secs(1);
/// Matching of one camera takes at most this share of a core; all cameras together take one core.
const MAX_LOAD: f64 = 0.1;
/// Seed of the sampler: the same window gives the same matches.
const SEED: u64 = 1;

/// Rounds of all cameras: one at a time. A camera that finds another's round under way tries again with its next box.
pub(in crate::app) struct MatchingSlot(Arc<Semaphore>);

impl Default for MatchingSlot {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(1)))
    }
}

/// The matching of one camera.
pub(super) struct LiveMatching {
    settings: LiveMatchSettings,
    state: Mutex<State>,
}

struct State {
    window: LiveWindow,
    matches: LiveMatches,
    is_running: bool,
    /// Earliest begin of the next round, by the monotonic clock.
    next_at: Duration,
}

impl Default for LiveMatching {
    fn default() -> Self {
        let settings = LiveMatchSettings::default();
        let state = State {
            window: LiveWindow::new(settings),
            matches: LiveMatches::default(),
            is_running: false,
            next_at: Duration::ZERO,
        };
        Self { settings, state: Mutex::new(state) }
    }
}

/// An observation with the target that its box was matched with.
pub(super) struct Identified {
    /// Its target is that of the receiver, else that of the tracker's id.
    pub(super) observation: Observation,
    /// The receiver, if the box was matched.
    pub(super) receiver_match: Option<ReceiverMatch>,
    /// Whether its target is sure enough for a sample.
    pub(super) is_sure: bool,
}

impl LiveMatching {
    /// Takes a box of a tracker's id, or a fix of a receiver; the receiver of the box by the latest round.
    fn observe(&self, observation: &Observation) -> Option<ReceiverMatch> {
        let time = observation.time();
        match (observation.tracker_id(), observation.bounding_box(), observation.fix()) {
            (Some(tracker_id), Some(bounding_box), _) => {
                let target_id = TargetId::from(tracker_id);
                let detection =
                    Detection { time, target_id: target_id.clone(), bounding_box, class: None, score: None };
                let mut state = lock(&self.state);
                state.window.push_detection(detection);
                let seen_since = state.window.seen_since(&target_id)?;
                state.matches.get(&target_id, seen_since).cloned()
            }
            (None, None, Some(fix)) => {
                // The target of a receiver that nobody has bound is its own id.
                let receiver_id = ReceiverId::from(observation.target_id()?.clone());
                let received = ReceivedFix { time, receiver_id: None, fix };
                lock(&self.state).window.push_fix(receiver_id, received);
                None
            }
            _ => None,
        }
    }

    /// Whether a round is to begin now.
    fn begin_round(&self, now: Duration) -> bool {
        let mut state = lock(&self.state);
        let begins = !state.is_running && now >= state.next_at && state.window.can_be_matched();
        state.is_running |= begins;
        begins
    }

    /// Matches the window and publishes the matches.
    fn run_round(&self, camera: &ActiveCamera) {
        let Some((regressor, _)) = camera.model() else { return };
        let (detections, fixes) = lock(&self.state).window.recording();
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        // Fixes have the camera's time already.
        let (receivers, settings) = (Receivers::default(), MatchSettings::default());
        match match_with_model(&detections, &fixes, &receivers, regressor, &settings, &mut random) {
            Ok(matching) => {
                let mut state = lock(&self.state);
                state.matches = state.matches.updated(&matching, &detections, &self.settings);
            }
            Err(error) => {
                tracing::warn!(camera.id = %camera.id, %error, "live boxes cannot be matched with receivers");
            }
        }
    }
}

/// A round of matching; dropped at its end, or where it panics.
struct Round {
    camera: Arc<ActiveCamera>,
    clock: Clock,
    begun: Duration,
    _slot: OwnedSemaphorePermit,
}

impl Drop for Round {
    fn drop(&mut self) {
        let taken = self.clock.monotonic().saturating_sub(self.begun);
        let mut state = lock(&self.camera.live.matching.state);
        state.is_running = false;
        state.next_at = self.begun + MIN_PERIOD.max(taken.div_f64(MAX_LOAD));
    }
}

impl App {
    /// Gives a box that has only a tracker's id the target of the receiver that it was matched with, and takes boxes and
    /// fixes into the matching. Without a model nothing is matched.
    pub(super) fn identify(&self, camera: &Arc<ActiveCamera>, observation: Observation) -> Identified {
        let matching = &camera.live.matching;
        let receiver_match = camera.model().and_then(|_| matching.observe(&observation));
        let Some(tracker_id) = observation.tracker_id() else {
            return Identified { observation, receiver_match: None, is_sure: true };
        };
        self.match_window(camera);
        let target_id = match &receiver_match {
            Some(matched) => TargetId::from(matched.receiver_id.clone()),
            None => TargetId::from(tracker_id),
        };
        let bound = matching.settings.matched_from;
        let is_sure = receiver_match.as_ref().is_some_and(|matched| matched.probability >= bound);
        Identified { observation: observation.with_target(target_id), receiver_match, is_sure }
    }

    /// Begins a round of matching if it is time for one and none is under way.
    fn match_window(&self, camera: &Arc<ActiveCamera>) {
        let now = self.clock.monotonic();
        let Ok(slot) = self.matching_slot.0.clone().try_acquire_owned() else { return };
        if camera.live.matching.begin_round(now) {
            let round = Round { camera: camera.clone(), clock: self.clock.clone(), begun: now, _slot: slot };
            self.tasks.spawn_blocking(move || round.camera.live.matching.run_round(&round.camera));
        }
    }
}
