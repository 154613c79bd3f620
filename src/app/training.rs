//! Training runs: start, list, cancel, watch. `worker` runs them.

use std::sync::Arc;
use std::time::Duration;

use futures_util::{Stream, StreamExt as _, stream};
use jiff::Timestamp;

use super::idempotency::{first_answer, record_of};
use super::{App, JobQueue, Page, Registry, page_of};
use crate::clock::{Clock, Randomness};
use crate::config::Limits;
use crate::domain::{
    CameraId, EpochReport, Error, ErrorKind, IdempotentRequest, Recipe, Result, RunId, TimeRange,
    TrainingOptions, TrainingRun,
};
use crate::geo::{Position, distance_m};
use crate::model::{FEWEST_SAMPLES, SMALLEST_SPREAD_M};
use crate::store::{RunSubject, SampleFilter, Store};

/// How often a watched run is read from the store.
const WATCH_INTERVAL: Duration = Duration::from_millis(200);

/// A request for a training run; what is left out comes from the profile.
#[derive(Debug, Clone, Copy, Default)]
pub struct RunRequest {
    /// The profile's recipe, if `None`.
    pub recipe: Option<Recipe>,
    /// 0, if `None`: the same samples then give the same model.
    pub seed: Option<u64>,
    /// The recipe's own number, if `None`.
    pub epochs: Option<u32>,
    /// Only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Only samples before this instant.
    pub until: Option<Timestamp>,
}

/// Wakes the workers that train.
#[derive(Default)]
pub struct TrainingQueues {
    /// Runs of cameras.
    pub(super) cameras: JobQueue,
    /// Runs of sites.
    pub(super) sites: JobQueue,
}

/// A camera or a site, as clients ask for its training.
pub trait Trainable: RunSubject {
    /// A request for a run.
    type RunRequest: Send;

    /// The parameters of a run, if the request is valid and the samples are usable.
    fn run_options(
        &self,
        training: &Training<'_>,
        request: Self::RunRequest,
    ) -> impl Future<Output = Result<Self::Options>> + Send;

    /// Notifies the workers of its runs.
    fn queue(queues: &TrainingQueues) -> &JobQueue;

    /// The versions of cameras' models that a run has stored, and may have activated.
    fn models_of(run: &TrainingRun<Self>) -> Vec<(CameraId, u32)>;
}

impl Trainable for CameraId {
    type RunRequest = RunRequest;

    async fn run_options(&self, training: &Training<'_>, request: RunRequest) -> Result<TrainingOptions> {
        let camera = training.store.camera(self).await?;
        let most = training.limits.epochs;
        if request.epochs.is_some_and(|epochs| !(1..=most).contains(&epochs)) {
            return Err(Error::invalid("epochs", format!("must be from 1 to {most}")));
        }
        let range = TimeRange::new(request.from, request.until)?;
        let (count, extent) = training.store.sample_extent(self, &SampleFilter::within(range)).await?;
        check_extent(self, count, extent)?;
        Ok(TrainingOptions {
            recipe: request.recipe.unwrap_or(camera.profile.recipe),
            seed: request.seed.unwrap_or(0),
            epochs: request.epochs,
            from: request.from,
            until: request.until,
        })
    }

    fn queue(queues: &TrainingQueues) -> &JobQueue {
        &queues.cameras
    }

    fn models_of(run: &TrainingRun<Self>) -> Vec<(CameraId, u32)> {
        run.model_version.map(|version| (run.subject.clone(), version)).into_iter().collect()
    }
}

/// The use cases of training runs of cameras and sites.
#[derive(Clone, Copy)]
pub struct Training<'a> {
    pub(super) store: &'a Store,
    clock: &'a Clock,
    randomness: &'a Randomness,
    pub(super) limits: &'a Limits,
    queues: &'a TrainingQueues,
    registry: &'a Arc<Registry>,
}

impl App {
    /// The use cases of training runs of cameras and sites.
    #[must_use]
    pub fn training(&self) -> Training<'_> {
        Training {
            store: &self.store,
            clock: &self.clock,
            randomness: &self.randomness,
            limits: &self.limits,
            queues: &self.training_queues,
            registry: &self.registry,
        }
    }
}

impl Training<'_> {
    /// Queues a training run of a camera, or over all cameras of a site. If the client has made the same request
    /// before, it gets the run of then as it is now.
    ///
    /// # Errors
    /// `CameraNotFound` or `SiteNotFound`; `InvalidArgument` naming the field; `UnusableSamples` if there are too few, or
    /// the site has too few or too many cameras; `RunLive`; `Overloaded` beyond the limit of live runs;
    /// `IdempotencyKeyReused`; `RunNotFound` if the run of the first request was deleted since.
    pub async fn start<S: Trainable>(
        &self,
        subject: &S,
        request: S::RunRequest,
        idempotent: Option<IdempotentRequest>,
    ) -> Result<TrainingRun<S>> {
        if let Some(request) = &idempotent
            && let Some(first) = first_answer(self.store, self.clock, request).await?
        {
            return self.get(subject, first.parse()?).await;
        }
        let options = subject.run_options(self, request).await?;
        let now = self.clock.now();
        let run = RunId(self.randomness.uuid_v7(now));
        let record = idempotent.as_ref().map(record_of);
        let most = self.limits.live_runs;
        let run = self.store.insert_run(run, subject, &options, most, record.as_ref(), now).await?;
        S::queue(self.queues).notify();
        Ok(run)
    }

    /// One run.
    ///
    /// # Errors
    /// `CameraNotFound` or `SiteNotFound`; `RunNotFound`.
    pub async fn get<S: Trainable>(&self, subject: &S, run: RunId) -> Result<TrainingRun<S>> {
        read(self.store, self.registry, subject, run).await
    }

    /// Runs of a camera or a site, newest first, after a cursor.
    ///
    /// # Errors
    /// `CameraNotFound` or `SiteNotFound`.
    pub async fn list<S: RunSubject>(
        &self,
        subject: &S,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Page<TrainingRun<S>, RunId>> {
        let runs = self.store.runs(subject, before, limit + 1).await?;
        Ok(page_of(runs, limit, |run| run.id))
    }

    /// Cancels a run: at once if no worker holds it, at its next step if one does.
    ///
    /// # Errors
    /// `CameraNotFound` or `SiteNotFound`; `RunNotFound`, `RunEnded`.
    pub async fn cancel<S: RunSubject>(&self, subject: &S, run: RunId) -> Result<TrainingRun<S>> {
        self.store.cancel_run(subject, run, self.clock.now()).await
    }

    /// Deletes a run that has ended, with its log and curve. The version that it yielded stays.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`, `RunLive`.
    pub async fn delete(&self, id: &CameraId, run: RunId) -> Result<()> {
        self.store.delete_run(id, run, self.clock.now()).await
    }

    /// The run's curve: one report per epoch of the final fit.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`.
    pub async fn epochs(&self, id: &CameraId, run: RunId) -> Result<Vec<EpochReport>> {
        self.store.run(id, run).await?;
        self.store.epochs(run).await
    }

    /// The run's log.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`.
    pub async fn log(&self, id: &CameraId, run: RunId) -> Result<Vec<(Timestamp, String)>> {
        self.store.run(id, run).await?;
        self.store.log(run).await
    }

    /// The run now and at each change, until it has ended. Reads the store, so it also sees runs that
    /// another process works on.
    ///
    /// # Errors
    /// `CameraNotFound` or `SiteNotFound`; `RunNotFound` at once; a fault later ends the stream.
    pub async fn watch<S: Trainable>(
        &self,
        subject: &S,
        run: RunId,
    ) -> Result<impl Stream<Item = Result<TrainingRun<S>>> + Send + use<S>> {
        let first = self.get(subject, run).await?;
        let (store, registry, subject) = (self.store.clone(), self.registry.clone(), subject.clone());
        let watched = (Some(first.clone()), store, registry, subject);
        let later = stream::unfold(watched, move |(shown, store, registry, subject)| async move {
            let shown = shown.filter(|run| !run.state.has_ended())?;
            loop {
                tokio::time::sleep(WATCH_INTERVAL).await;
                match read(&store, &registry, &subject, run).await {
                    Ok(seen) if seen == shown => {}
                    Ok(seen) => return Some((Ok(seen.clone()), (Some(seen), store, registry, subject))),
                    Err(error) => return Some((Err(error), (None, store, registry, subject))),
                }
            }
        });
        Ok(stream::once(async move { Ok(first) }).chain(later))
    }
}

/// A run. The models that it has stored answer from then on: whoever reads that it has succeeded need not wait for the
/// worker, or for the next refresh where another process trained.
async fn read<S: Trainable>(
    store: &Store,
    registry: &Registry,
    subject: &S,
    run: RunId,
) -> Result<TrainingRun<S>> {
    let run = store.run(subject, run).await?;
    for (camera, version) in S::models_of(&run) {
        let Some(known) = registry.get(&camera) else { continue };
        let shown = known.model().map(|(_, version)| version);
        if shown.is_none_or(|shown| shown < version)
            && let Err(error) = registry.refresh_camera(store, &camera).await
            && error.kind() != ErrorKind::CameraNotFound
        {
            return Err(error);
        }
    }
    Ok(run)
}

/// Refuses samples that no recipe can be fitted to, before a run is queued; the fit checks more.
pub(super) fn check_extent(id: &CameraId, count: u64, extent: Option<[Position; 2]>) -> Result<()> {
    let refused = |message| Err(Error::field(ErrorKind::UnusableSamples, "samples", message));
    if count < FEWEST_SAMPLES {
        return refused(format!(
            "are {count}, at least {FEWEST_SAMPLES} are needed: import more (POST /v1/cameras/{id}/samples)"
        ));
    }
    let spread_m = extent.map_or(0.0, |[south_west, north_east]| distance_m(south_west, north_east));
    if spread_m < SMALLEST_SPREAD_M {
        return refused(format!(
            "lie within {spread_m:.2} m, all at one spot: let the target move through the view, \
             at least {SMALLEST_SPREAD_M} m"
        ));
    }
    Ok(())
}
