//! The targets of live boxes that have only a tracker's id, and the rounds of matching that find them.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::app::App;
use crate::app::registry::ActiveCamera;
use crate::clock::Clock;
use crate::domain::{Observation, ReceiverMatch, TargetClass, TargetId};

/// Rounds of all cameras: one at a time. A camera that finds another's round under way tries again with its next box.
pub(in crate::app) struct MatchingSlot(Arc<Semaphore>);

impl Default for MatchingSlot {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(1)))
    }
}

/// An observation with the target that its box was matched with.
pub(super) struct Identified {
    /// Its target is that of the receiver, else that of the tracker's id.
    pub(super) observation: Observation,
    /// The receiver, if the box was matched.
    pub(super) receiver_match: Option<ReceiverMatch>,
    /// True if its target is sure enough for a sample.
    pub(super) is_sure: bool,
}

/// A round of matching; dropped at its end, or where it panics.
struct Round {
    camera: Arc<ActiveCamera>,
    clock: Clock,
    begun: Duration,
    _slot: OwnedSemaphorePermit,
}

impl Round {
    fn run(&self) {
        let Some((regressor, _)) = self.camera.model() else { return };
        if let Err(error) = self.camera.live.matching.run_round(regressor) {
            tracing::warn!(camera.id = %self.camera.id, %error, "live boxes cannot be matched with receivers");
        }
    }
}

impl Drop for Round {
    fn drop(&mut self) {
        let taken = self.clock.monotonic().saturating_sub(self.begun);
        self.camera.live.matching.end_round(self.begun, taken);
    }
}

impl App {
    /// Gives a box that has only a tracker's id the target of the receiver that it was matched with, and takes boxes and
    /// fixes into the matching. Without a model nothing is matched, and a camera that learns records both.
    pub(super) fn identify(
        &self,
        camera: &Arc<ActiveCamera>,
        observation: Observation,
        class: Option<&TargetClass>,
    ) -> Identified {
        if camera.is_learning() {
            camera.live.learning.observe(&observation, class);
        }
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
        let is_sure = receiver_match.as_ref().is_some_and(|matched| matching.is_sure(matched));
        Identified { observation: observation.with_target(target_id), receiver_match, is_sure }
    }

    /// Begins a round of matching if it is time for one and none is under way.
    fn match_window(&self, camera: &Arc<ActiveCamera>) {
        let now = self.clock.monotonic();
        let Ok(slot) = self.matching_slot.0.clone().try_acquire_owned() else { return };
        if camera.live.matching.begin_round(now) {
            let round = Round { camera: camera.clone(), clock: self.clock.clone(), begun: now, _slot: slot };
            self.tasks.spawn_blocking(move || round.run());
        }
    }
}
