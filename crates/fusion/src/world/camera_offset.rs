//! The offset of a camera's detections of one target from its track: a bias state per camera and track.
//!
//! ```text
//! z = x + b + w          b' = a b + sqrt(1 - a^2) v,   a = exp(-t / tau)
//! ```
//!
//! z is a detection, x the track's position, w the noise of the box. b is what lasts while the target moves some
//! metres: the camera's own error of its map, and the part of the box's error that does not change from frame to
//! frame. A filter that took b for white noise would believe the mean of many frames, and would meet the detections
//! of a second camera with too small a covariance. b and x are updated with one innovation, as if independent of each
//! other before it (Friedland 1969, without the cross-covariance): where one camera alone sees a target, x is
//! the position by that camera, and b stays small.

use nalgebra::Vector2;

use crate::geo::{EastNorth, PlaneCovariance};

/// Mean and covariance of an offset.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct CameraOffset {
    /// m, east and north.
    pub(super) mean: EastNorth,
    pub(super) covariance_m2: PlaneCovariance,
}

impl CameraOffset {
    /// The offset of a camera that has not seen the target: it differs from the track by the errors of both.
    pub(super) fn unknown(own_m2: PlaneCovariance, of_track_m2: PlaneCovariance) -> Self {
        Self { mean: EastNorth::default(), covariance_m2: own_m2.plus(of_track_m2) }
    }

    /// Returns the offset after some seconds, and the share of the covariance of an unknown offset that has come to it.
    pub(super) fn decayed(self, seconds: f64, time_constant_s: f64) -> (Self, f64) {
        let decay = (-seconds.max(0.0) / time_constant_s).exp();
        let kept = decay * decay;
        let mean = EastNorth { east_m: decay * self.mean.east_m, north_m: decay * self.mean.north_m };
        (Self { mean, covariance_m2: self.covariance_m2.scaled(kept) }, 1.0 - kept)
    }

    /// A detection without the offset, m.
    pub(super) fn removed_from(&self, position: EastNorth) -> EastNorth {
        position.minus(self.mean)
    }

    /// The update by an innovation (m) with its covariance (m2), which contains the offset's own.
    pub(super) fn updated(self, innovation: EastNorth, innovation_covariance_m2: PlaneCovariance) -> Self {
        let Some(inverse) = innovation_covariance_m2.matrix_m2().try_inverse() else { return self };
        let covariance = self.covariance_m2.matrix_m2();
        let gain = covariance * inverse;
        let step = gain * Vector2::new(innovation.east_m, innovation.north_m);
        Self {
            mean: self.mean.plus(EastNorth { east_m: step[0], north_m: step[1] }),
            covariance_m2: PlaneCovariance::from(covariance - gain * covariance),
        }
    }

    /// The offset from another track of the same target, which is `apart` (m) from the one it was of; `apart_m2` is the
    /// covariance of that difference.
    pub(super) fn on_other_track(self, apart: EastNorth, apart_m2: PlaneCovariance) -> Self {
        Self { mean: self.mean.plus(apart), covariance_m2: self.covariance_m2.plus(apart_m2) }
    }
}
