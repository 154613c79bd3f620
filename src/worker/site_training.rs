//! Training runs of sites as jobs: the samples of all cameras, the joint fit on a thread, and a model version of each
//! camera, which are activated together or not at all.

use std::time::Duration;

use super::promotion::{self, CameraPromotion, PromotionCandidate, SitePromotion};
use super::training::{Update, report};
use super::{Ended, Job, JobIdentity, Work, load_samples};
use crate::app::{App, JobQueue};
use crate::domain::{
    Camera, Error, ErrorKind, GnssBiasSigma, JobState, JointTraining, Result, Sample, SiteCameraFinding,
    SiteTrainingReport, SiteTrainingRun, TimeRange,
};
use crate::model::{self, FitError, SiteCamera, SiteCameraModel, SiteModels};
use crate::store::{Claim, Heartbeat, NewModel, SampleFilter, SiteCameraOutput, SiteRunEnd, SiteRunOutput};
use crate::telemetry::{JobMetrics, Metrics};

/// A camera with its training samples.
struct CameraSamples {
    camera: Camera,
    samples: Vec<Sample>,
}

/// How a fit ended, and its samples.
pub(super) struct Fitted {
    outcome: std::result::Result<SiteModels, FitError>,
    cameras: Vec<CameraSamples>,
}

impl Job for SiteTrainingRun {
    const NAME: &'static str = "training run of a site";
    type Progress = Update;
    type Output = Fitted;

    fn identity(&self) -> JobIdentity<'_> {
        JobIdentity { id: self.id.0, camera: None, site: Some(&self.site_id), attempt: self.attempt }
    }

    fn queue(app: &App) -> &JobQueue {
        &app.site_training_queue
    }

    fn metrics(metrics: &Metrics) -> &JobMetrics {
        &metrics.training_runs
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_site_run(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        let SiteTrainingRun { id, site_id, options, .. } = &claim.job;
        let filter = SampleFilter::within(TimeRange::new(options.from, options.until)?);
        let cameras = app.cameras_to_train(site_id).await?;
        let most = app.limits.samples_per_site_run / cameras.len() as u32;
        let mut loaded = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let samples = load_samples(app, camera.id(), &filter, most).await?;
            loaded.push(CameraSamples { camera, samples });
        }
        let joint_training = JointTraining {
            site_id: site_id.as_str().to_owned(),
            run_id: id.to_string(),
            cameras: loaded.iter().map(|own| own.camera.id().as_str().to_owned()).collect(),
        };
        let seed = options.seed;
        Ok(Box::new(move |sink| {
            let cameras: Vec<SiteCamera<'_>> = loaded.iter().map(CameraSamples::to_fit).collect();
            let outcome =
                model::fit_site_models(&cameras, &joint_training, seed, &mut |event| report(sink, event));
            Fitted { outcome, cameras: loaded }
        }))
    }

    async fn record(app: &App, claim: &Claim<Self>, progress: Update, lease: Duration) -> Result<Heartbeat> {
        let (run, now) = (claim.job.id, app.clock.now());
        app.store.heartbeat_site_run(run, claim.fence, &progress.progress, lease, now).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { output: Fitted { outcome, cameras }, mut progress, shutting_down } = ended;
        if outcome.is_ok() {
            progress.complete();
        }
        if matches!(Self::record(app, claim, progress, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        match outcome {
            Ok(models) => succeed(app, claim, &models, &cameras).await,
            Err(FitError::Cancelled) if shutting_down => finish(app, claim, SiteRunEnd::Requeue).await,
            Err(FitError::Cancelled) => finish(app, claim, SiteRunEnd::Cancelled).await,
            Err(FitError::Unusable(error)) => {
                finish(app, claim, SiteRunEnd::Failed { outcome: error.to_string() }).await
            }
            Err(FitError::Fault(error)) => Err(Error::fault(error)),
        }
    }

    async fn fail(app: &App, claim: &Claim<Self>, outcome: String) -> Result<Option<JobState>> {
        finish(app, claim, SiteRunEnd::Failed { outcome }).await
    }
}

impl CameraSamples {
    fn to_fit(&self) -> SiteCamera<'_> {
        let profile = &self.camera.profile;
        SiteCamera {
            id: self.camera.id().as_str(),
            samples: &self.samples,
            image_size: profile.image_size,
            gnss_error: profile.gnss_error,
            gnss_bias_sigma_m: profile.gnss_bias_sigma.map(GnssBiasSigma::metres),
        }
    }
}

async fn succeed(
    app: &App,
    claim: &Claim<SiteTrainingRun>,
    models: &SiteModels,
    cameras: &[CameraSamples],
) -> Result<Option<JobState>> {
    let options = claim.job.options;
    let range = TimeRange::new(options.from, options.until)?;
    let fitted = || cameras.iter().zip(&models.cameras);
    let candidates: Vec<_> = fitted()
        .map(|(CameraSamples { camera, samples }, SiteCameraModel { artifact, held_out, .. })| {
            (camera.id(), PromotionCandidate { artifact, samples, held_out, range })
        })
        .collect();
    let promotion = match promotion::decide_site(app, &candidates).await {
        Err(error) if error.kind() == ErrorKind::CameraNotFound => {
            let outcome = format!("{error}: it was deleted while the site was trained; start another run");
            return finish(app, claim, SiteRunEnd::Failed { outcome }).await;
        }
        promotion => promotion?,
    };
    let stored: Vec<_> = models.cameras.iter().map(|own| promotion::stored_errors(&own.held_out)).collect();
    let mut outputs = Vec::with_capacity(cameras.len());
    for (((own, trained), held_out), decided) in fitted().zip(&stored).zip(&promotion.cameras) {
        let artifact = &trained.artifact;
        outputs.push(SiteCameraOutput {
            camera: own.camera.id(),
            key: own.camera.key,
            compared_with: decided.compared_with,
            model: NewModel { metadata: &artifact.metadata, weights: &artifact.weights, held_out },
        });
    }
    let output = SiteRunOutput { report: site_report(models, cameras, &promotion), models: outputs };
    let end = SiteRunEnd::Succeeded { output, outcome: Some(promotion.reason.clone()) };
    let ended = finish(app, claim, end).await?;
    if promotion.activate && ended == Some(JobState::Succeeded) {
        for CameraSamples { camera, .. } in cameras {
            app.registry.refresh_camera(&app.store, camera.id()).await?;
        }
    }
    Ok(ended)
}

/// What the run found out; the store enters the numbers of the versions.
fn site_report(
    models: &SiteModels,
    cameras: &[CameraSamples],
    promotion: &SitePromotion,
) -> SiteTrainingReport {
    let finding = |((own, trained), decided): ((&CameraSamples, &SiteCameraModel), &CameraPromotion)| {
        let metadata = &trained.artifact.metadata;
        let held_out = metadata.held_out.as_ref();
        SiteCameraFinding {
            camera_id: own.camera.id().as_str().to_owned(),
            model_version: 0,
            samples: metadata.samples,
            held_out_m: held_out.map_or(0.0, |held_out| held_out.mean_to_fix_m),
            held_out_apart_m: trained.apart.as_ref().map(|apart| apart.mean_to_fix_m),
            coverage95_of_fixes: held_out.map_or(0.0, |held_out| held_out.coverage95_of_fixes),
            comparison: decided.comparison.clone(),
        }
    };
    let [disagreement_m, disagreement_apart_m] = models.disagreement_m;
    SiteTrainingReport {
        is_activated: promotion.activate,
        receivers: models.receivers,
        pairs: models.pairs,
        disagreement_m,
        disagreement_apart_m,
        cameras: cameras.iter().zip(&models.cameras).zip(&promotion.cameras).map(finding).collect(),
    }
}

async fn finish(app: &App, claim: &Claim<SiteTrainingRun>, end: SiteRunEnd<'_>) -> Result<Option<JobState>> {
    let ended = app.store.finish_site_run(claim.job.id, claim.fence, end, app.clock.now()).await?;
    Ok(ended.map(|run| run.state))
}
