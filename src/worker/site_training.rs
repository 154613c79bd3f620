//! Training runs of a site: the samples of all cameras, the joint fit, and a model version of each camera, which are
//! activated together or not at all.

use super::promotion::{self, CameraPromotion, PromotionCandidate, SitePromotion};
use super::run_jobs::{Trained, Update, finish, report};
use super::{JobIdentity, Work, load_samples};
use crate::app::App;
use crate::domain::{
    Camera, ErrorKind, GnssBiasSigma, JobState, JointTraining, Result, Sample, SiteCameraFinding, SiteId,
    SiteTrainingReport, TimeRange, TrainingRun,
};
use crate::model::{self, SiteCamera, SiteCameraModel, SiteModels};
use crate::store::{Claim, NewModel, SampleFilter, SiteCameraOutput, SiteRunEnd, SiteRunOutput};

/// A camera with its training samples.
struct CameraSamples {
    camera: Camera,
    samples: Vec<Sample>,
}

/// The fitted models, and the samples of their cameras.
pub(super) struct Fitted {
    models: SiteModels,
    cameras: Vec<CameraSamples>,
}

impl Trained for SiteId {
    const NAME: &'static str = "training run of a site";
    type Fitted = Fitted;

    fn identity(run: &TrainingRun<Self>) -> JobIdentity<'_> {
        JobIdentity { id: run.id.0, camera: None, site: Some(&run.subject), attempt: run.attempt }
    }

    async fn prepare(app: &App, claim: &Claim<TrainingRun<Self>>) -> Result<Work<TrainingRun<Self>>> {
        let TrainingRun { id, subject: site, options, .. } = &claim.job;
        let filter = SampleFilter::within(TimeRange::new(options.from, options.until)?);
        let cameras = app.training().cameras_of(site).await?;
        let most = app.limits.samples_per_site_run / cameras.len() as u32;
        let mut loaded = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let samples = load_samples(app, camera.id(), &filter, most).await?;
            loaded.push(CameraSamples { camera, samples });
        }
        let joint_training = JointTraining {
            site_id: site.as_str().to_owned(),
            run_id: id.to_string(),
            cameras: loaded.iter().map(|own| own.camera.id().as_str().to_owned()).collect(),
        };
        let seed = options.seed;
        Ok(Box::new(move |sink| {
            let cameras: Vec<SiteCamera<'_>> = loaded.iter().map(CameraSamples::to_fit).collect();
            let fitted =
                model::fit_site_models(&cameras, &joint_training, seed, &mut |event| report(sink, event));
            fitted.map(|models| Fitted { models, cameras: loaded })
        }))
    }

    /// Runs of sites have neither a curve nor a log.
    async fn record_details(_: &App, _: &Claim<TrainingRun<Self>>, _: &Update) -> Result<()> {
        Ok(())
    }

    async fn succeed(
        app: &App,
        claim: &Claim<TrainingRun<Self>>,
        Fitted { models, cameras }: Fitted,
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
                let outcome =
                    format!("{error}: it was deleted while the site was trained; start another run");
                return finish(app, claim, &outcome.clone(), SiteRunEnd::Failed { outcome }).await;
            }
            promotion => promotion?,
        };
        let stored: Vec<_> =
            models.cameras.iter().map(|own| promotion::stored_errors(&own.held_out)).collect();
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
        let output = SiteRunOutput { report: site_report(&models, &cameras, &promotion), models: outputs };
        let end = SiteRunEnd::Succeeded { output, outcome: Some(promotion.reason.clone()) };
        let ended = finish(app, claim, &promotion.reason, end).await?;
        if promotion.activate && ended == Some(JobState::Succeeded) {
            for CameraSamples { camera, .. } in &cameras {
                app.registry.refresh_camera(&app.store, camera.id()).await?;
            }
        }
        Ok(ended)
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
            known_points: &profile.known_points,
        }
    }
}

/// Returns the findings of the run; the store enters the numbers of the versions.
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
