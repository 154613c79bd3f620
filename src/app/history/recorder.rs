//! Recording the path of one track while it lives.
//!
//! A track that goes on for long is written while it lasts, a window at a time: a crash loses no more than a window and a
//! lag of it, and its path needs no more memory.

use super::path::{FinishedTrack, RecordedPath, RecordedState};
use super::queue::{HistoryQueue, Work};
use crate::domain::{HistorySettings, TrackScope};

/// Records the path of one track; queues it in windows, and the rest when it is dropped.
pub(in crate::app) struct TrackRecorder {
    queue: HistoryQueue,
    scope: TrackScope,
    settings: HistorySettings,
    path: Option<RecordedPath>,
}

impl TrackRecorder {
    /// Records a new track.
    pub(in crate::app) const fn new(
        queue: HistoryQueue,
        scope: TrackScope,
        settings: HistorySettings,
    ) -> Self {
        Self { queue, scope, settings, path: None }
    }

    /// Adds an estimate. A track that begins again, or goes back in time, is finished first.
    pub(in crate::app) fn push(&mut self, state: &RecordedState<'_>) {
        let continues = self.path.as_ref().is_some_and(|path| path.is_continued_by(state));
        if !continues {
            self.queue_finished();
            self.path = Some(RecordedPath::start(state, self.queue.track_bytes));
        }
        if let Some(path) = &mut self.path {
            path.push(state);
        }
        self.queue_settled();
    }

    /// Ends the recording and returns the track, for whoever can wait until there is room in the queue.
    pub(in crate::app) fn finish(mut self) -> Option<FinishedTrack> {
        self.take_finished()
    }

    fn take_finished(&mut self) -> Option<FinishedTrack> {
        let path = self.path.take()?;
        Some(FinishedTrack { scope: self.scope.clone(), settings: self.settings, path, until: None })
    }

    /// Queues a window that no later estimate will change. While the queue is full the path grows on.
    fn queue_settled(&mut self) {
        let Some(path) = &mut self.path else { return };
        let Some(until) = path.settled_until() else { return };
        let Ok(place) = self.queue.sender.try_reserve() else { return };
        let (scope, settings) = (self.scope.clone(), self.settings);
        let track = FinishedTrack { scope, settings, path: path.clone(), until: Some(until) };
        place.send(Work::Write(Box::new(track)));
        path.continue_from(until);
    }

    fn queue_finished(&mut self) {
        let Some(track) = self.take_finished() else { return };
        if self.queue.sender.try_send(Work::Write(Box::new(track))).is_err() {
            self.queue.metrics.finished_track_dropped();
            tracing::warn!(scope = %self.scope, "a finished track is not kept: too many wait for the archive");
        }
    }
}

impl Drop for TrackRecorder {
    fn drop(&mut self) {
        self.queue_finished();
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use tokio::sync::mpsc;

    use super::*;
    use crate::domain::{CameraId, Velocity};
    use crate::fusion::smoother::FilterMoments;
    use crate::geo::{PlaneCovariance, Position};
    use crate::telemetry::Metrics;

    /// An estimate of a target that walks to the east, at a second.
    fn state(second: i64) -> RecordedState<'static> {
        let longitude_deg = 8.0 + 1.3e-5 * second as f64;
        RecordedState {
            track: Some("1".to_owned()),
            target: None,
            class: None,
            time: Timestamp::from_second(second).expect("in range"),
            position: Position::new(longitude_deg, 47.0).expect("valid"),
            velocity: Velocity { east_m_s: 1.0, north_m_s: 0.0 },
            covariance: PlaneCovariance::isotropic(1.0),
            velocity_covariance: PlaneCovariance::isotropic(0.1),
            stationary_probability: 0.0,
            moments: FilterMoments::default(),
            is_restarted: false,
        }
    }

    fn recorder(room: usize) -> (TrackRecorder, mpsc::Receiver<Work>) {
        let (sender, waiting) = mpsc::channel(room);
        let queue = HistoryQueue { sender, track_bytes: 1 << 20, metrics: Metrics::new() };
        let scope = TrackScope::Camera(CameraId::new("gate").expect("a slug"));
        let settings = HistorySettings::new(1, 1_000_000, 0.0).expect("valid");
        (TrackRecorder::new(queue, scope, settings), waiting)
    }

    /// The seconds that are written of each piece in the queue.
    fn written(waiting: &mut mpsc::Receiver<Work>) -> Vec<Vec<i64>> {
        let pieces = std::iter::from_fn(|| waiting.try_recv().ok());
        let rows = pieces.filter_map(|work| match work {
            Work::Write(track) => Some(track.rows()),
            Work::Flush(_) => None,
        });
        rows.map(|rows| rows.iter().map(|row| row.time.as_second()).collect()).collect()
    }

    #[test]
    fn a_track_that_goes_on_is_queued_in_windows_once_a_lag_has_passed() {
        let (mut recorder, mut waiting) = recorder(8);
        (0..=30).for_each(|second| recorder.push(&state(second)));
        assert_eq!(written(&mut waiting), [(0..20).collect::<Vec<_>>()]);
        (31..80).for_each(|second| recorder.push(&state(second)));
        drop(recorder);
        let pieces = [20..40, 40..60, 60..80].map(|seconds| seconds.collect::<Vec<_>>());
        assert_eq!(written(&mut waiting), pieces);
    }

    #[test]
    fn a_path_grows_on_while_the_queue_is_full() {
        let (mut recorder, mut waiting) = recorder(1);
        (0..=300).for_each(|second| recorder.push(&state(second)));
        assert_eq!(written(&mut waiting), [(0..20).collect::<Vec<_>>()]);
        recorder.push(&state(301));
        assert_eq!(written(&mut waiting), [(20..291).collect::<Vec<_>>()]);
    }

    #[test]
    fn a_finished_track_beyond_the_limit_of_the_queue_is_counted() {
        let (mut recorder, mut waiting) = recorder(1);
        let metrics = recorder.queue.metrics.clone();
        for start in [0, 100, 200] {
            recorder.push(&state(start));
        }
        drop(recorder);
        assert_eq!(written(&mut waiting), [[0]]);
        assert!(metrics.render().contains("\nsightfix_finished_tracks_dropped_total 2\n"));
    }
}
