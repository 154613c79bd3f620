//! Work on a thread of its own at the lowest priority, observed from tokio.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

/// The lowest scheduling priority, so that background work takes only what serving leaves.
const NICE: i32 = 19;

/// The progress that a job reports while it runs.
pub(super) trait JobProgress: Default + Send + 'static {
    /// Takes the events since the last call, and copies the current state, which stays.
    fn take(&mut self) -> Self;
}

struct ThreadState<P> {
    started: Instant,
    cancelled: AtomicBool,
    progress: Mutex<P>,
}

/// Where work reports its progress and learns whether it was cancelled.
pub(super) struct ProgressSink<P>(Arc<ThreadState<P>>);

impl<P> ProgressSink<P> {
    /// Changes the reported progress. Breaks once the work was cancelled.
    pub(super) fn update(&self, change: impl FnOnce(&mut P)) -> ControlFlow<()> {
        change(&mut self.0.progress.lock().unwrap_or_else(PoisonError::into_inner));
        if self.0.cancelled.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Seconds left if the remaining steps take as long as those done; `None` before the first.
    pub(super) fn remaining_s(&self, done: u32, planned: u32) -> Option<f64> {
        remaining_s(done, planned, self.0.started.elapsed())
    }
}

fn remaining_s(done: u32, planned: u32, elapsed: Duration) -> Option<f64> {
    let left = planned.checked_sub(done)?;
    (done > 0).then(|| elapsed.as_secs_f64() * f64::from(left) / f64::from(done))
}

/// A running thread of work. Dropping it asks the work to stop.
pub(super) struct JobThread<P, O> {
    shared: Arc<ThreadState<P>>,
    output: oneshot::Receiver<O>,
    /// The outer `Option`: whether the thread has ended. The inner: its output, `None` if it panicked.
    ended: Option<Option<O>>,
}

impl<P: JobProgress, O: Send + 'static> JobThread<P, O> {
    /// Starts the thread.
    pub(super) fn spawn(
        name: &str,
        work: impl FnOnce(&ProgressSink<P>) -> O + Send + 'static,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(ThreadState {
            started: Instant::now(),
            cancelled: AtomicBool::new(false),
            progress: Mutex::default(),
        });
        let (sender, output) = oneshot::channel();
        let sink = ProgressSink(shared.clone());
        std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            // Where the system has no priorities the work runs at the common one.
            let _ = rustix::process::nice(NICE);
            // The receiver is gone only if the worker was dropped.
            let _ = sender.send(work(&sink));
        })?;
        Ok(Self { shared, output, ended: None })
    }

    /// Takes the progress since the last call.
    pub(super) fn take_progress(&self) -> P {
        self.shared.progress.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Waits until the thread has ended.
    pub(super) async fn ended(&mut self) {
        if self.ended.is_none() {
            self.ended = Some((&mut self.output).await.ok());
        }
    }

    /// The output, `None` if the thread panicked, and the last progress.
    pub(super) async fn join(mut self) -> (Option<O>, P) {
        self.ended().await;
        let progress = self.take_progress();
        (self.ended.take().flatten(), progress)
    }
}

impl<P, O> JobThread<P, O> {
    /// Asks the work to stop at its next step.
    pub(super) fn cancel(&self) {
        self.shared.cancelled.store(true, Ordering::Relaxed);
    }
}

impl<P, O> Drop for JobThread<P, O> {
    fn drop(&mut self) {
        self.cancel();
    }
}
