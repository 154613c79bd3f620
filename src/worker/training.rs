//! Training runs as jobs: what a fit needs, says and yields.

use std::time::Duration;

use tokio::sync::Notify;
use uuid::Uuid;

use super::aside::{Said, Voice};
use super::{Ended, Job, Work, load_samples, promotion};
use crate::app::App;
use crate::domain::{CameraId, EpochReport, Error, JobState, Result, RunProgress, Sample, TrainingRun};
use crate::fusion::track::TrackSettings;
use crate::model::{self, Artifact, FitError, FitEvent, FitOptions};
use crate::store::{Claim, Heartbeat, NewModel, RunEnd, SampleFilter};
use crate::telemetry::Metrics;

/// What a fit has said since it was asked last.
#[derive(Debug, Clone, Default)]
pub(super) struct Update {
    progress: RunProgress,
    epochs: Vec<EpochReport>,
    notes: Vec<String>,
}

impl Said for Update {
    fn take(&mut self) -> Self {
        let progress = self.progress.clone();
        std::mem::replace(self, Self { progress, ..Self::default() })
    }
}

/// What a fit yielded, and from which samples.
pub(super) struct Fitted {
    outcome: std::result::Result<Artifact, FitError>,
    samples: Vec<Sample>,
}

impl Job for TrainingRun {
    const NAME: &'static str = "training run";
    type Said = Update;
    type Yield = Fitted;

    fn id(&self) -> Uuid {
        self.id.0
    }

    fn camera(&self) -> &CameraId {
        &self.camera_id
    }

    fn attempt(&self) -> u32 {
        self.attempt
    }

    fn bell(app: &App) -> &Notify {
        &app.run_queued
    }

    fn count(metrics: &Metrics, state: JobState, time: Duration) {
        metrics.training_runs.ended(state, time);
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_run(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        let run = &claim.job;
        let camera = app.store.camera(&run.camera_id).await?;
        let filter = SampleFilter { from: run.options.from, until: run.options.until, target_id: None };
        let samples = load_samples(app, &run.camera_id, &filter, app.limits.samples_per_run).await?;
        let options = FitOptions {
            recipe: run.options.recipe,
            seed: run.options.seed,
            epochs: run.options.epochs,
            image_size: camera.profile.image_size,
            gnss_error: camera.profile.gnss_error,
        };
        let line = format!("{} samples, recipe {}, seed {}", samples.len(), options.recipe, options.seed);
        app.store.append_log(run.id, claim.fence, app.clock.now(), &line).await?;
        Ok(Box::new(move |voice| {
            let outcome = model::fit(&samples, &options, &mut |event| hear(voice, event));
            let outcome = outcome.and_then(|artifact| with_track_beliefs(artifact, &samples));
            Fitted { outcome, samples }
        }))
    }

    async fn record(app: &App, claim: &Claim<Self>, said: Update, lease: Duration) -> Result<Heartbeat> {
        let (run, now) = (claim.job.id, app.clock.now());
        if !said.epochs.is_empty() {
            app.store.append_epochs(run, claim.fence, &said.epochs).await?;
        }
        for note in &said.notes {
            app.store.append_log(run, claim.fence, now, note).await?;
        }
        app.store.heartbeat(run, claim.fence, &said.progress, lease, now).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { yielded: Fitted { outcome, samples }, mut said, server_is_ending } = ended;
        if outcome.is_ok() {
            // A recipe may skip what it had counted on: a kept candidate without a network, say.
            said.progress.epoch = said.progress.epochs;
            said.progress.remaining_s = Some(0.0);
        }
        if matches!(Self::record(app, claim, said, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        match outcome {
            Ok(artifact) => succeed(app, claim, &artifact, &samples).await,
            Err(FitError::Cancelled) if server_is_ending => {
                leave(app, claim, "the server ends; the run waits", RunEnd::Requeue).await
            }
            Err(FitError::Cancelled) => leave(app, claim, "cancelled", RunEnd::Cancelled).await,
            Err(FitError::Unusable(error)) => {
                let outcome = error.to_string();
                leave(app, claim, &outcome.clone(), RunEnd::Failed { outcome }).await
            }
            Err(FitError::Fault(error)) => Err(Error::fault(error)),
        }
    }

    async fn fail(app: &App, claim: &Claim<Self>, outcome: String) -> Result<Option<JobState>> {
        let end = RunEnd::Failed { outcome };
        let ended = app.store.finish_run(claim.job.id, claim.fence, end, app.clock.now()).await?;
        Ok(ended.map(|run| run.state))
    }
}

/// The model with what its samples tell of how errors stay, for the tracks that it will serve.
fn with_track_beliefs(mut artifact: Artifact, samples: &[Sample]) -> std::result::Result<Artifact, FitError> {
    let regressor = artifact.load().map_err(|error| FitError::Fault(error.into()))?;
    let settings = TrackSettings::estimate(samples, &regressor);
    settings.noise_model().write(&mut artifact.metadata.parameters);
    Ok(artifact)
}

fn hear(voice: &Voice<Update>, event: FitEvent<'_>) -> std::ops::ControlFlow<()> {
    voice.say(|update| match event {
        FitEvent::Progress(progress) => {
            update.progress.clone_from(progress);
            update.progress.remaining_s = voice.remaining_s(progress.epoch, progress.epochs);
        }
        FitEvent::Epoch(report) => update.epochs.push(*report),
        FitEvent::Note(line) => update.notes.push(line.to_owned()),
    })
}

async fn succeed(
    app: &App,
    claim: &Claim<TrainingRun>,
    artifact: &Artifact,
    samples: &[Sample],
) -> Result<Option<JobState>> {
    let camera = &claim.job.camera_id;
    let verdict = promotion::judge(app, camera, artifact, samples).await?;
    let yielded =
        NewModel { metadata: &artifact.metadata, weights: &artifact.weights, activate: verdict.activate };
    let end = RunEnd::Succeeded { yielded, outcome: Some(verdict.reason.clone()) };
    let ended = leave(app, claim, &verdict.reason, end).await?;
    if verdict.activate && ended.is_some() {
        app.registry.refresh_camera(&app.store, camera).await?;
    }
    Ok(ended)
}

/// Ends the run with a line in its log.
async fn leave(
    app: &App,
    claim: &Claim<TrainingRun>,
    line: &str,
    end: RunEnd<'_>,
) -> Result<Option<JobState>> {
    let (run, now) = (claim.job.id, app.clock.now());
    app.store.append_log(run, claim.fence, now, line).await?;
    Ok(app.store.finish_run(run, claim.fence, end, now).await?.map(|run| run.state))
}
