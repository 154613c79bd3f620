//! Input of a track: measured positions with their error covariances, and why some are rejected.

use jiff::Timestamp;
use strum::IntoStaticStr;

use crate::geo::EastNorth;
use crate::geo::PlaneCovariance;

/// A measured position in the camera's local plane, with the covariance of its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPosition {
    /// East and north of the plane's origin, m.
    pub position: EastNorth,
    /// Covariance R of the total error, white part and bias together, m2.
    pub covariance: PlaneCovariance,
    /// The white part of the covariance, m2; `None` for the share of the track's settings.
    pub white: Option<PlaneCovariance>,
    /// Factor of the normal distribution that has the stated 95 % radius, at least 1 where the covariance is itself
    /// uncertain. It widens the gate and what the track states, not the weight of the source: the variance that is
    /// expected weighs best, however uncertain it is.
    pub stated_scale: f64,
    /// For how long this source's positions have been the same to the last digit, s.
    pub repeated_s: f64,
    /// True if its stated error rests on nothing of training: a box unlike those, a fix far from the scene.
    pub is_doubtful: bool,
    /// True if its error is as large as the scene, so that it says no more than that a target is in view: it updates no
    /// estimate.
    pub is_vague: bool,
}

impl MeasuredPosition {
    /// A position with `R = variance_m2 * I`: the squared sigma of a fix, or `e_regression_m2`.
    #[must_use]
    pub const fn isotropic(position: EastNorth, variance_m2: f64) -> Self {
        Self {
            position,
            covariance: PlaneCovariance::isotropic(variance_m2),
            white: None,
            stated_scale: 1.0,
            repeated_s: 0.0,
            is_doubtful: false,
            is_vague: false,
        }
    }
}

/// The measurement of one instant: a fix, a regressed position, or both.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Time of measurement, by the camera's clock.
    pub time: Timestamp,
    /// The receiver's fix.
    pub fix: Option<MeasuredPosition>,
    /// The position regressed from the bounding box.
    pub regressed: Option<MeasuredPosition>,
}

/// The sensor that a measured position comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum MeasurementSource {
    /// The bounding box, through the camera's model.
    Regressed,
    /// The GNSS receiver.
    Fix,
}

impl MeasurementSource {
    /// Name in logs, metrics and wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// Why a measured position did not update the track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum RejectionReason {
    /// Its NIS exceeds the chi-square gate.
    OutsideGate,
    /// It is older than the window for out-of-sequence measurements.
    TooLate,
    /// The track already has a measurement of that source and instant.
    Duplicate,
    /// Its covariance is not positive definite, or the error is as large as the camera's scene.
    UnusableVariance,
    /// It is farther than 20 km from the origin of the track's plane.
    OutOfRange,
    /// The target's boxes have been the same to the pixel for longer than a standing target shows.
    Frozen,
    /// Boxes and fixes differ by more than chance explains, and those of this source are not the positions of a moving
    /// target.
    Implausible,
}

impl RejectionReason {
    /// All reasons.
    pub const ALL: [Self; 7] = [
        Self::OutsideGate,
        Self::TooLate,
        Self::Duplicate,
        Self::UnusableVariance,
        Self::OutOfRange,
        Self::Frozen,
        Self::Implausible,
    ];

    /// Name in logs, metrics and wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// A measured position that did not update the track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rejection {
    /// Its sensor.
    pub source: MeasurementSource,
    /// Why it was rejected.
    pub reason: RejectionReason,
    /// Normalised innovation squared, where one was computed.
    pub nis: Option<f64>,
}
