//! Training runs of a camera: its samples, the fit, and the model version that it gives.

use super::promotion::{self, PromotionCandidate};
use super::run_jobs::{Trained, Update, finish, report};
use super::{JobIdentity, Work, load_samples, load_unpaired};
use crate::app::App;
use crate::domain::{
    CameraId, GnssBiasSigma, HeldOutSampleError, JobState, Result, Sample, TimeRange, TrainingRun,
};
use crate::model::{self, Artifact, FitEvent, FitInput, FitOptions};
use crate::store::{Claim, NewModel, RunEnd, RunOutput, SampleFilter};

/// A fitted model, its held-out error on each sample, and the samples.
pub(super) struct Fitted {
    artifact: Artifact,
    held_out: Vec<HeldOutSampleError>,
    samples: Vec<Sample>,
}

impl Trained for CameraId {
    const NAME: &'static str = "training run";
    type Fitted = Fitted;

    fn identity(run: &TrainingRun<Self>) -> JobIdentity<'_> {
        JobIdentity { id: run.id.0, camera: Some(&run.subject), site: None, attempt: run.attempt }
    }

    async fn prepare(app: &App, claim: &Claim<TrainingRun<Self>>) -> Result<Work<TrainingRun<Self>>> {
        let run = &claim.job;
        let camera = app.store.camera(&run.subject).await?;
        let filter =
            SampleFilter { from: run.options.from, until: run.options.until, ..SampleFilter::default() };
        let samples = load_samples(app, &run.subject, &filter, app.limits.samples_per_run).await?;
        let unpaired = load_unpaired(app, &run.subject, &filter).await?;
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
            let known_points = &camera.profile.known_points;
            let input = FitInput { samples: &samples, unpaired: &unpaired, known_points };
            let fitted = model::fit(input, &options, &mut |event| {
                if let FitEvent::HeldOut(errors) = event {
                    held_out = errors.to_vec();
                }
                report(sink, event)
            });
            fitted.map(|artifact| Fitted { artifact, held_out, samples })
        }))
    }

    async fn record_details(app: &App, claim: &Claim<TrainingRun<Self>>, update: &Update) -> Result<()> {
        let (run, now) = (claim.job.id, app.clock.now());
        if !update.epochs.is_empty() {
            app.store.append_epochs(run, claim.fence, &update.epochs).await?;
        }
        for note in &update.notes {
            app.store.append_log(run, claim.fence, now, note).await?;
        }
        Ok(())
    }

    async fn succeed(
        app: &App,
        claim: &Claim<TrainingRun<Self>>,
        Fitted { artifact, held_out, samples }: Fitted,
    ) -> Result<Option<JobState>> {
        let TrainingRun { subject: camera, options, .. } = &claim.job;
        let range = TimeRange::new(options.from, options.until)?;
        let candidate =
            PromotionCandidate { artifact: &artifact, samples: &samples, held_out: &held_out, range };
        let decision = promotion::decide(app, camera, &candidate).await?;
        let stored = promotion::stored_errors(&held_out);
        let model = NewModel { metadata: &artifact.metadata, weights: &artifact.weights, held_out: &stored };
        let output = RunOutput { model, activate: decision.activate };
        let end = RunEnd::Succeeded { output, outcome: Some(decision.reason.clone()) };
        let ended = finish(app, claim, &decision.reason, end).await?;
        if decision.activate && ended.is_some() {
            app.registry.refresh_camera(&app.store, camera).await?;
        }
        Ok(ended)
    }
}
