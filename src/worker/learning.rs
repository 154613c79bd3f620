//! Cameras that learn by themselves: their recordings are stored, matched without a model, and become samples and a
//! training run.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Semaphore;

use super::job_thread::{JobProgress, JobThread, ProgressSink};
use crate::app::access::Caller;
use crate::app::{ActiveCamera, App, MatchRequest, Recording};
use crate::domain::{Error, Receivers, Result, StoredSample};
use crate::fusion::association::{Cancellation, MatchLimits, MatchSettings, joint_pairing};
use crate::shutdown::Shutdown;

/// How often recordings are stored.
const STORE_EVERY: Duration = Duration::from_secs(1);
/// How often old recordings are deleted, in rounds of the above.
const RETAIN_EVERY: u32 = 60;
/// The same recording is matched in the same way.
const SEED: u64 = 1;

impl JobProgress for () {
    fn take(&mut self) -> Self {}
}

/// Stores recordings, and learns from one camera's at a time, until the server shuts down.
pub async fn learn(app: App, shutdown: Shutdown) {
    let app = app.on_behalf_of(Caller::program("learning"));
    let slot = Arc::new(Semaphore::new(1));
    let mut round = 0;
    while !shutdown.is_draining() {
        tokio::select! {
            () = shutdown.draining() => {}
            () = tokio::time::sleep(STORE_EVERY) => {}
        }
        if let Err(error) = app.recordings().store_pending().await {
            tracing::error!(%error, "boxes and fixes to learn from cannot be stored");
        }
        round = (round + 1) % RETAIN_EVERY;
        if round == 0
            && let Err(error) = app.recordings().retain().await
        {
            tracing::error!(%error, "old recordings cannot be deleted");
        }
        let Ok(place) = slot.clone().try_acquire_owned() else { continue };
        if let Some(camera) = app.recordings().begin_learning() {
            let (app, ending) = (app.clone(), shutdown.clone());
            shutdown.spawn(async move {
                attempt(&app, &camera, &ending).await;
                drop(place);
            });
        }
    }
}

async fn attempt(app: &App, camera: &ActiveCamera, shutdown: &Shutdown) {
    let outcome = match learn_from(app, camera, shutdown).await {
        Ok(outcome) => outcome,
        Err(Error::Refused(refusal)) => refusal.to_string(),
        Err(error) => {
            tracing::error!(camera.id = %camera.id, %error, "a camera cannot learn");
            "the server failed; its log says why".to_owned()
        }
    };
    tracing::info!(camera.id = %camera.id, outcome, "a recording was matched");
    app.recordings().end_learning(camera, outcome);
}

async fn learn_from(app: &App, camera: &ActiveCamera, shutdown: &Shutdown) -> Result<String> {
    let recording = app.recordings().recorded(camera).await?;
    let settings = MatchSettings { limits: MatchLimits::from(&app.limits), ..MatchSettings::default() };
    let image_size = camera.image_size;
    let work = move |sink: &ProgressSink<()>| {
        let is_cancelled = || sink.update(|_| {}).is_break();
        let cancellation = Cancellation::new(&is_cancelled);
        let request = MatchRequest { regressor: None, image_size, settings, seed: SEED, cancellation };
        matched_samples(recording, &request)
    };
    let mut thread = JobThread::spawn("learning", work).map_err(Error::fault)?;
    tokio::select! {
        () = thread.ended() => {}
        () = shutdown.draining() => thread.cancel(),
    }
    let (matched, ()) = thread.join().await;
    let (samples, outcome) = matched.ok_or_else(|| Error::fault("the thread of the matching panicked"))??;
    let run = app.recordings().train_on_matched(&camera.id, samples).await?;
    Ok(format!("{outcome}; training run {}", run.id))
}

/// Samples of the boxes that have a probable receiver and of the mean boxes of groups, all other boxes without a fix, and what was found in
/// words.
fn matched_samples(recording: Recording, request: &MatchRequest<'_>) -> Result<(Vec<StoredSample>, String)> {
    // Fixes have the camera's time already.
    let matched = recording.matched(&Receivers::default(), request)?;
    let (boxes, pairs) = (matched.report.matched_detections, matched.report.pairs.len());
    let groups = matched.report.groups.len();
    let mean_boxes: u64 = matched.report.groups.iter().map(|group| group.detections).sum();
    let (paired, ..) = matched.recording.paired(&matched.receivers, &joint_pairing());
    let found = format!(
        "{boxes} boxes of {pairs} tracklets, and {mean_boxes} mean boxes of {groups} groups, have a receiver"
    );
    Ok((paired.into_samples(true), found))
}
