//! One fit on a thread of its own, seen from tokio.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::domain::{EpochReport, RunProgress, Sample};
use crate::model::{self, Artifact, FitError, FitEvent, FitOptions};

/// The lowest priority, so that a fit takes only what serving leaves.
const NICE: i32 = 19;

/// What a fit has said since it was asked last.
#[derive(Debug, Clone, Default)]
pub(super) struct Update {
    pub(super) progress: RunProgress,
    pub(super) epochs: Vec<EpochReport>,
    pub(super) notes: Vec<String>,
}

struct Shared {
    began: Instant,
    cancelled: AtomicBool,
    update: Mutex<Update>,
}

impl Shared {
    fn hear(&self, event: FitEvent<'_>) -> ControlFlow<()> {
        let mut update = self.update.lock().unwrap_or_else(PoisonError::into_inner);
        match event {
            FitEvent::Progress(progress) => {
                update.progress.clone_from(progress);
                update.progress.remaining_s = remaining_s(progress, self.began.elapsed());
            }
            FitEvent::Epoch(report) => update.epochs.push(*report),
            FitEvent::Note(line) => update.notes.push(line.to_owned()),
        }
        if self.cancelled.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// What was said since the last call; the progress stays.
    fn take(&self) -> Update {
        let mut update = self.update.lock().unwrap_or_else(PoisonError::into_inner);
        let progress = update.progress.clone();
        std::mem::replace(&mut *update, Update { progress, ..Update::default() })
    }
}

/// A fit under way. Dropping it cancels the fit.
pub(super) struct Fitting {
    shared: Arc<Shared>,
    fitted: oneshot::Receiver<Result<Artifact, FitError>>,
    outcome: Option<Result<Artifact, FitError>>,
}

impl Fitting {
    /// Starts the thread.
    pub(super) fn begin(samples: Arc<Vec<Sample>>, options: FitOptions) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            began: Instant::now(),
            cancelled: AtomicBool::new(false),
            update: Mutex::default(),
        });
        let (sender, fitted) = oneshot::channel();
        let heard = shared.clone();
        std::thread::Builder::new().name("fit".to_owned()).spawn(move || {
            // Where the system has no priorities the fit runs at the common one.
            let _ = rustix::process::nice(NICE);
            let fitted = model::fit(&samples, &options, &mut |event| heard.hear(event));
            // Nobody waits any more only if the worker was dropped.
            let _ = sender.send(fitted);
        })?;
        Ok(Self { shared, fitted, outcome: None })
    }

    /// Asks the fit to stop at its next step.
    pub(super) fn cancel(&self) {
        self.shared.cancelled.store(true, Ordering::Relaxed);
    }

    /// Waits until the fit has ended.
    pub(super) async fn ended(&mut self) {
        if self.outcome.is_none() {
            let fitted = (&mut self.fitted).await;
            self.outcome = Some(fitted.unwrap_or_else(|_| Err(panicked())));
        }
    }

    pub(super) fn take_update(&self) -> Update {
        self.shared.take()
    }

    /// What the fit yielded, and what it said last.
    pub(super) async fn finish(mut self) -> (Result<Artifact, FitError>, Update) {
        self.ended().await;
        let update = self.shared.take();
        (self.outcome.take().unwrap_or_else(|| Err(panicked())), update)
    }
}

impl Drop for Fitting {
    fn drop(&mut self) {
        self.cancel();
    }
}

/// Seconds left if the epochs to come take as long as those done.
fn remaining_s(progress: &RunProgress, elapsed: Duration) -> Option<f64> {
    let left = progress.epochs.checked_sub(progress.epoch)?;
    (progress.epoch > 0).then(|| elapsed.as_secs_f64() * f64::from(left) / f64::from(progress.epoch))
}

fn panicked() -> FitError {
    FitError::Fault("the fit's thread ended without a word".into())
}
