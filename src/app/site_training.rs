//! Training runs of sites: start, list, cancel, watch. `worker` runs them.

use futures_util::Stream;
use jiff::Timestamp;

use super::idempotency::record_of;
use super::training::{check_extent, watch_changes};
use super::{App, Page, page_of};
use crate::domain::{
    Camera, Error, ErrorKind, IdempotentRequest, Result, RunId, SiteId, SiteTrainingOptions, SiteTrainingRun,
    TimeRange,
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

impl App {
    /// Queues a training run over all cameras of a site. If the client has made the same request before, it gets the
    /// run of then as it is now.
    ///
    /// # Errors
    /// `SiteNotFound`; `InvalidArgument` naming the field; `UnusableSamples` if the site has too few or too many
    /// cameras, or one of them has too few samples; `RunLive`; `Overloaded` beyond the limit of live runs;
    /// `IdempotencyKeyReused`; `RunNotFound` if the run of the first request was deleted since.
    pub async fn start_site_run(
        &self,
        id: &SiteId,
        request: SiteRunRequest,
        idempotent: Option<IdempotentRequest>,
    ) -> Result<SiteTrainingRun> {
        if let Some(request) = &idempotent
            && let Some(first) = self.first_answer(request).await?
        {
            return self.site_run(id, first.parse()?).await;
        }
        let SiteRunRequest { seed, from, until } = request;
        let filter = SampleFilter::within(TimeRange::new(from, until)?);
        for camera in self.cameras_to_train(id).await? {
            let (count, extent) = self.store.sample_extent(camera.id(), &filter).await?;
            check_extent(camera.id(), count, extent)?;
        }
        let options = SiteTrainingOptions { seed: seed.unwrap_or(0), from, until };
        let now = self.clock.now();
        let run = RunId(self.randomness.uuid_v7(now));
        let record = idempotent.as_ref().map(record_of);
        let most = self.limits.live_runs;
        let run = self.store.insert_site_run(run, id, &options, most, record.as_ref(), now).await?;
        self.site_training_queue.notify();
        Ok(run)
    }

    /// The cameras of a site in the order of their ids.
    ///
    /// # Errors
    /// `SiteNotFound`; `UnusableSamples` if there are too few or too many.
    pub async fn cameras_to_train(&self, id: &SiteId) -> Result<Vec<Camera>> {
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

    /// One run of a site.
    ///
    /// # Errors
    /// `SiteNotFound`, `RunNotFound`.
    pub async fn site_run(&self, id: &SiteId, run: RunId) -> Result<SiteTrainingRun> {
        self.store.site_run(id, run).await
    }

    /// A site's runs, newest first, after a cursor.
    ///
    /// # Errors
    /// `SiteNotFound`.
    pub async fn site_runs(
        &self,
        id: &SiteId,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Page<SiteTrainingRun, RunId>> {
        let runs = self.store.site_runs(id, before, limit + 1).await?;
        Ok(page_of(runs, limit, |run| run.id))
    }

    /// Cancels a run: at once if no worker holds it, at its next step if one does.
    ///
    /// # Errors
    /// `SiteNotFound`, `RunNotFound`, `RunEnded`.
    pub async fn cancel_site_run(&self, id: &SiteId, run: RunId) -> Result<SiteTrainingRun> {
        self.store.cancel_site_run(id, run, self.clock.now()).await
    }

    /// The run now and at each change, until it has ended. Reads the store, so it also sees runs that another process
    /// works on.
    ///
    /// # Errors
    /// `SiteNotFound`, `RunNotFound` at once; a fault later ends the stream.
    pub async fn watch_site_run(
        &self,
        id: &SiteId,
        run: RunId,
    ) -> Result<impl Stream<Item = Result<SiteTrainingRun>> + Send + use<>> {
        let first = self.store.site_run(id, run).await?;
        let (app, id) = (self.clone(), id.clone());
        Ok(watch_changes(
            first,
            |run| run.state,
            move || {
                let (app, id) = (app.clone(), id.clone());
                async move { app.store.site_run(&id, run).await }
            },
        ))
    }
}
