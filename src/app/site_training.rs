//! Training runs of sites: their request, and which cameras are trained.

use jiff::Timestamp;

use super::JobQueue;
use super::training::{Trainable, Training, TrainingQueues, check_extent};
use crate::domain::{
    Camera, CameraId, Error, ErrorKind, Result, SiteId, SiteTrainingOptions, TimeRange, TrainingRun,
};
use crate::store::SampleFilter;

/// Fewer cameras than this are not trained together.
const FEWEST_CAMERAS: usize = 2;

/// A request for a training run of a site.
#[derive(Debug, Clone, Copy, Default)]
pub struct SiteRunRequest {
    /// 0, if `None`: the same samples then give the same models.
    pub seed: Option<u64>,
    /// Only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Only samples before this instant.
    pub until: Option<Timestamp>,
}

impl Trainable for SiteId {
    type RunRequest = SiteRunRequest;

    async fn run_options(
        &self,
        training: &Training<'_>,
        request: SiteRunRequest,
    ) -> Result<SiteTrainingOptions> {
        let SiteRunRequest { seed, from, until } = request;
        let filter = SampleFilter::within(TimeRange::new(from, until)?);
        for camera in training.cameras_of(self).await? {
            let (count, extent) = training.store.sample_extent(camera.id(), &filter).await?;
            check_extent(camera.id(), count, extent)?;
        }
        Ok(SiteTrainingOptions { seed: seed.unwrap_or(0), from, until })
    }

    fn queue(queues: &TrainingQueues) -> &JobQueue {
        &queues.sites
    }

    fn models_of(run: &TrainingRun<Self>) -> Vec<(CameraId, u32)> {
        let activated = run.report.iter().filter(|report| report.is_activated);
        let cameras = activated.flat_map(|report| &report.cameras);
        cameras.filter_map(|own| Some((CameraId::new(&own.camera_id).ok()?, own.model_version))).collect()
    }
}

impl Training<'_> {
    /// The cameras of a site in the order of their ids.
    ///
    /// # Errors
    /// `SiteNotFound`; `UnusableSamples` if there are too few or too many.
    pub async fn cameras_of(&self, id: &SiteId) -> Result<Vec<Camera>> {
        let most = self.limits.cameras_per_site_run;
        self.store.site(id).await?;
        let cameras = self.store.cameras(Some(id), None, most + 1).await?;
        let refused = |message| Err(Error::field(ErrorKind::UnusableSamples, "site", message));
        if cameras.len() < FEWEST_CAMERAS {
            return refused(format!(
                "has {} camera(s), and at least {FEWEST_CAMERAS} are trained together: name it in the profiles of \
                 others (PATCH /v1/cameras/{{camera}}), or train the camera by itself",
                cameras.len()
            ));
        }
        if cameras.len() > most as usize {
            return refused(format!(
                "has more than {most} cameras (limits.cameras_per_site_run), which cannot be trained together: divide \
                 it into several sites"
            ));
        }
        Ok(cameras)
    }
}
