//! Background jobs, training runs and evaluations: claim, carry out, heartbeat, finish.
//!
//! A job is claimed in a short transaction, carried out on a thread of its own at the lowest
//! priority, and finished in one transaction that only the holder of the newest fence can make. What
//! never happens here: a database transaction held across the work, work on a thread of tokio's.

mod aside;
mod evaluation;
mod promotion;
mod training;

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{Notify, Semaphore};
use uuid::Uuid;

use crate::app::App;
use crate::config::Workers;
use crate::domain::{CameraId, Error, EvaluationJob, JobState, Result, Sample, TrainingRun};
use crate::shutdown::Shutdown;
use crate::store::{Claim, Heartbeat, SampleFilter};
use crate::telemetry::Metrics;

use aside::{Aside, Said, Voice};

/// How often a worker looks for jobs that nobody rang for (another process, an expired lease).
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How often progress is written while a job is carried out, if the lease does not ask for more.
const REPORT_EVERY: Duration = Duration::from_millis(400);
/// Takes of a job after which it is given up: it has brought down every worker that tried.
const MOST_ATTEMPTS: u32 = 5;
/// Samples read at a time.
const PAGE_SAMPLES: u32 = 10_000;

/// Works on queued training runs until the server ends.
pub async fn train(app: App, settings: Workers, shutdown: Shutdown) {
    work::<TrainingRun>(app, settings, shutdown).await;
}

/// Carries out queued evaluations until the server ends.
pub async fn evaluate(app: App, settings: Workers, shutdown: Shutdown) {
    work::<EvaluationJob>(app, settings, shutdown).await;
}

/// What a job does on its thread.
type Work<J> = Box<dyn FnOnce(&Voice<<J as Job>::Said>) -> <J as Job>::Yield + Send>;

/// A kind of job.
trait Job: Send + Sync + Sized + 'static {
    /// What one is called in the log; also its thread.
    const NAME: &'static str;
    /// What the work says while it is under way.
    type Said: Said;
    /// What it yields.
    type Yield: Send + 'static;

    fn id(&self) -> Uuid;
    fn camera(&self) -> &CameraId;
    fn attempt(&self) -> u32;
    /// Rung when one was queued.
    fn bell(app: &App) -> &Notify;
    fn count(metrics: &Metrics, state: JobState, time: Duration);

    /// Takes one up.
    fn claim(app: &App, lease: Duration) -> impl Future<Output = Result<Option<Claim<Self>>>> + Send;
    /// Reads what the work needs; a refusal ends the job with its words.
    fn prepare(app: &App, claim: &Claim<Self>) -> impl Future<Output = Result<Work<Self>>> + Send;
    /// Prolongs the lease and writes down what was said.
    fn record(
        app: &App,
        claim: &Claim<Self>,
        said: Self::Said,
        lease: Duration,
    ) -> impl Future<Output = Result<Heartbeat>> + Send;
    /// Ends the job by what it yielded; `None` if the fence was lost.
    fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> impl Future<Output = Result<Option<JobState>>> + Send;
    /// Ends the job with an error; `None` if the fence was lost.
    fn fail(
        app: &App,
        claim: &Claim<Self>,
        outcome: String,
    ) -> impl Future<Output = Result<Option<JobState>>> + Send;
}

/// A job whose work has ended.
struct Ended<J: Job> {
    yielded: J::Yield,
    /// What was said last.
    said: J::Said,
    /// If the work was broken off, the next server shall take it up.
    server_is_ending: bool,
}

/// Works on queued jobs of a kind until the server ends.
async fn work<J: Job>(app: App, settings: Workers, shutdown: Shutdown) {
    let slots = Arc::new(Semaphore::new(settings.workers));
    let lease = Duration::from_secs(settings.lease_s.into());
    loop {
        let slot = tokio::select! {
            () = shutdown.begun() => return,
            slot = slots.clone().acquire_owned() => slot.expect("the semaphore is never closed"),
        };
        match J::claim(&app, lease).await {
            Ok(Some(claim)) => {
                let (app, ending) = (app.clone(), shutdown.clone());
                shutdown.spawn(async move {
                    carry_out(&app, claim, lease, &ending).await;
                    drop(slot);
                });
                continue;
            }
            Ok(None) => {}
            Err(error) => tracing::error!(%error, "cannot look for a {}", J::NAME),
        }
        drop(slot);
        tokio::select! {
            () = shutdown.begun() => return,
            () = J::bell(&app).notified() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}

/// Carries out one claimed job to its end, whatever that is.
async fn carry_out<J: Job>(app: &App, claim: Claim<J>, lease: Duration, shutdown: &Shutdown) {
    let (id, camera, attempt) = (claim.job.id(), claim.job.camera(), claim.job.attempt());
    let started = Instant::now();
    tracing::info!(job.id = %id, camera.id = %camera, attempt, "{} begins", J::NAME);
    let state = match try_once(app, &claim, lease, shutdown).await {
        Ok(Some(state)) => state,
        Ok(None) => {
            tracing::warn!(job.id = %id, "{} was taken over by another worker, or deleted", J::NAME);
            return;
        }
        Err(error) => {
            let outcome = match &error {
                Error::Refused(refusal) => refusal.to_string(),
                Error::Fault(_) => "the server failed; its log says why".to_owned(),
            };
            tracing::error!(job.id = %id, %error, "{} failed", J::NAME);
            if let Err(error) = J::fail(app, &claim, outcome).await {
                // The lease runs out and the job is taken up again.
                tracing::error!(job.id = %id, %error, "cannot record the failed {}", J::NAME);
            }
            JobState::Failed
        }
    };
    let time = started.elapsed();
    J::count(&app.metrics, state, time);
    let duration_s = time.as_secs_f64();
    tracing::info!(job.id = %id, state = state.as_str(), duration_s, "{} ends", J::NAME);
}

/// `None` if the fence was lost.
async fn try_once<J: Job>(
    app: &App,
    claim: &Claim<J>,
    lease: Duration,
    shutdown: &Shutdown,
) -> Result<Option<JobState>> {
    if claim.job.attempt() > MOST_ATTEMPTS {
        let outcome = format!("given up: {MOST_ATTEMPTS} workers took it up and none came to its end");
        return J::fail(app, claim, outcome).await;
    }
    let mut aside = Aside::begin(J::NAME, J::prepare(app, claim).await?).map_err(Error::fault)?;
    if claim.cancel_requested {
        aside.cancel();
    }
    let every = REPORT_EVERY.min(lease / 3);
    let mut server_is_ending = false;
    loop {
        tokio::select! {
            () = aside.ended() => break,
            () = tokio::time::sleep(every) => {}
            () = shutdown.begun(), if !server_is_ending => {
                server_is_ending = true;
                aside.cancel();
            }
        }
        match J::record(app, claim, aside.take_said(), lease).await? {
            Heartbeat::Continue => {}
            Heartbeat::CancelRequested => aside.cancel(),
            Heartbeat::Lost => return Ok(None),
        }
    }
    let (yielded, said) = aside.finish().await;
    let yielded = yielded.ok_or_else(|| Error::fault("the work's thread ended without a word"))?;
    J::end(app, claim, Ended { yielded, said, server_is_ending }, lease).await
}

/// Stored samples by time and target, the latest where there are too many.
async fn load_samples(app: &App, camera: &CameraId, filter: &SampleFilter, most: u32) -> Result<Vec<Sample>> {
    let most = most as usize;
    let mut samples = Vec::new();
    let mut after = None;
    loop {
        let page = app.samples(camera, filter, after, PAGE_SAMPLES).await?;
        samples.extend(page.items);
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
