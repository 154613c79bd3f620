//! Work on a thread of its own at the lowest priority, seen from tokio.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

/// The lowest priority, so that work takes only what serving leaves.
const NICE: i32 = 19;

/// What work has said so far.
pub(super) trait Said: Default + Send + 'static {
    /// What was said since the last call; what still holds stays.
    fn take(&mut self) -> Self;
}

struct Shared<S> {
    began: Instant,
    cancelled: AtomicBool,
    said: Mutex<S>,
}

/// By which work tells how far it has come, and hears whether to stop.
pub(super) struct Voice<S>(Arc<Shared<S>>);

impl<S> Voice<S> {
    /// Changes what is said. Once the work was cancelled, the answer is always to break.
    pub(super) fn say(&self, change: impl FnOnce(&mut S)) -> ControlFlow<()> {
        change(&mut self.0.said.lock().unwrap_or_else(PoisonError::into_inner));
        if self.0.cancelled.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Seconds left if the steps to come take as long as those done.
    pub(super) fn remaining_s(&self, done: u32, planned: u32) -> Option<f64> {
        remaining_s(done, planned, self.0.began.elapsed())
    }
}

fn remaining_s(done: u32, planned: u32, elapsed: Duration) -> Option<f64> {
    let left = planned.checked_sub(done)?;
    (done > 0).then(|| elapsed.as_secs_f64() * f64::from(left) / f64::from(done))
}

/// Work under way. Dropping it asks the work to stop.
pub(super) struct Aside<S, Y> {
    shared: Arc<Shared<S>>,
    yielded: oneshot::Receiver<Y>,
    /// The outer `Option` tells whether the work has ended, the inner whether it did so with a word.
    outcome: Option<Option<Y>>,
}

impl<S: Said, Y: Send + 'static> Aside<S, Y> {
    /// Starts the thread.
    pub(super) fn begin(
        name: &str,
        work: impl FnOnce(&Voice<S>) -> Y + Send + 'static,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            began: Instant::now(),
            cancelled: AtomicBool::new(false),
            said: Mutex::default(),
        });
        let (sender, yielded) = oneshot::channel();
        let voice = Voice(shared.clone());
        std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            // Where the system has no priorities the work runs at the common one.
            let _ = rustix::process::nice(NICE);
            // Nobody waits any more only if the worker was dropped.
            let _ = sender.send(work(&voice));
        })?;
        Ok(Self { shared, yielded, outcome: None })
    }

    /// What was said since the last call.
    pub(super) fn take_said(&self) -> S {
        self.shared.said.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Waits until the work has ended.
    pub(super) async fn ended(&mut self) {
        if self.outcome.is_none() {
            self.outcome = Some((&mut self.yielded).await.ok());
        }
    }

    /// What the work yielded, `None` if it panicked, and what it said last.
    pub(super) async fn finish(mut self) -> (Option<Y>, S) {
        self.ended().await;
        let said = self.take_said();
        (self.outcome.take().flatten(), said)
    }
}

impl<S, Y> Aside<S, Y> {
    /// Asks the work to stop at its next step.
    pub(super) fn cancel(&self) {
        self.shared.cancelled.store(true, Ordering::Relaxed);
    }
}

impl<S, Y> Drop for Aside<S, Y> {
    fn drop(&mut self) {
        self.cancel();
    }
}
