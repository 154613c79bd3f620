//! The end of a server, in two steps: first no new work, then no work at all.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Time for tasks to drop what they do, before they are left behind.
const FORCED_TIME: Duration = Duration::from_secs(1);

/// Handed to everything that runs for long. Clones speak of the same end.
///
/// One pointer: handlers clone it with every request, and each clone of a token takes its lock.
#[derive(Clone, Default)]
pub struct Shutdown(Arc<Tokens>);

#[derive(Default)]
struct Tokens {
    soft: CancellationToken,
    hard: CancellationToken,
    tasks: TaskTracker,
}

impl Shutdown {
    /// Nothing has ended yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks for the end: accept nothing new, end streams and runs in order.
    pub fn begin(&self) {
        self.0.soft.cancel();
    }

    /// Whether the end was asked for.
    #[must_use]
    pub fn has_begun(&self) -> bool {
        self.0.soft.is_cancelled()
    }

    /// Waits until the end is asked for.
    pub async fn begun(&self) {
        self.0.soft.cancelled().await;
    }

    /// Waits until the time to end in order is over.
    pub async fn overdue(&self) {
        self.0.hard.cancelled().await;
    }

    /// Runs a task that the end waits for.
    pub fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        self.0.tasks.spawn(task);
    }

    /// Waits until every task has ended, `timeout` at most; in the last part of it the tasks are
    /// asked to drop what they do. Whether all of them ended before that.
    pub async fn finish(&self, timeout: Duration) -> bool {
        self.0.soft.cancel();
        self.0.tasks.close();
        let forced_time = FORCED_TIME.min(timeout / 2);
        if tokio::time::timeout(timeout - forced_time, self.0.tasks.wait()).await.is_ok() {
            return true;
        }
        self.0.hard.cancel();
        // A task that ignores even this is left behind: the process ends anyway.
        let _ = tokio::time::timeout(forced_time, self.0.tasks.wait()).await;
        false
    }
}
