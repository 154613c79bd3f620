//! Cameras that learn by themselves: what is recorded, what is missing, and what becomes of boxes that were matched.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use super::live::{LearningProgress, Live};
use super::recording::Recording;
use super::registry::{ActiveCamera, Registry};
use super::samples::{ImportOptions, Samples};
use super::training::Training;
use super::{App, RunRequest};
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{
    CameraId, JobState, RecordingBounds, RecordingPart, Result, RunId, StoredSample, TrainingRun,
};
use crate::exchange::{read_recording, write_recording};
use crate::store::Store;

/// How far a camera has come on its way to a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LearningState {
    /// The profile switches it off.
    Off,
    /// Boxes and fixes are recorded; the message says what is missing.
    Recording,
    /// Boxes are matched with receivers.
    Matching,
    /// A training run is queued or running.
    Training,
    /// A model answers.
    Learned,
}

/// The recording that a camera learns from, and what is missing in it.
#[derive(Debug, Clone)]
pub struct Learning {
    /// How far it has come.
    pub state: LearningState,
    /// The same in a sentence for the operator, with what to do.
    pub message: String,
    /// Time in which boxes and fixes came together, s.
    pub recorded_s: u64,
    /// Time that is recorded before boxes are matched with receivers, s.
    pub needed_s: u64,
    /// Number of recorded boxes.
    pub boxes: u64,
    /// Number of recorded fixes.
    pub fixes: u64,
    /// Number of receivers with recorded fixes.
    pub receivers: u64,
    /// When boxes were matched with receivers last, since the server was started, and what came of it.
    pub last_attempt: Option<(Timestamp, String)>,
    /// The latest training run, while it has not given a model.
    pub training_run: Option<RunId>,
}

/// Recordings from which cameras learn by themselves, and the attempts to learn.
#[derive(Clone, Copy)]
pub struct Recordings<'a> {
    store: &'a Store,
    registry: &'a Registry,
    live: Live<'a>,
    samples: Samples<'a>,
    training: Training<'a>,
    clock: &'a Clock,
    limits: &'a Limits,
}

impl App {
    /// Recordings from which cameras learn by themselves, and the attempts to learn.
    #[must_use]
    pub fn recordings(&self) -> Recordings<'_> {
        Recordings {
            store: &self.store,
            registry: &self.registry,
            live: self.live(),
            samples: self.samples(),
            training: self.training(),
            clock: &self.clock,
            limits: &self.limits,
        }
    }
}

impl Recordings<'_> {
    /// The recording that a camera learns from, and what is missing in it.
    ///
    /// # Errors
    /// `CameraNotFound`, `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub async fn learning(&self, id: &CameraId) -> Result<Learning> {
        let mut camera = self.live.readable_camera(id).await?;
        let run = self.store.runs(id, None, 1).await?.pop();
        if camera.model.is_none() && run.as_ref().is_some_and(|run| run.state == JobState::Succeeded) {
            // Its version may have become active since the camera was read.
            camera = self.registry.refresh_camera(self.store, id).await?;
        }
        if camera.is_learning() {
            self.complete_extent(&camera).await?;
        }
        let progress = camera.live.learning.progress();
        let (state, message) = described(&camera, &progress, run.as_ref());
        let has_model = state == LearningState::Learned;
        Ok(Learning {
            state,
            message,
            recorded_s: progress.extent.common_s(),
            needed_s: progress.needed_s,
            boxes: progress.extent.boxes,
            fixes: progress.extent.fixes,
            receivers: progress.extent.receivers.len() as u64,
            last_attempt: progress.attempt.map(|attempt| (attempt.at, attempt.outcome)),
            training_run: run.filter(|_| !has_model).map(|run| run.id),
        })
    }

    /// Stores what cameras have recorded since the last call. To be called about once a second.
    ///
    /// # Errors
    /// A fault of the store, or `InsufficientStorage`; what was to be stored is lost.
    pub async fn store_pending(&self) -> Result<()> {
        for camera in self.registry.select(|camera| camera.live.learning.is_pending()) {
            if !camera.is_learning() {
                camera.live.learning.reset();
                continue;
            }
            self.complete_extent(&camera).await?;
            let (recording, dropped) = camera.live.learning.take_pending();
            if dropped > 0 {
                tracing::warn!(camera.id = %camera.id, dropped, "boxes and fixes to learn from came faster than they are stored");
            }
            let part = RecordingPart {
                recorded_at: self.clock.now(),
                rows: u32::try_from(recording.detections.len() + recording.fixes.len()).unwrap_or(u32::MAX),
                content: write_recording(&recording.detections, &recording.fixes),
            };
            self.store.append_recording(camera.key, &part, self.recording_bounds()).await?;
        }
        Ok(())
    }

    /// Deletes recordings that are too old, and those of cameras that have a model or do not learn.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn retain(&self) -> Result<()> {
        let age = SignedDuration::from_hours(self.limits.recording_hours.into());
        let since = self.clock.now().checked_sub(age).unwrap_or(Timestamp::MIN);
        self.store.retain_recordings(since).await.map(drop)
    }

    /// A camera whose recording is to be matched now, if there is one; [`Recordings::end_learning`] ends that.
    #[must_use]
    pub fn begin_learning(&self) -> Option<Arc<ActiveCamera>> {
        let ready = |camera: &ActiveCamera| {
            camera.is_learning() && camera.image_size.is_some() && camera.live.learning.begin_attempt()
        };
        // An attempt is begun for the camera that is returned alone.
        self.registry.find(ready)
    }

    /// Everything that a camera has recorded.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn recorded(&self, camera: &ActiveCamera) -> Result<Recording> {
        let mut recording = Recording::default();
        for content in self.store.recording(camera.key).await? {
            let (detections, fixes) = read_recording(&content)?;
            recording.detections.extend(detections);
            recording.fixes.extend(fixes);
        }
        camera.live.learning.set_stored(&recording);
        Ok(recording)
    }

    /// Notes what came of an attempt to learn.
    pub fn end_learning(&self, camera: &ActiveCamera, outcome: String) {
        camera.live.learning.end_attempt(self.clock.now(), outcome);
    }

    /// Stores samples of matched boxes and starts a training run on them.
    ///
    /// # Errors
    /// As an import of samples, and as [`Training::start`].
    pub async fn train_on_matched(
        &self,
        id: &CameraId,
        samples: Vec<StoredSample>,
    ) -> Result<TrainingRun<CameraId>> {
        self.samples.store_paired(id, samples, ImportOptions::default()).await?;
        self.training.start(id, RunRequest::default(), None).await
    }

    /// Reads what an earlier run of the server, or another node, has recorded.
    async fn complete_extent(&self, camera: &ActiveCamera) -> Result<()> {
        if !camera.live.learning.is_complete() {
            self.recorded(camera).await?;
        }
        Ok(())
    }

    fn recording_bounds(&self) -> RecordingBounds {
        RecordingBounds { rows: self.limits.recording_rows, bytes: self.limits.recording_bytes }
    }
}

impl ActiveCamera {
    /// True if the camera records unpaired boxes and fixes.
    #[must_use]
    pub const fn is_learning(&self) -> bool {
        self.learn_automatically && self.model.is_none() && self.model_fault.is_none()
    }
}

/// The state, and what is missing in words.
fn described(
    camera: &ActiveCamera,
    progress: &LearningProgress,
    run: Option<&TrainingRun<CameraId>>,
) -> (LearningState, String) {
    if let Some((_, version)) = &camera.model {
        let message = format!("model version {version} answers, and matches boxes with receivers");
        return (LearningState::Learned, message);
    }
    if let Some(fault) = &camera.model_fault {
        let message = format!("nothing is learnt while the active model cannot be used: {}", fault.reason);
        return (LearningState::Off, message);
    }
    if let Some(run) = run.filter(|run| !run.state.has_ended()) {
        return (LearningState::Training, format!("training run {} is {}", run.id, run.state.as_str()));
    }
    if !camera.learn_automatically {
        let message = "learn_automatically is off in the profile of the camera".to_owned();
        return (LearningState::Off, message);
    }
    if progress.is_matching {
        return (LearningState::Matching, "boxes are matched with receivers".to_owned());
    }
    (LearningState::Recording, missing(camera, progress, run))
}

/// The next requirement of a camera that records.
fn missing(
    camera: &ActiveCamera,
    progress: &LearningProgress,
    run: Option<&TrainingRun<CameraId>>,
) -> String {
    let extent = &progress.extent;
    if camera.image_size.is_none() {
        return "image_size is missing in the profile of the camera".to_owned();
    }
    if extent.boxes == 0 {
        return "no box with a tracker's id has come: connect the detector of the camera".to_owned();
    }
    if extent.fixes == 0 {
        return "no fix of a receiver has come: carry a phone through the view".to_owned();
    }
    let recorded = format!(
        "{} of about {} minutes with boxes and fixes at the same time",
        extent.common_s() / 60,
        progress.needed_s.div_ceil(60)
    );
    let failed_run = run.filter(|run| run.state == JobState::Failed).and_then(|run| run.outcome.as_deref());
    match (failed_run, &progress.attempt) {
        (Some(reason), _) => format!("the training run failed: {reason}; {recorded}"),
        (None, Some(attempt)) => format!("{}; {recorded}", attempt.outcome),
        (None, None) => recorded,
    }
}
