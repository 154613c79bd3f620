//! Output of a track: the estimated state with the figures of its consistency.

use jiff::Timestamp;

use super::measurement::{MeasurementSource, Rejection};
use crate::domain::{Motion, Velocity};
use crate::geo::EastNorth;
use crate::geo::PlaneCovariance;
use crate::smoother::FilterMoments;

/// The innovation of one accepted measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// The sensor of the measurement.
    pub source: MeasurementSource,
    /// Measured less predicted position, m.
    pub difference: EastNorth,
    /// Normalised innovation squared, `d' S^-1 d`: chi-square with 2 degrees of freedom, mean 2, for
    /// a consistent filter.
    pub nis: f64,
}

/// The estimated state of a target at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackState {
    /// The instant of the estimate.
    pub time: Timestamp,
    /// Estimated position.
    pub position: EastNorth,
    /// Estimated velocity.
    pub velocity: Velocity,
    /// Covariance of the position's error, m2.
    pub covariance: PlaneCovariance,
    /// Covariance of the velocity's error, m2/s2.
    pub velocity_covariance: PlaneCovariance,
    /// Radius about `position` that contains the true position with 95 % probability, m.
    pub r95_m: f64,
    /// What a smoother needs besides.
    pub moments: FilterMoments,
    /// Probability of the stationary motion mode, 0 to 1.
    pub stationary_probability: f64,
    /// Sum of the NIS of the accepted positions of the latest measurement (2 degrees of freedom each).
    pub nis: Option<f64>,
    /// Innovations of the accepted positions, one per sensor.
    pub innovations: Vec<Innovation>,
    /// Rejected positions.
    pub rejected: Vec<Rejection>,
    /// True if this measurement restarted the track: box and fix agree with each other and not with the
    /// track, or after a series of rejections that no bias
    /// explains.
    pub restarted: bool,
    /// True if boxes and fixes have lately differed by more than chance explains. `r95_m` then holds the truth
    /// whichever of them is right, or one of them is not used.
    pub sources_disagree: bool,
}

impl TrackState {
    /// Covariance, m2, of the normal distribution that has the stated 95 % radius.
    #[must_use]
    pub fn normal_covariance(&self) -> PlaneCovariance {
        self.covariance.with_r95_m(self.r95_m)
    }

    /// Speed and course with their intervals.
    #[must_use]
    pub fn motion(&self) -> Motion {
        Motion::of(self.velocity, self.velocity_covariance, self.stationary_probability)
    }
}
