//! Shutdown in two steps: draining (no new work), then forced (no work at all).

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Time for tasks to drop what they do, before the process ends without them.
const FORCED_TIME: Duration = Duration::from_secs(1);

/// Handed to everything that runs for long. Clones share one state.
///
/// One pointer: handlers clone it with every request, and each clone of a token takes its lock.
#[derive(Clone, Default)]
pub struct Shutdown(Arc<ShutdownState>);

#[derive(Default)]
struct ShutdownState {
    draining: CancellationToken,
    forced: CancellationToken,
    tasks: TaskTracker,
}

impl Shutdown {
    /// A server that runs.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Starts to drain: accept nothing new, end streams and runs in order.
    pub fn drain(&self) {
        self.0.draining.cancel();
    }

    /// True if the drain has started.
    #[must_use]
    pub fn is_draining(&self) -> bool {
        self.0.draining.is_cancelled()
    }

    /// Waits until the drain starts.
    pub async fn draining(&self) {
        self.0.draining.cancelled().await;
    }

    /// Waits until the time to drain is over.
    pub async fn forced(&self) {
        self.0.forced.cancelled().await;
    }

    /// Runs a task that the drain waits for.
    pub fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        self.0.tasks.spawn(task);
    }

    /// Drains, for at most `timeout`: waits until every task has ended; in the last part of the time
    /// tasks are asked to drop what they do. Whether all of them ended before that.
    pub async fn drain_with_timeout(&self, timeout: Duration) -> bool {
        self.drain();
        self.0.tasks.close();
        let forced_time = FORCED_TIME.min(timeout / 2);
        if tokio::time::timeout(timeout - forced_time, self.0.tasks.wait()).await.is_ok() {
            return true;
        }
        self.0.forced.cancel();
        // A task that ignores even this is abandoned: the process ends anyway.
        let _ = tokio::time::timeout(forced_time, self.0.tasks.wait()).await;
        false
    }
}
