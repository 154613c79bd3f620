//! World tracks as they are read: the latest point and a thinned history of each.

use std::collections::HashMap;
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use crate::app::live::history::History;
use crate::domain::{CameraId, LiveId, Motion, ReceiverId, ReceiverMatch, TargetId, Velocity};
use crate::geo::{PlaneCovariance, Position};

/// A camera is taken to see a target until this long after its latest detection.
const SEEN_FOR: SignedDuration = SignedDuration::from_secs(1);

/// Where a target of a site is by its world track, at the latest instant measured.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldTrackPoint {
    pub id: LiveId,
    /// The target, once one of its receivers is known: by its name, or by `receiver_match`.
    pub target_id: Option<TargetId>,
    /// The receiver that the target carries, where it was found by association.
    pub receiver_match: Option<ReceiverMatch>,
    /// The instant of the latest measurement.
    pub time: Timestamp,
    /// Time of the first measurement.
    pub started_at: Timestamp,
    /// The target's position.
    pub position: Position,
    pub velocity: Velocity,
    /// Speed and course.
    pub motion: Motion,
    /// Covariance of the position's error, m2.
    pub covariance_m2: PlaneCovariance,
    /// Covariance of the velocity's error, m2/s2.
    pub velocity_covariance_m2_s2: PlaneCovariance,
    /// The cameras that see the target at the instant.
    pub sightings: Vec<WorldSighting>,
}

impl WorldTrackPoint {
    /// Radius about the position that holds the true one with 95 % probability, m.
    #[must_use]
    pub fn r95_m(&self) -> f64 {
        self.covariance_m2.r95_m()
    }

    /// The tracker ids under which cameras see the target, with the camera of each.
    fn tracker_ids(&self) -> impl Iterator<Item = (&CameraId, &TargetId)> {
        self.sightings
            .iter()
            .filter_map(|sighting| Some((&sighting.camera_id, sighting.tracker_id.as_ref()?)))
    }
}

/// A camera that sees a target.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldSighting {
    pub camera_id: CameraId,
    /// The id that its tracker gives the target, if any.
    pub tracker_id: Option<TargetId>,
    /// When it saw the target last.
    pub last_seen_at: Timestamp,
}

impl WorldSighting {
    /// True if the camera still sees the target at an instant.
    pub(super) fn is_current(last_seen_at: Timestamp, now: Timestamp) -> bool {
        now.duration_since(last_seen_at) <= SEEN_FOR
    }
}

/// The tracks of a site.
#[derive(Default)]
pub(super) struct PublishedTracks {
    tracks: HashMap<LiveId, History<WorldTrackPoint>>,
    /// By camera and tracker id, from the sightings of the latest points.
    by_tracker_id: HashMap<CameraId, HashMap<TargetId, LiveId>>,
}

impl PublishedTracks {
    /// Publishes the latest point of a track.
    pub(super) fn publish(&mut self, point: &Arc<WorldTrackPoint>, most_points: usize) {
        let previous = self.latest_of(point.id).cloned();
        if let Some(previous) = previous {
            self.forget_tracker_ids(&previous);
        }
        for (camera, tracker_id) in point.tracker_ids() {
            let of_camera = self.by_tracker_id.entry(camera.clone()).or_default();
            of_camera.insert(tracker_id.clone(), point.id);
        }
        self.tracks.entry(point.id).or_default().push(point, |point| point.time, most_points);
    }

    /// Removes a track that has ended.
    pub(super) fn remove(&mut self, id: LiveId) {
        let ended = self.tracks.remove(&id);
        if let Some(latest) = ended.as_ref().and_then(History::latest) {
            self.forget_tracker_ids(latest);
        }
    }

    fn forget_tracker_ids(&mut self, point: &WorldTrackPoint) {
        for (camera, tracker_id) in point.tracker_ids() {
            let Some(of_camera) = self.by_tracker_id.get_mut(camera) else { continue };
            // Another track may have taken the id over.
            if of_camera.get(tracker_id) == Some(&point.id) {
                of_camera.remove(tracker_id);
            }
            if of_camera.is_empty() {
                self.by_tracker_id.remove(camera);
            }
        }
    }

    pub(super) fn track_of(&self, camera: &CameraId, tracker_id: &TargetId) -> Option<LiveId> {
        self.by_tracker_id.get(camera)?.get(tracker_id).copied()
    }

    /// True if a track is matched with the receiver.
    pub(super) fn carries(&self, receiver_id: &ReceiverId) -> bool {
        let matches = self.tracks.values().filter_map(|own| own.latest()?.receiver_match.as_ref());
        matches.into_iter().any(|own| own.receiver_id == *receiver_id)
    }

    /// The latest point of a track.
    pub(super) fn latest_of(&self, id: LiveId) -> Option<&Arc<WorldTrackPoint>> {
        self.tracks.get(&id).and_then(History::latest)
    }

    pub(super) fn latest(&self) -> Vec<Arc<WorldTrackPoint>> {
        let mut points: Vec<_> =
            self.tracks.values().filter_map(|history| history.latest().cloned()).collect();
        points.sort_by_key(|point| point.id);
        points
    }

    pub(super) fn history(&self, id: LiveId) -> Option<Vec<Arc<WorldTrackPoint>>> {
        Some(self.tracks.get(&id)?.points())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(number: u64, ms: i64, seen_as: &[(&str, &str)]) -> Arc<WorldTrackPoint> {
        let time = Timestamp::from_millisecond(ms).expect("in range");
        let sighting = |(camera, tracker_id): &(&str, &str)| WorldSighting {
            camera_id: CameraId::new(camera).expect("a slug"),
            tracker_id: Some(TargetId::new(tracker_id).expect("a name")),
            last_seen_at: time,
        };
        Arc::new(WorldTrackPoint {
            id: LiveId { epoch: 1, number },
            target_id: None,
            receiver_match: None,
            time,
            started_at: time,
            position: Position::new(8.0, 47.0).expect("valid"),
            velocity: Velocity::default(),
            motion: Motion::of(Velocity::default(), PlaneCovariance::isotropic(1.0), 0.5),
            covariance_m2: PlaneCovariance::isotropic(1.0),
            velocity_covariance_m2_s2: PlaneCovariance::isotropic(1.0),
            sightings: seen_as.iter().map(sighting).collect(),
        })
    }

    #[test]
    fn a_tracker_id_names_the_track_that_was_seen_under_it_last() {
        let mut tracks = PublishedTracks::default();
        let number = |tracks: &PublishedTracks, camera: &str, tracker_id: &str| {
            let camera = CameraId::new(camera).expect("a slug");
            let tracker_id = TargetId::new(tracker_id).expect("a name");
            tracks.track_of(&camera, &tracker_id).map(|id| id.number)
        };
        tracks.publish(&point(1, 0, &[("a", "7"), ("b", "7")]), 10);
        tracks.publish(&point(2, 10, &[("b", "8")]), 10);
        assert_eq!((number(&tracks, "a", "7"), number(&tracks, "b", "8")), (Some(1), Some(2)));
        // The trackers' ids of both targets are swapped in one camera; the second track is published first.
        tracks.publish(&point(2, 20, &[("b", "7")]), 10);
        tracks.publish(&point(1, 20, &[("a", "7"), ("b", "8")]), 10);
        assert_eq!((number(&tracks, "b", "7"), number(&tracks, "b", "8")), (Some(2), Some(1)));
        tracks.remove(LiveId { epoch: 1, number: 1 });
        assert_eq!((number(&tracks, "a", "7"), number(&tracks, "b", "7")), (None, Some(2)));
        tracks.remove(LiveId { epoch: 1, number: 2 });
        assert!(tracks.latest().is_empty() && tracks.by_tracker_id.is_empty());
    }
}
