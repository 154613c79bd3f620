//! Settings of the world tracker.

use super::frame::WorldDetection;
use crate::geo::PlaneCovariance;

/// Added to the noise of every detection (1 cm per axis), so that one without any has an innovation covariance that can be
/// inverted.
const LEAST_NOISE: PlaneCovariance = PlaneCovariance::isotropic(1e-4);

/// Noise, gates and bounds of a world tracker.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldTrackSettings {
    /// Spectral density of the white acceleration noise of the two motion modes, m2/s3: steady and
    /// manoeuvring.
    pub acceleration_noise_m2_s3: [f64; 2],
    /// Mean time in one motion mode, s.
    pub mode_sojourn_s: f64,
    /// Standard deviation per axis of the velocity of a new track, m/s.
    pub birth_speed_sigma_m_s: f64,
    /// Factor on the covariance of a detection's noise: it is not independent from frame to frame, so a filter that
    /// takes it for white must take it for larger.
    pub correlated_noise_inflation: f64,
    /// Time constant of a camera's offset from a track, s: that in which a target moves on to places where the map
    /// has another error.
    pub offset_time_constant_s: f64,
    /// Largest squared Mahalanobis distance of a detection to a track.
    pub gate: f64,
    /// The same where the detection has the tracker id that the track last had in that camera.
    pub own_id_gate: f64,
    /// Log-likelihood by which such a detection is preferred to any other.
    pub own_id_bonus: f64,
    /// Speed up to which a target may move between two frames if the camera's tracker follows it without a gap,
    /// whatever the motion model says, m/s.
    pub largest_speed_m_s: f64,
    /// Density of the detections of such a target anywhere within that distance, relative to that of new targets:
    /// well above 1, so that it goes on rather than starts again.
    pub followed_density_ratio: f64,
    /// Least and greatest density of detections that belong to no track (new targets and false detections), 1/m2. A
    /// detection starts a track rather than join one where that is less likely.
    pub birth_density_per_m2: [f64; 2],
    /// Between these, new targets are expected in one of that many areas `sqrt |R|` of a detection's error: where
    /// positions are less certain, a near track is rather the same target.
    pub areas_per_birth: f64,
    /// Detections after which a track is confirmed.
    pub confirming_detections: u32,
    /// Common frames after which two tracks of one target are merged.
    pub merging_frames: u32,
    /// Time without a measurement after which a confirmed track ends, s.
    pub coast_s: f64,
    /// The same of an unconfirmed track, s.
    pub unconfirmed_coast_s: f64,
    /// Correlation time of a receiver's error, s: without a camera, the mean of its fixes over less than this is
    /// as wrong as one of them.
    pub receiver_time_constant_s: f64,
    /// White share of a receiver's error variance.
    pub receiver_white_share: f64,
    /// A frame older than the tracker's time by more than this is refused, s.
    pub max_late_s: f64,
    /// Most tracks at a time; further targets start none.
    pub max_tracks: usize,
    /// Most detections of one frame; the rest is not processed.
    pub max_detections: usize,
}

impl WorldTrackSettings {
    /// The covariance of a detection's noise for the filter, m2.
    pub(super) fn measurement_covariance(&self, detection: &WorldDetection) -> PlaneCovariance {
        detection.covariance_m2.scaled(self.correlated_noise_inflation).plus(LEAST_NOISE)
    }

    /// Density of targets without a track where a detection is, 1/m2.
    pub(super) fn birth_density_per_m2(&self, detection: &WorldDetection) -> f64 {
        let whole = self.measurement_covariance(detection).plus(detection.offset_covariance_m2);
        let [least, greatest] = self.birth_density_per_m2;
        (self.areas_per_birth * whole.determinant().sqrt()).recip().clamp(least, greatest)
    }
}

impl Default for WorldTrackSettings {
    /// People and slow vehicles, detectors of 2 to 25 frames a second.
    fn default() -> Self {
        Self {
            acceleration_noise_m2_s3: [0.1, 2.5],
            mode_sojourn_s: 5.0,
            birth_speed_sigma_m_s: 1.5,
            correlated_noise_inflation: 1.8,
            offset_time_constant_s: 10.0,
            gate: 16.0,
            own_id_gate: 28.8,
            own_id_bonus: 5.0,
            largest_speed_m_s: 8.0,
            followed_density_ratio: 5.0,
            birth_density_per_m2: [0.02, 0.3],
            areas_per_birth: 10.0,
            confirming_detections: 2,
            merging_frames: 4,
            coast_s: 2.0,
            unconfirmed_coast_s: 1.0,
            receiver_time_constant_s: 30.0,
            receiver_white_share: 0.1,
            max_late_s: 1.0,
            max_tracks: 2_000,
            max_detections: 500,
        }
    }
}
