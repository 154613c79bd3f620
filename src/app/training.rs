//! Training runs: start, list, cancel, watch. `worker` runs them.

use std::time::Duration;

use futures_util::{Stream, StreamExt as _, stream};
use jiff::Timestamp;

use super::idempotency::record_of;
use super::{App, Page, page_of};
use crate::domain::{
    CameraId, EpochReport, Error, ErrorKind, IdempotentRequest, JobState, Recipe, Result, RunId, TimeRange,
    TrainingOptions, TrainingRun,
};
use crate::geo::{Position, distance_m};
use crate::model::{FEWEST_SAMPLES, SMALLEST_SPREAD_M};
use crate::store::SampleFilter;

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

impl App {
    /// Queues a training run.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` naming the field; `UnusableSamples` if there is none;
    /// `RunLive`; `Overloaded` beyond the limit of live runs.
    pub async fn start_run(&self, id: &CameraId, request: RunRequest) -> Result<TrainingRun> {
        self.start_run_once(id, request, None).await
    }

    /// As [`App::start_run`]; if the client has made the same request before, it gets the run of then as it is
    /// now.
    ///
    /// # Errors
    /// As [`App::start_run`]; `IdempotencyKeyReused`; `RunNotFound` if the run was deleted since.
    pub async fn start_run_once(
        &self,
        id: &CameraId,
        request: RunRequest,
        idempotent: Option<IdempotentRequest>,
    ) -> Result<TrainingRun> {
        if let Some(request) = &idempotent
            && let Some(first) = self.first_answer(request).await?
        {
            return self.run(id, first.parse()?).await;
        }
        let camera = self.store.camera(id).await?;
        let most = self.limits.epochs;
        if request.epochs.is_some_and(|epochs| !(1..=most).contains(&epochs)) {
            return Err(Error::invalid("epochs", format!("must be from 1 to {most}")));
        }
        let range = TimeRange::new(request.from, request.until)?;
        let options = TrainingOptions {
            recipe: request.recipe.unwrap_or(camera.profile.recipe),
            seed: request.seed.unwrap_or(0),
            epochs: request.epochs,
            from: request.from,
            until: request.until,
        };
        let (count, extent) = self.store.sample_extent(id, &SampleFilter::within(range)).await?;
        check_extent(id, count, extent)?;
        let now = self.clock.now();
        let run = RunId(self.randomness.uuid_v7(now));
        let record = idempotent.as_ref().map(record_of);
        let run = self
            .store
            .insert_run_once(run, id, &options, self.limits.live_runs, record.as_ref(), now)
            .await?;
        self.training_queue.notify();
        Ok(run)
    }

    /// One run.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`.
    pub async fn run(&self, id: &CameraId, run: RunId) -> Result<TrainingRun> {
        self.store.run(id, run).await
    }

    /// A camera's runs, newest first, after a cursor.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn runs(
        &self,
        id: &CameraId,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Page<TrainingRun, RunId>> {
        let runs = self.store.runs(id, before, limit + 1).await?;
        Ok(page_of(runs, limit, |run| run.id))
    }

    /// Cancels a run: at once if no worker holds it, at its next step if one does.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`, `RunEnded`.
    pub async fn cancel_run(&self, id: &CameraId, run: RunId) -> Result<TrainingRun> {
        self.store.cancel_run(id, run, self.clock.now()).await
    }

    /// Deletes a run that has ended, with its log and curve. The version that it yielded stays.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`, `RunLive`.
    pub async fn delete_run(&self, id: &CameraId, run: RunId) -> Result<()> {
        self.store.delete_run(id, run, self.clock.now()).await
    }

    /// The run's curve: one report per epoch of the final fit.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`.
    pub async fn run_epochs(&self, id: &CameraId, run: RunId) -> Result<Vec<EpochReport>> {
        self.store.run(id, run).await?;
        self.store.epochs(run).await
    }

    /// The run's log.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound`.
    pub async fn run_log(&self, id: &CameraId, run: RunId) -> Result<Vec<(Timestamp, String)>> {
        self.store.run(id, run).await?;
        self.store.log(run).await
    }

    /// The run now and at each change, until it has ended. Reads the store, so it also sees runs that
    /// another process works on.
    ///
    /// # Errors
    /// `CameraNotFound`, `RunNotFound` at once; a fault later ends the stream.
    pub async fn watch_run(
        &self,
        id: &CameraId,
        run: RunId,
    ) -> Result<impl Stream<Item = Result<TrainingRun>> + Send + use<>> {
        let first = self.store.run(id, run).await?;
        let (app, id) = (self.clone(), id.clone());
        Ok(watch_changes(
            first,
            |run| run.state,
            move || {
                let (app, id) = (app.clone(), id.clone());
                async move { app.store.run(&id, run).await }
            },
        ))
    }
}

/// A run now, and at each change that `read` shows, until it has ended or cannot be read.
pub(super) fn watch_changes<R, F>(
    first: R,
    state: fn(&R) -> JobState,
    read: impl FnMut() -> F + Send,
) -> impl Stream<Item = Result<R>> + Send
where
    R: Clone + PartialEq + Send,
    F: Future<Output = Result<R>> + Send,
{
    let later = stream::unfold((Some(first.clone()), read), move |(shown, mut read)| async move {
        let shown = shown.filter(|run| !state(run).has_ended())?;
        loop {
            tokio::time::sleep(WATCH_INTERVAL).await;
            match read().await {
                Ok(seen) if seen == shown => {}
                Ok(seen) => return Some((Ok(seen.clone()), (Some(seen), read))),
                Err(error) => return Some((Err(error), (None, read))),
            }
        }
    });
    stream::once(async move { Ok(first) }).chain(later)
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
