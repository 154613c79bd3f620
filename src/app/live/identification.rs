//! The receivers of live boxes that have only a tracker's id, and the rounds of matching that find them.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::Live;
use crate::app::registry::ActiveCamera;
use crate::clock::Clock;
use crate::domain::{Observation, ReceiverId, ReceiverMatch, TargetId, TrackerId};

/// Rounds of all cameras: one at a time. A camera that finds another's round under way tries again with its next box.
#[derive(Clone)]
pub(in crate::app) struct MatchingSlot(Arc<Semaphore>);

impl MatchingSlot {
    /// The slot, if no round is under way.
    pub(super) fn take(&self) -> Option<OwnedSemaphorePermit> {
        self.0.clone().try_acquire_owned().ok()
    }
}

impl Default for MatchingSlot {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(1)))
    }
}

/// An observation with the receiver that its box was matched with.
pub(super) struct Identified {
    /// Its target is that of the tracker's id, where only that is known: a receiver is an attribute of it.
    pub(super) observation: Observation,
    /// The receiver, if the box was matched.
    pub(super) receiver_match: Option<ReceiverMatch>,
    /// True if its target is sure enough for a sample.
    pub(super) is_sure: bool,
}

impl Identified {
    /// The observation as a sample has it: a box has the target of the receiver's fixes.
    pub(super) fn of_sample(&self) -> Observation {
        let target_id = self.receiver_match.as_ref().map(|own| TargetId::from(own.receiver_id.clone()));
        let observation = self.observation.clone();
        match target_id {
            Some(target_id) => observation.with_target(target_id),
            None => observation,
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

impl Live<'_> {
    /// Says which receiver the target of a box carries that has only a tracker's id, and takes boxes and fixes into the
    /// matching. In a site it is that of the world track. Without a model nothing is matched, and a camera that learns
    /// records both.
    pub(super) fn identify(&self, camera: &Arc<ActiveCamera>, observation: Observation) -> Identified {
        if camera.is_learning() {
            camera.live.learning.observe(&observation);
        }
        let Some(tracker_id) = observation.tracker_id().cloned() else {
            if camera.site.is_none() && camera.model().is_some() {
                camera.live.matching.observe(&observation);
            }
            return Identified { observation, receiver_match: None, is_sure: true };
        };
        let receiver_match = camera.model().and_then(|_| self.matched(camera, &observation, &tracker_id));
        let is_sure = receiver_match.as_ref().is_some_and(|own| camera.live.matching.is_sure(own));
        let observation = observation.with_target(TargetId::from(&tracker_id));
        Identified { observation, receiver_match, is_sure }
    }

    /// True if an observation is a fix alone of a receiver whose carrier boxes show by now: for a place it is the target of the
    /// boxes.
    pub(super) fn is_fix_of_shown_carrier(&self, camera: &ActiveCamera, observation: &Observation) -> bool {
        let (None, Some(target_id)) = (observation.bounding_box(), observation.target_id()) else {
            return false;
        };
        let receiver_id = ReceiverId::from(target_id.clone());
        match &camera.site {
            Some(site) => self.site_registry.get(site).is_some_and(|site| site.live.shows(&receiver_id)),
            None => camera.live.matching.shows(&receiver_id),
        }
    }

    /// The receiver of a box, by the rounds of the camera's site, or else of the camera.
    fn matched(
        &self,
        camera: &Arc<ActiveCamera>,
        observation: &Observation,
        tracker_id: &TrackerId,
    ) -> Option<ReceiverMatch> {
        match &camera.site {
            Some(site) => {
                let site = self.site_registry.get(site)?;
                site.live.receiver_of(&camera.id, &TargetId::from(tracker_id))
            }
            None => {
                let matched = camera.live.matching.observe(observation);
                self.match_window(camera);
                matched
            }
        }
    }

    /// Begins a round of matching if it is time for one and none is under way.
    fn match_window(&self, camera: &Arc<ActiveCamera>) {
        let now = self.clock.monotonic();
        let Some(slot) = self.matching_slot.take() else { return };
        if camera.live.matching.begin_round(now) {
            let round = Round { camera: camera.clone(), clock: self.clock.clone(), begun: now, _slot: slot };
            self.tasks.spawn_blocking(move || round.run());
        }
    }
}
