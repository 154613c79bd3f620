//! How unlikely it is that a detection is of a track: the cost of the pair in the assignment.
//!
//! ```text
//! cost = ln beta - ln(exp(-c) + kappa)      c = (d^2 + ln |S|) / 2 - bonus of the own id
//! ```
//!
//! d^2 is the squared Mahalanobis distance of detection and prediction, S its covariance, beta the density of targets
//! without a track, so that a detection starts one at the cost 0 (Blackman and Popoli 1999, 6.4). `kappa` is 0 but
//! for a target that the camera's own tracker follows without a gap: it may move beyond the motion model.

use super::camera_offset::CameraOffset;
use super::frame::{CameraFrame, WorldDetection};
use super::settings::WorldTrackSettings;
use super::world_track::{WorldTrack, seconds_from};
use crate::domain::TargetId;
use crate::geo::{EastNorth, PlaneCovariance};

/// Log-likelihood by which the track of a detection's own receiver is preferred to every other: the identity of
/// a receiver is decided before.
const RECEIVER_BONUS: f64 = 1_000.0;
/// Largest gap in which a tracker is taken to follow its target, s.
const FOLLOWED_WITHIN_S: f64 = 1.0;
/// Distance that a box's noise adds to that of a followed target, m.
const FOLLOWED_MARGIN_M: f64 = 1.0;

/// A track at the time of a frame.
pub(super) struct PredictedTrack<'a> {
    track: &'a WorldTrack,
    frame: &'a CameraFrame,
    /// The id that the camera's tracker gave the target last.
    tracker_id: Option<&'a TargetId>,
    /// The decayed offset of the camera, and the share of the covariance of an unknown one that has come to it.
    offset: Option<(CameraOffset, f64)>,
    position: EastNorth,
    covariance_m2: PlaneCovariance,
    /// Distance within which the camera's tracker may follow the target, m; 0 if it does not.
    followed_within_m: f64,
}

impl<'a> PredictedTrack<'a> {
    pub(super) fn new(track: &'a WorldTrack, frame: &'a CameraFrame, settings: &WorldTrackSettings) -> Self {
        let sighting = track.sightings().iter().find(|sighting| sighting.camera == frame.camera);
        let since_s = sighting.map_or(f64::INFINITY, |it| seconds_from(it.last_seen, frame.time));
        let followed_within_m = if since_s <= FOLLOWED_WITHIN_S {
            settings.largest_speed_m_s * since_s.max(0.0) + FOLLOWED_MARGIN_M
        } else {
            0.0
        };
        let (position, covariance_m2) = (track.filter.position(), track.gating_covariance());
        let tracker_id = sighting.and_then(|sighting| sighting.tracker_id.as_ref());
        let offset =
            sighting.map(|sighting| sighting.offset.decayed(since_s, settings.offset_time_constant_s));
        Self { track, frame, tracker_id, offset, position, covariance_m2, followed_within_m }
    }

    /// The offset that a detection is expected to have.
    pub(super) fn offset(&self, detection: &WorldDetection) -> CameraOffset {
        let own_m2 = detection.offset_covariance_m2;
        match self.offset {
            Some((kept, new_share)) => {
                CameraOffset { covariance_m2: kept.covariance_m2.plus(own_m2.scaled(new_share)), ..kept }
            }
            None => CameraOffset::unknown(own_m2, self.track.offset_covariance_m2),
        }
    }

    /// The innovation of a detection that is expected to have that offset, m, and its covariance, m2.
    pub(super) fn innovation(
        &self,
        detection: &WorldDetection,
        offset: &CameraOffset,
        settings: &WorldTrackSettings,
    ) -> (EastNorth, PlaneCovariance) {
        let position = self.track.moved_to_state_time(detection.position, self.frame.time);
        let noise_m2 = settings.measurement_covariance(detection);
        let s = self.covariance_m2.plus(noise_m2).plus(offset.covariance_m2);
        (offset.removed_from(position).minus(self.position), s)
    }

    /// The cost of a detection where targets without a track have that density (1/m2); `None` beyond the gates.
    pub(super) fn cost(
        &self,
        detection: &WorldDetection,
        birth_density_per_m2: f64,
        settings: &WorldTrackSettings,
    ) -> Option<f64> {
        let same_receiver = match (&self.track.receiver, &detection.receiver) {
            (Some(own), Some(other)) if own != other => return None,
            (Some(_), Some(_)) => true,
            // Whose fix it is must be decided from more than one box.
            _ if self.track.is_measured_by_receiver() => return None,
            _ => false,
        };
        let (difference, s) = self.innovation(detection, &self.offset(detection), settings);
        let distance_m2 = difference.east_m.powi(2) + difference.north_m.powi(2);
        // d^2 is at least the squared distance divided by the trace of S.
        let least = distance_m2 / (s.east_m2 + s.north_m2);
        let is_far = least > settings.own_id_gate && distance_m2 > self.followed_within_m.powi(2);
        if is_far && !same_receiver {
            return None;
        }
        let is_own = self.tracker_id.is_some() && self.tracker_id == detection.tracker_id.as_ref();
        let squared = s.mahalanobis_squared(difference);
        let is_followed = is_own && distance_m2 <= self.followed_within_m.powi(2);
        let gate = if is_own { settings.own_id_gate } else { settings.gate };
        if squared > gate && !is_followed && !same_receiver {
            return None;
        }
        let bonus = if is_own { settings.own_id_bonus } else { 0.0 };
        let gaussian = 0.5 * (squared.min(RECEIVER_BONUS) + s.determinant().ln()) - bonus;
        let kappa = if is_followed { settings.followed_density_ratio * birth_density_per_m2 } else { 0.0 };
        let log_density = if kappa > 0.0 { ((-gaussian).exp() + kappa).ln() } else { -gaussian };
        let cost = birth_density_per_m2.ln() - log_density;
        Some(if same_receiver { cost - RECEIVER_BONUS } else { cost })
    }
}
