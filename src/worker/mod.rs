//! Training jobs: claim, fit, heartbeat, finish.
//!
//! A run is claimed in a short transaction, fitted on a thread of its own at the lowest priority,
//! and finished in one transaction that only the holder of the newest fence can make. What never
//! happens here: a database transaction held across a fit, a fit on a thread of tokio's.

mod fitting;
mod promotion;

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::Semaphore;

use crate::app::App;
use crate::config::Training;
use crate::domain::{Error, Result, RunState, Sample, TrainingRun};
use crate::model::{Artifact, FitError, FitOptions};
use crate::shutdown::Shutdown;
use crate::store::{Claim, Heartbeat, RunEnd, SampleFilter};

use fitting::{Fitting, Update};

/// How often a worker looks for runs that nobody rang for (another process, an expired lease).
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How often progress is written while a run is fitted, if the lease does not ask for more.
const REPORT_EVERY: Duration = Duration::from_millis(400);
/// Takes of a run after which it is given up: it has brought down every worker that tried.
const MOST_ATTEMPTS: u32 = 5;
/// Samples read at a time.
const PAGE_SAMPLES: u32 = 10_000;

/// Works on queued runs until the server ends.
pub async fn work(app: App, settings: Training, shutdown: Shutdown) {
    let slots = Arc::new(Semaphore::new(settings.workers));
    let lease = Duration::from_secs(settings.lease_s.into());
    loop {
        let slot = tokio::select! {
            () = shutdown.begun() => return,
            slot = slots.clone().acquire_owned() => slot.expect("the semaphore is never closed"),
        };
        match app.store.claim_run(lease, app.clock.now()).await {
            Ok(Some(claim)) => {
                let (app, ending) = (app.clone(), shutdown.clone());
                shutdown.spawn(async move {
                    carry_out(&app, claim, lease, &ending).await;
                    drop(slot);
                });
                continue;
            }
            Ok(None) => {}
            Err(error) => tracing::error!(%error, "cannot look for training runs"),
        }
        drop(slot);
        tokio::select! {
            () = shutdown.begun() => return,
            () = app.run_queued.notified() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}

/// Carries out one claimed run to its end, whatever that is.
pub async fn carry_out(app: &App, claim: Claim, lease: Duration, shutdown: &Shutdown) {
    let run = claim.run.clone();
    let started = Instant::now();
    tracing::info!(run.id = %run.id, camera.id = %run.camera_id, attempt = run.attempt, "training run begins");
    let state = match attempt(app, &claim, lease, shutdown).await {
        Ok(Some(ended)) => ended.state,
        Ok(None) => {
            tracing::warn!(run.id = %run.id, "training run was taken over by another worker");
            return;
        }
        Err(error) => {
            tracing::error!(run.id = %run.id, %error, "training run failed");
            let outcome = "the server failed; its log says why".to_owned();
            let end = RunEnd::Failed { outcome };
            if let Err(error) = app.store.finish_run(run.id, claim.fence, end, app.clock.now()).await {
                // The lease runs out and the run is taken up again.
                tracing::error!(run.id = %run.id, %error, "cannot record the failed training run");
            }
            RunState::Failed
        }
    };
    let time = started.elapsed();
    app.metrics.run_ended(state, time);
    tracing::info!(run.id = %run.id, state = state.as_str(), duration_s = time.as_secs_f64(), "training run ends");
}

/// `None` if the fence was lost.
async fn attempt(
    app: &App,
    claim: &Claim,
    lease: Duration,
    shutdown: &Shutdown,
) -> Result<Option<TrainingRun>> {
    let run = &claim.run;
    if run.attempt > MOST_ATTEMPTS {
        let outcome = format!("given up: {MOST_ATTEMPTS} workers took it up and none came to its end");
        return app.store.finish_run(run.id, claim.fence, RunEnd::Failed { outcome }, app.clock.now()).await;
    }
    let camera = app.store.camera(&run.camera_id).await?;
    let samples = Arc::new(load_samples(app, run).await?);
    let options = FitOptions {
        recipe: run.options.recipe,
        seed: run.options.seed,
        epochs: run.options.epochs,
        image_size: camera.profile.image_size,
        gnss_error: camera.profile.gnss_error,
    };
    let line = format!("{} samples, recipe {}, seed {}", samples.len(), options.recipe, options.seed);
    app.store.append_log(run.id, claim.fence, app.clock.now(), &line).await?;
    let mut fitting = Fitting::begin(samples.clone(), options).map_err(Error::fault)?;
    if claim.cancel_requested {
        fitting.cancel();
    }
    let every = REPORT_EVERY.min(lease / 3);
    let mut ending = false;
    loop {
        tokio::select! {
            () = fitting.ended() => break,
            () = tokio::time::sleep(every) => {}
            () = shutdown.begun(), if !ending => {
                ending = true;
                fitting.cancel();
            }
        }
        match record(app, claim, fitting.take_update(), lease).await? {
            Heartbeat::Continue => {}
            Heartbeat::CancelRequested => fitting.cancel(),
            Heartbeat::Lost => {
                fitting.cancel();
                return Ok(None);
            }
        }
    }
    let (fitted, mut update) = fitting.finish().await;
    if fitted.is_ok() {
        // A recipe may skip what it had counted on: a kept candidate without a network, say.
        update.progress.epoch = update.progress.epochs;
        update.progress.remaining_s = Some(0.0);
    }
    if matches!(record(app, claim, update, lease).await?, Heartbeat::Lost) {
        return Ok(None);
    }
    end(app, claim, fitted, &samples, ending).await
}

async fn record(app: &App, claim: &Claim, update: Update, lease: Duration) -> Result<Heartbeat> {
    let (run, now) = (claim.run.id, app.clock.now());
    if !update.epochs.is_empty() {
        app.store.append_epochs(run, claim.fence, &update.epochs).await?;
    }
    for note in &update.notes {
        app.store.append_log(run, claim.fence, now, note).await?;
    }
    app.store.heartbeat(run, claim.fence, &update.progress, lease, now).await
}

async fn end(
    app: &App,
    claim: &Claim,
    fitted: std::result::Result<Artifact, FitError>,
    samples: &[Sample],
    server_is_ending: bool,
) -> Result<Option<TrainingRun>> {
    let run = &claim.run;
    let (line, artifact, activate) = match fitted {
        Ok(artifact) => {
            let verdict = promotion::judge(app, &run.camera_id, &artifact, samples).await?;
            (verdict.reason, Some(artifact), verdict.activate)
        }
        Err(FitError::Cancelled) if server_is_ending => {
            ("the server ends; the run waits".to_owned(), None, false)
        }
        Err(FitError::Cancelled) => ("cancelled".to_owned(), None, false),
        Err(FitError::Unusable(error)) => (error.to_string(), None, false),
        Err(FitError::Fault(error)) => return Err(Error::fault(error)),
    };
    let now = app.clock.now();
    app.store.append_log(run.id, claim.fence, now, &line).await?;
    let end = match &artifact {
        Some(artifact) => RunEnd::Succeeded {
            metadata: &artifact.metadata,
            weights: &artifact.weights,
            activate,
            outcome: line,
        },
        None if line == "cancelled" => RunEnd::Cancelled,
        None if server_is_ending => RunEnd::Requeue,
        None => RunEnd::Failed { outcome: line },
    };
    let ended = app.store.finish_run(run.id, claim.fence, end, now).await?;
    if activate && ended.is_some() {
        app.registry.refresh_camera(&app.store, &run.camera_id).await?;
    }
    Ok(ended)
}

/// The samples that a run learns from: by time and target, the latest where there are too many.
async fn load_samples(app: &App, run: &TrainingRun) -> Result<Vec<Sample>> {
    let filter = SampleFilter { from: run.options.from, until: run.options.until, target_id: None };
    let most = app.limits.samples_per_run as usize;
    let mut samples = Vec::new();
    let mut after = None;
    loop {
        let page = app.samples(&run.camera_id, &filter, after, PAGE_SAMPLES).await?;
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
