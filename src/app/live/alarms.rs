//! Residuals on their way to the drift detectors, findings of sites that a camera disagrees with the others, and the alarms
//! that come of both.
//!
//! Answers hand residuals to one task and never wait for it: detecting costs time and an alarm goes to
//! the database. If the task is too slow, residuals are dropped, for a camera that moved goes on
//! producing them. A finding is made once; sites wait until it is taken.

use std::sync::{Arc, Weak};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::app::registry::{ActiveCamera, Registry};
use crate::app::{App, Parts};
use crate::clock::Clock;
use crate::domain::{CameraId, CameraMoved, Error, ErrorKind, Observation, Result, TimeBounds};
use crate::fusion::drift_detector::ResidualSample;
use crate::fusion::observed::ObservedPositions;
use crate::store::Store;
use crate::telemetry::Metrics;

/// Residuals that wait for their detector.
const QUEUE: usize = 4_096;
/// Residuals that are taken out at once.
const BATCH: usize = 64;

/// When a finding that could not be stored is stored again.
const STORED_AGAIN_AFTER: Duration = Duration::from_secs(5);

/// What tells that a camera was moved.
enum Evidence {
    /// A box and a fix.
    Residual { camera: Arc<ActiveCamera>, residual: ResidualSample },
    /// The other cameras of its site.
    Finding(Finding),
}

/// A camera that disagrees with the others of its site.
pub(super) struct Finding {
    pub(super) camera: CameraId,
    pub(super) moved: CameraMoved,
}

/// The way to the drift detectors.
pub(in crate::app) struct ResidualQueue {
    sender: mpsc::Sender<Evidence>,
    closed: CancellationToken,
}

/// The way of a site's findings.
pub(super) struct FindingQueue(mpsc::Sender<Evidence>);

impl FindingQueue {
    /// Waits for a place. The end of the server takes none.
    pub(super) async fn send(&self, finding: Finding) {
        if self.0.send(Evidence::Finding(finding)).await.is_err() {
            tracing::debug!("a finding came after the end of the drift detectors");
        }
    }
}

impl ResidualQueue {
    /// Ends the task once it has worked off what waits now.
    pub(in crate::app) fn close(&self) {
        self.closed.cancel();
    }

    /// The way for the findings of a site.
    pub(super) fn findings(&self) -> FindingQueue {
        FindingQueue(self.sender.clone())
    }

    /// Hands a residual to the camera's drift detector.
    pub(super) fn hand_over(&self, camera: &Arc<ActiveCamera>, residual: ResidualSample) {
        if self.sender.try_send(Evidence::Residual { camera: camera.clone(), residual }).is_err() {
            tracing::debug!(camera.id = %camera.id, "a residual was dropped, the queue of the drift detectors is full");
        }
    }

    /// Hands over the residual of the last of some observations with box, fix and target: for clients who
    /// only ask for positions. One of a batch is enough.
    pub(in crate::app) fn hand_over_last(
        &self,
        camera: &Arc<ActiveCamera>,
        observations: &[(&Observation, ObservedPositions<'_>)],
        bounds: TimeBounds,
    ) {
        let residual = observations.iter().rev().find_map(|(observation, observed)| {
            let (regressed, fix) = (observed.usable_box()?.independent, observed.fix?);
            bounds.check(observation.time()).ok()?;
            Some(ResidualSample {
                time: observation.time(),
                target_id: observation.target_id().cloned()?,
                regressed: regressed.regressed,
                fix: fix.in_plane?,
                e_regression_m2: regressed.variance_m2(),
                e_gnss_m2: fix.variance_m2,
            })
        });
        if let Some(residual) = residual {
            self.hand_over(camera, residual);
        }
    }
}

/// The residuals that wait for the task.
pub(in crate::app) struct WaitingResiduals {
    receiver: mpsc::Receiver<Evidence>,
    closed: CancellationToken,
}

/// Both ends of an empty queue.
pub(in crate::app) fn residual_queue() -> (ResidualQueue, WaitingResiduals) {
    let (sender, receiver) = mpsc::channel(QUEUE);
    let closed = CancellationToken::new();
    (ResidualQueue { sender, closed: closed.clone() }, WaitingResiduals { receiver, closed })
}

impl WaitingResiduals {
    /// Feeds the detectors until the application is closed or dropped.
    pub(in crate::app) async fn run(mut self, app: Weak<Parts>) {
        let (mut batch, mut findings) = (Vec::with_capacity(BATCH), Vec::new());
        loop {
            let is_closed = tokio::select! {
                _ = self.receiver.recv_many(&mut batch, BATCH) => false,
                () = tokio::time::sleep(STORED_AGAIN_AFTER), if !findings.is_empty() => false,
                () = self.closed.cancelled() => true,
            };
            if is_closed {
                batch.extend(std::iter::from_fn(|| self.receiver.try_recv().ok()).take(QUEUE));
            }
            let has_work = !batch.is_empty() || !findings.is_empty() && !is_closed;
            let Some(parts) = app.upgrade().filter(|_| has_work) else { return };
            let app = App::of_program(parts, "drift detection");
            for evidence in batch.drain(..) {
                match evidence {
                    Evidence::Residual { camera, residual } => {
                        app.drift_alarms().detect(&camera, &residual).await;
                    }
                    Evidence::Finding(finding) => findings.push(finding),
                }
            }
            app.drift_alarms().store_findings(&mut findings).await;
            // Answers go first, and what they bring meanwhile is taken at once: waking this task for each costs more.
            tokio::task::yield_now().await;
        }
    }
}

/// Alarms that a camera was moved.
struct DriftAlarms<'a> {
    store: &'a Store,
    registry: &'a Registry,
    clock: &'a Clock,
    metrics: &'a Metrics,
}

impl App {
    fn drift_alarms(&self) -> DriftAlarms<'_> {
        DriftAlarms {
            store: &self.store,
            registry: &self.registry,
            clock: &self.clock,
            metrics: &self.metrics,
        }
    }
}

impl DriftAlarms<'_> {
    async fn detect(&self, camera: &ActiveCamera, residual: &ResidualSample) {
        let Some(model) = camera.model() else { return };
        let Some(moved) = camera.live.drift.observe(model, residual) else { return };
        // An alarm that cannot be stored is raised again with the next residual.
        if let Err(error) = self.raise(camera, moved).await {
            tracing::error!(camera.id = %camera.id, %error, "the alarm that the camera was moved cannot be stored");
        }
    }

    /// Stores what sites have found; what cannot be stored stays.
    async fn store_findings(&self, findings: &mut Vec<Finding>) {
        let mut unsaved = Vec::new();
        for finding in findings.drain(..) {
            let Some(camera) = self.registry.get(&finding.camera) else { continue };
            if camera.model().is_none_or(|(_, version)| version != finding.moved.model_version) {
                continue;
            }
            if let Err(error) = self.raise(&camera, finding.moved.clone()).await {
                tracing::error!(camera.id = %camera.id, %error, "the alarm that the camera was moved cannot be stored");
                unsaved.push(finding);
            }
        }
        *findings = unsaved;
    }

    /// Stores an alarm and announces it, once per model version.
    ///
    /// # Errors
    /// A fault of the store.
    async fn raise(&self, camera: &ActiveCamera, moved: CameraMoved) -> Result<()> {
        let id = &camera.id;
        let is_same = |current: Arc<ActiveCamera>| current.key == camera.key;
        if !self.registry.get(id).is_some_and(is_same) {
            return Ok(());
        }
        let is_new = match self.store.insert_move(id, &moved).await {
            Err(Error::Refused(refusal)) if refusal.kind == ErrorKind::CameraNotFound => return Ok(()),
            stored => stored?,
        };
        camera.live.drift.saved();
        self.registry.refresh_camera(self.store, id).await?;
        if is_new {
            tracing::warn!(
                camera.id = %id, model = moved.model_version, onset_at = %moved.onset_at,
                shift_east_m = moved.shift_east_m, shift_north_m = moved.shift_north_m,
                "the camera's pose has changed since its model was trained"
            );
            self.metrics.camera_moved();
            camera.live.announce_move(self.clock.monotonic(), Arc::new(moved));
        }
        Ok(())
    }
}
