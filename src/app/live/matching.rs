//! Live boxes that have only a tracker's id, matched with the receivers whose fixes come beside them.
//!
//! Boxes and fixes go into a window of their camera. At most once a second a thread of its own matches a copy of the
//! window and publishes which tracker's id shows the carrier of which receiver; an answer reads what was published last
//! and waits for nothing.

use std::sync::Mutex;
use std::time::Duration;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::sync::lock;
use crate::domain::{
    Detection, Observation, ReceivedFix, ReceiverId, ReceiverMatch, Receivers, Result, TargetId,
};
use crate::fusion::association::{
    Cancellation, LiveMatchSettings, LiveMatches, LiveWindow, MatchSettings, match_with_model,
};
use crate::model::Regressor;

/// Least time between the starts of two rounds of matching.
pub(super) const MIN_PERIOD: Duration = Duration::from_secs(1);
/// Matching of one camera takes at most this share of a core; all cameras together take one core.
pub(super) const MAX_LOAD: f64 = 0.1;
/// Seed of the sampler: the same window gives the same matches.
pub(super) const SEED: u64 = 1;

/// The matching of one camera.
pub(super) struct LiveMatching {
    settings: LiveMatchSettings,
    state: Mutex<State>,
}

struct State {
    window: LiveWindow,
    matches: LiveMatches,
    is_running: bool,
    /// Earliest start of the next round, by the monotonic clock.
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

impl LiveMatching {
    /// Takes a box of a tracker's id, or a fix of a receiver; the receiver of the box by the latest round.
    pub(super) fn observe(&self, observation: &Observation) -> Option<ReceiverMatch> {
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

    /// True if the carrier of a receiver is in view, by the latest round.
    pub(super) fn shows(&self, receiver_id: &ReceiverId) -> bool {
        let state = lock(&self.state);
        state.matches.trackers_of(receiver_id).any(|tracker_id| state.window.is_in_view(tracker_id))
    }

    /// True if a round is to begin now, by the monotonic clock; [`Self::end_round`] ends it.
    pub(super) fn begin_round(&self, now: Duration) -> bool {
        let mut state = lock(&self.state);
        let begins = !state.is_running && now >= state.next_at && state.window.can_be_matched();
        state.is_running |= begins;
        begins
    }

    /// Matches the window and publishes the matches.
    ///
    /// # Errors
    /// As [`match_with_model`]; the matches stay as they were.
    pub(super) fn run_round(&self, regressor: &Regressor) -> Result<()> {
        let (detections, fixes) = lock(&self.state).window.recording();
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        // Fixes have the camera's time already.
        let (receivers, settings) = (Receivers::default(), MatchSettings::default());
        let never = Cancellation::NEVER;
        let matching =
            match_with_model(&detections, &fixes, &receivers, regressor, &settings, &mut random, never)?;
        let mut state = lock(&self.state);
        state.matches = state.matches.updated(&matching, &detections, &self.settings);
        Ok(())
    }

    /// Ends a round that began at `begun`, by the monotonic clock, and took `taken`.
    pub(super) fn end_round(&self, begun: Duration, taken: Duration) {
        let mut state = lock(&self.state);
        state.is_running = false;
        state.next_at = begun + MIN_PERIOD.max(taken.div_f64(MAX_LOAD));
    }

    /// True if a match is sure enough for a sample.
    pub(super) fn is_sure(&self, matched: &ReceiverMatch) -> bool {
        matched.probability >= self.settings.matched_from
    }
}
