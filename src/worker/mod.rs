//! Background jobs, training runs and evaluations: claim, lease, heartbeat, finish.
//!
//! A worker claims a job in a short transaction, runs it on a thread of its own at the lowest priority,
//! renews the lease by heartbeats while it runs, and finishes it in one transaction that only the holder of
//! the newest fence can make. No database transaction is held across the work, and no work runs on a thread
//! of tokio.

mod camera_training;
mod evaluation;
mod job_thread;
mod learning;
mod promotion;
mod run_jobs;
mod site_training;

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::Semaphore;
use uuid::Uuid;

use crate::app::{App, JobQueue};
use crate::config::Workers;
use crate::domain::{
    CameraId, Detection, Error, ErrorKind, EvaluationJob, JobState, Result, Sample, SiteId, StoredSample,
    TrainingRun,
};
use crate::shutdown::Shutdown;
use crate::store::{Claim, Heartbeat, SampleFilter};
use crate::telemetry::{JobMetrics, Metrics};

pub use learning::learn;

use job_thread::{JobProgress, JobThread, ProgressSink};

/// How often a worker looks for jobs of which it was not notified (another process, an expired lease).
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// How often a job sends a heartbeat with its progress, unless its lease asks for more.
const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(400);
/// Attempts after which a job is given up: every worker that claimed it has crashed.
const MAX_ATTEMPTS: u32 = 5;
/// Samples read at a time.
const PAGE_SAMPLES: u32 = 10_000;

/// Works on queued training runs of cameras until the server shuts down.
pub async fn train(app: App, settings: Workers, shutdown: Shutdown) {
    work::<TrainingRun<CameraId>>(app, settings, shutdown).await;
}

/// Works on queued training runs of sites until the server shuts down, one at a time: each has the samples of all its
/// cameras in memory.
pub async fn train_sites(app: App, settings: Workers, shutdown: Shutdown) {
    let settings = Workers { workers: settings.workers.min(1), ..settings };
    work::<TrainingRun<SiteId>>(app, settings, shutdown).await;
}

/// Works on queued evaluations until the server shuts down.
pub async fn evaluate(app: App, settings: Workers, shutdown: Shutdown) {
    work::<EvaluationJob>(app, settings, shutdown).await;
}

/// The work of a job on its thread.
type Work<J> = Box<dyn FnOnce(&ProgressSink<<J as Job>::Progress>) -> <J as Job>::Output + Send>;

/// The values of a job for the log and the rules of attempts.
struct JobIdentity<'a> {
    id: Uuid,
    camera: Option<&'a CameraId>,
    site: Option<&'a SiteId>,
    attempt: u32,
}

/// A kind of job.
trait Job: Send + Sync + Sized + 'static {
    /// Name of the kind in the log, and of its thread.
    const NAME: &'static str;
    /// The progress that the work reports while it runs.
    type Progress: JobProgress;
    /// The output of the work.
    type Output: Send + 'static;

    fn identity(&self) -> JobIdentity<'_>;
    /// Where workers of this kind are notified of queued jobs.
    fn queue(app: &App) -> &JobQueue;
    fn metrics(metrics: &Metrics) -> &JobMetrics;

    /// Claims the next job.
    fn claim(app: &App, lease: Duration) -> impl Future<Output = Result<Option<Claim<Self>>>> + Send;
    /// Reads what the work needs. A refusal fails the job with its message.
    fn prepare(app: &App, claim: &Claim<Self>) -> impl Future<Output = Result<Work<Self>>> + Send;
    /// Renews the lease and stores the progress.
    fn record(
        app: &App,
        claim: &Claim<Self>,
        progress: Self::Progress,
        lease: Duration,
    ) -> impl Future<Output = Result<Heartbeat>> + Send;
    /// Finishes the job by its output; `None` if the lease was lost.
    fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> impl Future<Output = Result<Option<JobState>>> + Send;
    /// Returns the job to the queue, for the server shuts down: no attempt is counted. `None` if the lease was lost.
    fn requeue(app: &App, claim: &Claim<Self>) -> impl Future<Output = Result<Option<JobState>>> + Send;
    /// Finishes the job with an error; `None` if the lease was lost.
    fn fail(
        app: &App,
        claim: &Claim<Self>,
        outcome: String,
    ) -> impl Future<Output = Result<Option<JobState>>> + Send;
}

/// A job whose thread has ended.
struct Ended<J: Job> {
    output: J::Output,
    /// The last report.
    progress: J::Progress,
    /// A job that was cancelled by the shutdown returns to the queue.
    shutting_down: bool,
}

/// Claims and runs queued jobs of a kind until the server shuts down.
async fn work<J: Job>(app: App, settings: Workers, shutdown: Shutdown) {
    let slots = Arc::new(Semaphore::new(settings.workers));
    let lease = Duration::from_secs(settings.lease_s.into());
    loop {
        let slot = tokio::select! {
            biased;
            () = shutdown.draining() => return,
            slot = slots.clone().acquire_owned() => slot.expect("the semaphore is never closed"),
        };
        match J::claim(&app, lease).await {
            Ok(Some(claim)) => {
                let (app, ending) = (app.clone(), shutdown.clone());
                shutdown.spawn(async move {
                    run_to_end(&app, claim, lease, &ending).await;
                    drop(slot);
                });
                continue;
            }
            Ok(None) => {}
            Err(error) => tracing::error!(%error, "cannot claim a {}", J::NAME),
        }
        drop(slot);
        tokio::select! {
            () = shutdown.draining() => return,
            () = J::queue(&app).queued() => {}
            () = tokio::time::sleep(POLL_INTERVAL) => {}
        }
    }
}

/// Runs one claimed job to its end, whatever that is.
async fn run_to_end<J: Job>(app: &App, claim: Claim<J>, lease: Duration, shutdown: &Shutdown) {
    let JobIdentity { id, camera, site, attempt } = claim.job.identity();
    let started = Instant::now();
    let (camera, site) = (camera.map(tracing::field::display), site.map(tracing::field::display));
    tracing::info!(job.id = %id, camera.id = camera, site.id = site, attempt, "{} begins", J::NAME);
    let state = match run_attempt(app, &claim, lease, shutdown).await {
        Ok(Some(state)) => state,
        Ok(None) => {
            tracing::warn!(job.id = %id, "{} lost its lease to another worker, or was deleted", J::NAME);
            return;
        }
        Err(error) if error.kind() == ErrorKind::Overloaded => {
            // The store did not answer: the job is not at fault. Its lease expires and it is claimed again.
            tracing::warn!(job.id = %id, %error, "{} is left to the next worker", J::NAME);
            return;
        }
        Err(error) => {
            let outcome = match &error {
                Error::Refused(refusal) => refusal.to_string(),
                Error::Fault(_) => "the server failed; its log says why".to_owned(),
            };
            tracing::error!(job.id = %id, %error, "{} failed", J::NAME);
            if let Err(error) = J::fail(app, &claim, outcome).await {
                // The lease expires and the job is claimed again.
                tracing::error!(job.id = %id, %error, "cannot record the failed {}", J::NAME);
            }
            JobState::Failed
        }
    };
    let time = started.elapsed();
    J::metrics(&app.metrics).ended(state, time);
    let duration_s = time.as_secs_f64();
    tracing::info!(job.id = %id, state = state.as_str(), duration_s, "{} ends", J::NAME);
}

/// `None` if the lease was lost.
async fn run_attempt<J: Job>(
    app: &App,
    claim: &Claim<J>,
    lease: Duration,
    shutdown: &Shutdown,
) -> Result<Option<JobState>> {
    if claim.job.identity().attempt > MAX_ATTEMPTS {
        let outcome = format!("given up: {MAX_ATTEMPTS} workers claimed it and none finished it");
        return J::fail(app, claim, outcome).await;
    }
    let prepared = tokio::select! {
        biased;
        () = shutdown.draining() => return J::requeue(app, claim).await,
        prepared = J::prepare(app, claim) => prepared?,
    };
    let mut thread = JobThread::spawn(J::NAME, prepared).map_err(Error::fault)?;
    if claim.cancel_requested {
        thread.cancel();
    }
    let every = HEARTBEAT_INTERVAL.min(lease / 3);
    let mut renewed = Instant::now();
    let mut shutting_down = false;
    loop {
        tokio::select! {
            () = thread.ended() => break,
            () = tokio::time::sleep(every) => {}
            () = shutdown.draining(), if !shutting_down => {
                shutting_down = true;
                thread.cancel();
            }
            // Its next step may be far away. The process ends without its thread.
            () = shutdown.forced() => return J::requeue(app, claim).await,
        }
        match J::record(app, claim, thread.take_progress(), lease).await {
            Ok(Heartbeat::Continue) => renewed = Instant::now(),
            Ok(Heartbeat::CancelRequested) => {
                renewed = Instant::now();
                thread.cancel();
            }
            Ok(Heartbeat::Lost) => return Ok(None),
            // A database that restarts answers again before the lease ends.
            Err(error) if error.kind() == ErrorKind::Overloaded && renewed.elapsed() < lease => {
                tracing::warn!(%error, "a heartbeat of a {} is late", J::NAME);
            }
            Err(error) => return Err(error),
        }
    }
    let (output, progress) = thread.join().await;
    let output = output.ok_or_else(|| Error::fault("the job's thread panicked"))?;
    J::end(app, claim, Ended { output, progress, shutting_down }, lease).await
}

/// Stored samples with a fix by time and target; where there are too many, the latest.
async fn load_samples(app: &App, camera: &CameraId, filter: &SampleFilter, most: u32) -> Result<Vec<Sample>> {
    let filter = SampleFilter { has_fix: Some(true), ..filter.clone() };
    let most = most as usize;
    let mut samples = Vec::new();
    let mut after = None;
    loop {
        let page = app.samples().list(camera, &filter, after, PAGE_SAMPLES).await?;
        samples.extend(page.items.into_iter().filter_map(StoredSample::with_fix));
        if samples.len() > 2 * most {
            samples.drain(..samples.len() - most);
        }
        match page.next {
            Some(next) => after = Some(next),
            None => break,
        }
    }
    if samples.len() > most {
        samples.drain(..samples.len() - most);
    }
    Ok(samples)
}

/// Stored boxes without a fix for a fit, thinned to the limit.
async fn load_unpaired(app: &App, camera: &CameraId, filter: &SampleFilter) -> Result<Vec<Detection>> {
    app.store.thinned_detections(camera, filter, app.limits.boxes_without_fix_per_run).await
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::clock::{Clock, Randomness};
    use crate::config::Limits;
    use crate::domain::{NewCamera, Recipe, RunId, TrainingOptions};
    use crate::store::Store;

    #[tokio::test]
    async fn a_run_that_is_claimed_while_the_server_shuts_down_returns_to_the_queue() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let id = CameraId::new("yard").expect("a slug");
        store.insert_camera(&NewCamera::named(id.clone()), Timestamp::UNIX_EPOCH).await.expect("new");
        let (clock, randomness) = (Clock::system(), Randomness::system());
        let metrics = Metrics::new();
        let app =
            App::new(store, clock, randomness, Limits::default(), metrics).await.expect("an application");
        let options =
            TrainingOptions { recipe: Recipe::Auto, seed: 1, epochs: None, from: None, until: None };
        let queued = RunId(app.randomness.uuid_v7(app.clock.now()));
        app.store.insert_run(queued, &id, &options, 1, None, app.clock.now()).await.expect("queued");
        let lease = Duration::from_secs(30);
        let claim = TrainingRun::<CameraId>::claim(&app, lease).await.expect("claimed").expect("the run");
        assert_eq!(claim.job.attempt, 1);
        let shutdown = Shutdown::new();
        shutdown.drain();
        // A run that begins fails: the camera has no samples.
        run_to_end(&app, claim, lease, &shutdown).await;
        let run = app.training().get(&id, queued).await.expect("known");
        assert_eq!((run.state, run.attempt), (JobState::Queued, 0));
    }
}
