//! The state in memory of one camera that exists, from its creation to its deletion.

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::camera_events::CameraEventLog;
use super::drift::DriftMonitor;
use super::learning::LiveLearning;
use super::matching::LiveMatching;
use super::sample_recorder::SampleRecorder;
use super::sync::lock;
use super::tracks::{TrackPoint, Tracks};
use crate::app::history::path::FinishedTrack;
use crate::domain::{BoundingBox, CameraMoved, FusedFix, Score, TargetClass, TargetId, TrackerId};

/// When something was observed, by the server's clock.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Observed {
    /// The time of the last one.
    pub(super) last_at: Option<Timestamp>,
    /// Since when every box was frozen.
    pub(super) frozen_since: Option<Timestamp>,
}

/// An event in a camera's view.
#[derive(Debug, Clone)]
pub enum CameraEvent {
    /// A target was measured.
    Track(Arc<TargetUpdate>),
    /// A box was seen that has no position: the camera has no model.
    Box(Arc<UnplacedBox>),
    /// The camera's pose has changed.
    Moved(Arc<CameraMoved>),
}

/// A measured target: its track, and the observation that updated it.
#[derive(Debug)]
pub struct TargetUpdate {
    /// The track's position with it.
    pub point: Arc<TrackPoint>,
    /// The observation's box.
    pub bounding_box: Option<BoundingBox>,
    /// The observation's own position; `None` for a box while the camera has no model.
    pub fused: Option<FusedFix>,
}

/// A box of a camera that has no model.
#[derive(Debug)]
pub struct UnplacedBox {
    /// Time of the frame.
    pub time: Timestamp,
    /// The target, where the detector knows it.
    pub target_id: Option<TargetId>,
    /// The id that the camera's tracker gave it.
    pub tracker_id: Option<TrackerId>,
    /// The box.
    pub bounding_box: BoundingBox,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
}

/// Tracks, drift detection, listeners and the recording of samples of one camera.
pub(in crate::app) struct CameraLive {
    pub(super) tracks: Tracks,
    pub(super) drift: DriftMonitor,
    pub(super) matching: LiveMatching,
    pub(in crate::app) learning: LiveLearning,
    pub(super) events: CameraEventLog<CameraEvent>,
    pub(super) moved: watch::Sender<Option<Arc<CameraMoved>>>,
    pub(super) recorder: Mutex<Weak<SampleRecorder>>,
    observed: Mutex<Observed>,
    open_streams: AtomicUsize,
    deleted: CancellationToken,
    replaced: CancellationToken,
    /// The fence under which it was changed last; 0 before the first.
    tenure: AtomicI64,
    /// True if the next fence may have been given to another node as well.
    may_have_gap: AtomicBool,
}

impl CameraLive {
    /// `event_log` names its events; another number for every run of the server.
    pub(in crate::app) fn new(event_log: u64) -> Arc<Self> {
        Arc::new(Self {
            tracks: Tracks::default(),
            drift: DriftMonitor::default(),
            matching: LiveMatching::default(),
            learning: LiveLearning::default(),
            events: CameraEventLog::new(event_log),
            moved: watch::channel(None).0,
            recorder: Mutex::new(Weak::new()),
            observed: Mutex::new(Observed::default()),
            open_streams: AtomicUsize::new(0),
            deleted: CancellationToken::new(),
            replaced: CancellationToken::new(),
            tenure: AtomicI64::new(0),
            may_have_gap: AtomicBool::new(false),
        })
    }

    /// Ends the recordings of targets that have not been observed for too long.
    pub(in crate::app) fn finish_silent_tracks(&self, now: Duration) {
        self.tracks.remove_silent(now);
    }

    /// Ends all recordings.
    pub(in crate::app) fn finish_all_tracks(&self) -> Vec<FinishedTrack> {
        self.tracks.finish_all()
    }

    /// Ends the streams and listeners of a camera that was deleted.
    pub(in crate::app) fn end(&self) {
        self.deleted.cancel();
    }

    /// Takes the fence of a new tenure; false if another node may have had the camera since the one before.
    pub(in crate::app) fn continue_under(&self, fence: i64) -> bool {
        let before = self.tenure.swap(fence, Ordering::AcqRel);
        let may_have_gap = self.may_have_gap.swap(false, Ordering::AcqRel);
        before == 0 || before + 1 == fence && !may_have_gap
    }

    /// The database continues from an earlier state: it may give fences again that it had given before, so the next one does
    /// not tell whether another node had the camera.
    pub(in crate::app) fn note_gap(&self) {
        self.may_have_gap.store(true, Ordering::Release);
    }

    /// True if a later tenure than that of this state has begun.
    pub(in crate::app) fn is_before(&self, fence: i64) -> bool {
        (1..fence).contains(&self.tenure.load(Ordering::Acquire))
    }

    /// Ends the readers of a state that another one replaces.
    pub(in crate::app) fn replace(&self) {
        self.replaced.cancel();
    }

    pub(super) fn is_replaced(&self) -> bool {
        self.replaced.is_cancelled()
    }

    pub(super) async fn replaced(&self) {
        self.replaced.cancelled().await;
    }

    /// True if the camera is deleted.
    #[cfg(test)]
    pub(in crate::app) fn is_deleted(&self) -> bool {
        self.deleted.is_cancelled()
    }

    /// Waits until the camera is deleted.
    pub(super) async fn deleted(&self) {
        self.deleted.cancelled().await;
    }

    /// Makes the update only if somebody listens, or may come back. `now` is a reading of the monotonic clock.
    pub(super) fn announce_track(&self, now: Duration, update: impl FnOnce() -> TargetUpdate) {
        self.events.push(now, || CameraEvent::Track(Arc::new(update())));
    }

    /// The same for a box without a position.
    pub(super) fn announce_box(&self, now: Duration, unplaced: impl FnOnce() -> UnplacedBox) {
        self.events.push(now, || CameraEvent::Box(Arc::new(unplaced())));
    }

    /// Remembers that something was observed at that time of the server, and whether its box, if it has one, is frozen.
    pub(super) fn observed(&self, now: Timestamp, is_frozen: Option<bool>) {
        let mut observed = lock(&self.observed);
        observed.last_at = Some(now);
        match is_frozen {
            Some(true) => _ = observed.frozen_since.get_or_insert(now),
            Some(false) => observed.frozen_since = None,
            None => {}
        }
    }

    /// Returns the counts of what was observed since the server was started.
    pub(super) fn latest_observed(&self) -> Observed {
        *lock(&self.observed)
    }

    /// Open live streams.
    pub(super) fn open_streams(&self) -> usize {
        self.open_streams.load(Ordering::Relaxed)
    }

    /// Counts a live stream until the guard is dropped.
    pub(super) fn count_stream(self: &Arc<Self>) -> StreamCount {
        self.open_streams.fetch_add(1, Ordering::Relaxed);
        StreamCount(self.clone())
    }

    pub(super) fn announce_move(&self, now: Duration, moved: Arc<CameraMoved>) {
        self.events.push(now, || CameraEvent::Moved(moved.clone()));
        self.moved.send_replace(Some(moved));
    }
}

/// One open live stream of a camera.
pub(super) struct StreamCount(Arc<CameraLive>);

impl Drop for StreamCount {
    fn drop(&mut self) {
        self.0.open_streams.fetch_sub(1, Ordering::Relaxed);
    }
}
