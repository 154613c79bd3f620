//! Training a camera again after it was moved, until a version fits: attempts with growing pauses.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::sync::lock;
use crate::app::registry::{ActiveCamera, Registry};
use crate::app::{App, RunRequest, Training};
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{CameraKey, CameraMoved, Error, JobState, Result};
use crate::store::Store;

/// Pauses grow up to this many doublings.
const MOST_DOUBLINGS: u32 = 6;

/// When each moved camera is looked at next. Kept in memory: a restart tries at once.
#[derive(Default)]
pub(in crate::app) struct RetrainSchedule(Mutex<HashMap<(CameraKey, u32), Attempts>>);

#[derive(Debug, Clone, Copy, Default)]
struct Attempts {
    count: u32,
    next_at: Duration,
}

impl RetrainSchedule {
    /// Keeps the cameras and model versions that still wait for a version that fits.
    fn retain(&self, waiting: &[(CameraKey, u32)]) {
        lock(&self.0).retain(|key, _| waiting.contains(key));
    }

    /// True if an attempt is due; then the next one is after `pause`, doubled with every attempt.
    fn take_due(&self, key: (CameraKey, u32), now: Duration, pause: Duration) -> bool {
        let mut schedule = lock(&self.0);
        let attempts = schedule.entry(key).or_default();
        if now < attempts.next_at {
            return false;
        }
        attempts.next_at = now + pause * 2_u32.pow(attempts.count.min(MOST_DOUBLINGS));
        attempts.count += 1;
        true
    }
}

/// Training runs of cameras that were moved.
#[derive(Clone, Copy)]
pub struct Retraining<'a> {
    store: &'a Store,
    registry: &'a Registry,
    training: Training<'a>,
    schedule: &'a RetrainSchedule,
    clock: &'a Clock,
    limits: &'a Limits,
}

impl App {
    /// Training runs of cameras that were moved.
    #[must_use]
    pub fn retraining(&self) -> Retraining<'_> {
        Retraining {
            store: &self.store,
            registry: &self.registry,
            training: self.training(),
            schedule: &self.retrain_schedule,
            clock: &self.clock,
            limits: &self.limits,
        }
    }
}

impl Retraining<'_> {
    /// Starts a training run for every camera that was moved and is to be trained again by itself, and
    /// another one when that run failed or its version was not promoted. To be called every few seconds:
    /// a camera costs nothing until its next attempt is due.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn start_due(&self) -> Result<()> {
        let waiting = self.registry.select(|camera| camera.retrain_when_moved && camera.moved.is_some());
        let key = |camera: &Arc<ActiveCamera>| Some((camera.key, camera.moved.as_ref()?.model_version));
        let keys: Vec<_> = waiting.iter().filter_map(key).collect();
        self.schedule.retain(&keys);
        let (now, pause) = (self.clock.monotonic(), Duration::from_secs(self.limits.retrain_pause_s.into()));
        for (camera, key) in waiting.iter().zip(keys) {
            if let Some(moved) = &camera.moved
                && self.schedule.take_due(key, now, pause)
            {
                self.retrain(camera, moved).await?;
            }
        }
        Ok(())
    }

    async fn retrain(&self, camera: &ActiveCamera, moved: &CameraMoved) -> Result<()> {
        let id = &camera.id;
        match self.store.retraining_state(id, moved.model_version).await? {
            // A run under way, or the operator's decision against one.
            Some(JobState::Queued | JobState::Running | JobState::Cancelling | JobState::Cancelled) => {
                return Ok(());
            }
            // The camera still answers by the version that no longer fits.
            None | Some(JobState::Failed | JobState::Succeeded) => {}
        }
        let request = RunRequest { from: Some(moved.onset_at), ..RunRequest::default() };
        match self.training.start(id, request, None).await {
            Ok(run) => {
                self.store.note_retraining(id, moved.model_version, run.id).await?;
                tracing::info!(camera.id = %id, run.id = %run.id, "training again, because the camera was moved");
                Ok(())
            }
            // Too few samples since then, or another run is live: at the next attempt.
            Err(Error::Refused(refusal)) => {
                tracing::debug!(camera.id = %id, %refusal, "cannot train the moved camera yet");
                Ok(())
            }
            Err(fault) => Err(fault),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_are_due_at_once_then_after_growing_pauses() {
        let (schedule, key) = (RetrainSchedule::default(), (CameraKey(1), 1));
        let pause = Duration::from_secs(15);
        let due: Vec<u64> = (0..2_000)
            .step_by(2)
            .filter(|second| schedule.take_due(key, Duration::from_secs(*second), pause))
            .collect();
        assert_eq!(due, [0, 16, 46, 106, 226, 466, 946, 1_906]);
        schedule.retain(&[(CameraKey(2), 1)]);
        assert!(schedule.take_due(key, Duration::ZERO, pause), "another version begins again");
    }
}
