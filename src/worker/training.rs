//! Training runs as jobs: their samples, the fit on a thread, and the model version that it gives.

use std::time::Duration;

use super::job_thread::{JobProgress, ProgressSink};
use super::promotion::{self, PromotionCandidate};
use super::{Ended, Job, JobIdentity, Work, load_samples, load_unpaired};
use crate::app::{App, JobQueue};
use crate::domain::{
    EpochReport, Error, GnssBiasSigma, HeldOutSampleError, JobState, Result, RunProgress, Sample, TimeRange,
    TrainingRun,
};
use crate::model::{self, Artifact, FitError, FitEvent, FitInput, FitOptions};
use crate::store::{Claim, Heartbeat, NewModel, RunEnd, RunOutput, SampleFilter};
use crate::telemetry::{JobMetrics, Metrics};

/// What a fit has reported since the last look.
#[derive(Debug, Clone, Default)]
pub(super) struct Update {
    pub(super) progress: RunProgress,
    epochs: Vec<EpochReport>,
    notes: Vec<String>,
}

impl JobProgress for Update {
    fn take(&mut self) -> Self {
        let progress = self.progress.clone();
        std::mem::replace(self, Self { progress, ..Self::default() })
    }
}

impl Update {
    /// Notes that the fit is done. A recipe may do less than planned: the chosen candidate has no network, for one.
    pub(super) fn complete(&mut self) {
        self.progress.epoch = self.progress.epochs;
        self.progress.remaining_s = Some(0.0);
    }
}

/// How a fit ended, and its samples.
pub(super) struct Fitted {
    outcome: std::result::Result<Model, FitError>,
    samples: Vec<Sample>,
}

/// A fitted model, and its held-out error on each sample.
struct Model {
    artifact: Artifact,
    held_out: Vec<HeldOutSampleError>,
}

impl Job for TrainingRun {
    const NAME: &'static str = "training run";
    type Progress = Update;
    type Output = Fitted;

    fn identity(&self) -> JobIdentity<'_> {
        JobIdentity { id: self.id.0, camera: Some(&self.camera_id), site: None, attempt: self.attempt }
    }

    fn queue(app: &App) -> &JobQueue {
        &app.training_queue
    }

    fn metrics(metrics: &Metrics) -> &JobMetrics {
        &metrics.training_runs
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_run(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        let run = &claim.job;
        let camera = app.store.camera(&run.camera_id).await?;
        let filter =
            SampleFilter { from: run.options.from, until: run.options.until, ..SampleFilter::default() };
        let samples = load_samples(app, &run.camera_id, &filter, app.limits.samples_per_run).await?;
        let unpaired = load_unpaired(app, &run.camera_id, &filter).await?;
        let options = FitOptions {
            recipe: run.options.recipe,
            seed: run.options.seed,
            epochs: run.options.epochs,
            image_size: camera.profile.image_size,
            gnss_error: camera.profile.gnss_error,
            gnss_bias_sigma_m: camera.profile.gnss_bias_sigma.map(GnssBiasSigma::metres),
        };
        let line = format!(
            "{} samples and {} boxes without a fix, recipe {}, seed {}",
            samples.len(),
            unpaired.len(),
            options.recipe,
            options.seed
        );
        app.store.append_log(run.id, claim.fence, app.clock.now(), &line).await?;
        Ok(Box::new(move |sink| {
            let mut held_out = Vec::new();
            let input = FitInput { samples: &samples, unpaired: &unpaired };
            let fitted = model::fit(input, &options, &mut |event| {
                if let FitEvent::HeldOut(errors) = event {
                    held_out = errors.to_vec();
                }
                report(sink, event)
            });
            let outcome = fitted.map(|artifact| Model { artifact, held_out });
            Fitted { outcome, samples }
        }))
    }

    async fn record(app: &App, claim: &Claim<Self>, progress: Update, lease: Duration) -> Result<Heartbeat> {
        let (run, now) = (claim.job.id, app.clock.now());
        if !progress.epochs.is_empty() {
            app.store.append_epochs(run, claim.fence, &progress.epochs).await?;
        }
        for note in &progress.notes {
            app.store.append_log(run, claim.fence, now, note).await?;
        }
        app.store.heartbeat_run(run, claim.fence, &progress.progress, lease, now).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { output: Fitted { outcome, samples }, mut progress, shutting_down } = ended;
        if outcome.is_ok() {
            progress.complete();
        }
        if matches!(Self::record(app, claim, progress, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        match outcome {
            Ok(model) => succeed(app, claim, &model, &samples).await,
            Err(FitError::Cancelled) if shutting_down => {
                finish(app, claim, "returned to the queue: the server shuts down", RunEnd::Requeue).await
            }
            Err(FitError::Cancelled) => finish(app, claim, "cancelled", RunEnd::Cancelled).await,
            Err(FitError::Unusable(error)) => {
                let outcome = error.to_string();
                finish(app, claim, &outcome.clone(), RunEnd::Failed { outcome }).await
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

/// Tells an observer of the job what a fit reports.
pub(super) fn report(sink: &ProgressSink<Update>, event: FitEvent<'_>) -> std::ops::ControlFlow<()> {
    sink.update(|update| match event {
        FitEvent::Progress(progress) => {
            update.progress.clone_from(progress);
            update.progress.remaining_s = sink.remaining_s(progress.epoch, progress.epochs);
        }
        FitEvent::Epoch(report) => update.epochs.push(*report),
        FitEvent::HeldOut(_) => {}
        FitEvent::Note(line) => update.notes.push(line.to_owned()),
    })
}

async fn succeed(
    app: &App,
    claim: &Claim<TrainingRun>,
    Model { artifact, held_out }: &Model,
    samples: &[Sample],
) -> Result<Option<JobState>> {
    let TrainingRun { camera_id, options, .. } = &claim.job;
    let range = TimeRange::new(options.from, options.until)?;
    let candidate = PromotionCandidate { artifact, samples, held_out, range };
    let decision = promotion::decide(app, camera_id, &candidate).await?;
    let stored = promotion::stored_errors(held_out);
    let model = NewModel { metadata: &artifact.metadata, weights: &artifact.weights, held_out: &stored };
    let output = RunOutput { model, activate: decision.activate };
    let end = RunEnd::Succeeded { output, outcome: Some(decision.reason.clone()) };
    let ended = finish(app, claim, &decision.reason, end).await?;
    if decision.activate && ended.is_some() {
        app.registry.refresh_camera(&app.store, camera_id).await?;
    }
    Ok(ended)
}

/// Ends the run with a line in its log.
async fn finish(
    app: &App,
    claim: &Claim<TrainingRun>,
    line: &str,
    end: RunEnd<'_>,
) -> Result<Option<JobState>> {
    let (run, now) = (claim.job.id, app.clock.now());
    app.store.append_log(run, claim.fence, now, line).await?;
    Ok(app.store.finish_run(run, claim.fence, end, now).await?.map(|run| run.state))
}
