//! The way of finished tracks to the task that writes them.

use std::sync::OnceLock;

use tokio::sync::{mpsc, oneshot};

use super::path::FinishedTrack;
use crate::archive::Archive;
use crate::config::Limits;
use crate::domain::{Error, Result};
use crate::telemetry::Metrics;

/// The way of finished tracks to the archive, and the archive itself once the server has opened it.
pub struct ArchivedHistory {
    pub(super) archive: OnceLock<Archive>,
    queue: HistoryQueue,
}

/// The way of finished tracks to the archive. Cheap to clone.
#[derive(Clone)]
pub(in crate::app) struct HistoryQueue {
    pub(super) sender: mpsc::Sender<Work>,
    /// Memory of one recorded track, bytes.
    pub(super) track_bytes: usize,
    pub(super) metrics: Metrics,
}

/// The work of the task that writes.
pub(in crate::app) enum Work {
    Write(Box<FinishedTrack>),
    /// Answered once everything before it is written.
    Flush(oneshot::Sender<()>),
}

impl ArchivedHistory {
    /// With the receiving end for the task that writes.
    pub(in crate::app) fn new(limits: &Limits, metrics: Metrics) -> (Self, mpsc::Receiver<Work>) {
        let (sender, waiting) = mpsc::channel(limits.history_queue.max(1));
        let queue = HistoryQueue { sender, track_bytes: limits.history_track_bytes, metrics };
        (Self { archive: OnceLock::new(), queue }, waiting)
    }

    /// Keeps finished tracks in an archive from now on.
    pub fn use_archive(&self, archive: Archive) {
        self.archive.get_or_init(|| archive);
    }

    pub(in crate::app) const fn queue(&self) -> &HistoryQueue {
        &self.queue
    }

    /// Waits until everything that was queued before is written.
    pub(in crate::app) async fn flush(&self) {
        let (done, written) = oneshot::channel();
        if self.queue.sender.send(Work::Flush(done)).await.is_ok() {
            // The task ends only with the application.
            let _ = written.await;
        }
    }
}

impl HistoryQueue {
    /// Queues finished tracks, waiting for room.
    pub(in crate::app) async fn send_all(&self, tracks: impl IntoIterator<Item = FinishedTrack>) {
        for track in tracks {
            // A closed queue has no reader any more.
            let _ = self.sender.send(Work::Write(Box::new(track))).await;
        }
    }
}

/// Runs work on the archive on a thread for blocking work.
pub(super) async fn on_archive<T: Send + 'static>(
    archive: &Archive,
    work: impl FnOnce(&Archive) -> Result<T> + Send + 'static,
) -> Result<T> {
    let archive = archive.clone();
    tokio::task::spawn_blocking(move || work(&archive)).await.map_err(Error::fault)?
}
