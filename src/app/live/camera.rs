//! The state in memory of one camera that exists, from its creation to its deletion.

use std::sync::{Arc, Mutex, Weak};

use tokio::sync::{broadcast, watch};
use tokio_util::sync::CancellationToken;

use super::drift::DriftMonitor;
use super::sample_recorder::SampleRecorder;
use super::tracks::{TrackPoint, Tracks};
use crate::domain::CameraMoved;

/// Events that a slow reader may lag behind before it loses some.
const EVENTS_BEHIND: usize = 256;

/// What happens in a camera's view.
#[derive(Debug, Clone)]
pub enum CameraEvent {
    /// A target was measured.
    Track(Arc<TrackPoint>),
    /// The camera's pose has changed.
    Moved(Arc<CameraMoved>),
}

/// Tracks, drift detection, listeners and the recording of samples of one camera.
pub(in crate::app) struct CameraLive {
    pub(super) tracks: Tracks,
    pub(super) drift: DriftMonitor,
    pub(super) events: broadcast::Sender<CameraEvent>,
    pub(super) moved: watch::Sender<Option<Arc<CameraMoved>>>,
    pub(super) recorder: Mutex<Weak<SampleRecorder>>,
    deleted: CancellationToken,
}

impl CameraLive {
    pub(in crate::app) fn new() -> Arc<Self> {
        Arc::new(Self {
            tracks: Tracks::default(),
            drift: DriftMonitor::default(),
            events: broadcast::channel(EVENTS_BEHIND).0,
            moved: watch::channel(None).0,
            recorder: Mutex::new(Weak::new()),
            deleted: CancellationToken::new(),
        })
    }

    /// Ends the streams and listeners of a camera that was deleted.
    pub(in crate::app) fn end(&self) {
        self.deleted.cancel();
    }

    /// Whether the camera is deleted.
    #[cfg(test)]
    pub(in crate::app) fn is_deleted(&self) -> bool {
        self.deleted.is_cancelled()
    }

    /// Waits until the camera is deleted.
    pub(super) async fn deleted(&self) {
        self.deleted.cancelled().await;
    }

    pub(super) fn announce_track(&self, point: &Arc<TrackPoint>) {
        // An error means that nobody listens.
        let _ = self.events.send(CameraEvent::Track(point.clone()));
    }

    pub(super) fn announce_move(&self, moved: Arc<CameraMoved>) {
        let _ = self.events.send(CameraEvent::Moved(moved.clone()));
        self.moved.send_replace(Some(moved));
    }
}
