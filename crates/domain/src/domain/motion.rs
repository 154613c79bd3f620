//! Speed and course of a target with 95 % intervals, from the estimate of its velocity.

use std::f64::consts::{PI, TAU};

use crate::geo::{EastNorth, PlaneCovariance};
use crate::statistics::{CHI_SQUARE_95, NORMAL_95};

/// A velocity in a local plane.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Velocity {
    /// Component towards east, m/s.
    pub east_m_s: f64,
    /// Component towards north, m/s.
    pub north_m_s: f64,
}

impl Velocity {
    /// Magnitude, m/s.
    #[must_use]
    pub fn speed_m_s(self) -> f64 {
        self.east_m_s.hypot(self.north_m_s)
    }

    /// Probability that the target is stationary, 0 to 1: one of two for equal prior odds of a velocity of 0 and of one
    /// with `prior_sigma_m_s` per axis. The odds change by the Savage-Dickey ratio, the posterior density of the moving
    /// target's velocity at 0 over the prior one (Dickey 1971). `covariance` is that of the velocity's error, m2/s2.
    #[must_use]
    pub fn stationary_probability(self, covariance: PlaneCovariance, prior_sigma_m_s: f64) -> f64 {
        let from_zero = EastNorth { east_m: self.east_m_s, north_m: self.north_m_s };
        let peak_ratio = prior_sigma_m_s * prior_sigma_m_s / covariance.determinant().sqrt();
        let odds = peak_ratio * (-0.5 * covariance.mahalanobis_squared(from_zero)).exp();
        if odds.is_finite() { odds / (1.0 + odds) } else { 1.0 }
    }
}

/// A mean acceleration in a local plane.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Acceleration {
    /// Component towards east, m/s2.
    pub east_m_s2: f64,
    /// Component towards north, m/s2.
    pub north_m_s2: f64,
    /// Covariance of its error, m2/s4.
    pub covariance: PlaneCovariance,
}

/// Speed and course of a target at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Magnitude of the velocity, m/s.
    pub speed_mps: f64,
    /// Bounds that hold the true speed with 95 % probability, m/s; the lower one is at least 0.
    pub speed_interval_mps: [f64; 2],
    /// Direction of the velocity; `None` where the speed may be 0 or nothing is known of the direction.
    pub course: Option<Course>,
    /// Probability that the target is stationary, 0 to 1.
    pub stationary_probability: f64,
}

/// Direction of a motion over ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Course {
    /// Clockwise from north, 0 to 360 degrees.
    pub deg: f64,
    /// Bounds that hold the true course with 95 % probability, 0 to 360 degrees, clockwise from the first to the
    /// second: `[350, 10]` is 20 degrees wide.
    pub interval_deg: [f64; 2],
}

impl Motion {
    /// Returns the motion of a velocity whose error has that covariance, m2/s2.
    ///
    /// The error along the velocity is one of speed, that across it one of course. Near 0 the error across is one of
    /// speed too: the upper bound is that of the distance to the origin, exact for an isotropic covariance at speed 0.
    #[must_use]
    pub fn of(velocity: Velocity, covariance: PlaneCovariance, stationary_probability: f64) -> Self {
        let speed_mps = velocity.speed_m_s();
        let angle = velocity.east_m_s.atan2(velocity.north_m_s);
        let (east, north) = angle.sin_cos();
        let [along_m2_s2, across_m2_s2] =
            [(east, north), (north, -east)].map(|direction| variance_along(covariance, direction));
        let half_mps = NORMAL_95 * along_m2_s2.sqrt();
        let low_mps = (speed_mps - half_mps).max(0.0);
        let squared_across = (CHI_SQUARE_95 - NORMAL_95 * NORMAL_95) * across_m2_s2;
        let high_mps = ((speed_mps + half_mps).powi(2) + squared_across).sqrt();
        let half_angle = NORMAL_95 * across_m2_s2.sqrt() / speed_mps;
        Self {
            speed_mps,
            speed_interval_mps: [low_mps, high_mps],
            course: (low_mps > 0.0 && half_angle < PI).then(|| Course::of(angle, half_angle)),
            stationary_probability,
        }
    }
}

impl Course {
    /// From an angle clockwise from north and half the width of its interval, rad.
    fn of(angle: f64, half_width: f64) -> Self {
        let degrees = |angle: f64| angle.rem_euclid(TAU).to_degrees();
        Self { deg: degrees(angle), interval_deg: [degrees(angle - half_width), degrees(angle + half_width)] }
    }
}

/// Variance along a unit vector (east, north).
fn variance_along(covariance: PlaneCovariance, (east, north): (f64, f64)) -> f64 {
    let PlaneCovariance { east_m2, north_m2, east_north_m2 } = covariance;
    let variance = east * east * east_m2 + north * north * north_m2 + 2.0 * east * north * east_north_m2;
    variance.max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moving(east_m_s: f64, north_m_s: f64, covariance: PlaneCovariance) -> Motion {
        Motion::of(Velocity { east_m_s, north_m_s }, covariance, 0.0)
    }

    #[test]
    fn errors_along_are_of_speed_and_errors_across_of_course() {
        let along = PlaneCovariance { east_m2: 0.04, north_m2: 0.0, east_north_m2: 0.0 };
        let motion = moving(10.0, 0.0, along);
        let [low, high] = motion.speed_interval_mps;
        assert!((low - 9.608).abs() < 1e-3 && (high - 10.392).abs() < 1e-3, "{motion:?}");
        let course = motion.course.expect("it moves");
        assert!((course.deg - 90.0).abs() < 1e-9);
        assert!((course.interval_deg[1] - course.interval_deg[0]).abs() < 1e-9, "{course:?}");
        let across = PlaneCovariance { east_m2: 0.0, north_m2: 0.04, east_north_m2: 0.0 };
        let motion = moving(10.0, 0.0, across);
        assert!(motion.speed_interval_mps[1] - motion.speed_interval_mps[0] < 0.01, "{motion:?}");
        let course = motion.course.expect("it moves");
        assert!((course.interval_deg[1] - course.deg - 2.246).abs() < 1e-3, "{course:?}");
    }

    #[test]
    fn an_interval_of_course_goes_through_north_clockwise() {
        let course = moving(0.0, 10.0, PlaneCovariance::isotropic(0.04)).course.expect("it moves");
        let [from, to] = course.interval_deg;
        assert!(course.deg == 0.0 && from > 357.0 && to < 3.0, "{course:?}");
    }

    #[test]
    fn a_small_velocity_is_evidence_of_a_stationary_target_and_a_large_one_against_it() {
        let covariance = PlaneCovariance::isotropic(0.04);
        let of =
            |east_m_s: f64| Velocity { east_m_s, north_m_s: 0.0 }.stationary_probability(covariance, 1.5);
        // The prior density at 0 is 1.5^2 / 0.04 times the posterior one of a target at rest.
        assert!((of(0.0) - 56.25 / 57.25).abs() < 1e-9);
        assert!(of(1.3) < 1e-6);
        let unknown = Velocity::default().stationary_probability(PlaneCovariance::isotropic(2.25), 1.5);
        assert!((unknown - 0.5).abs() < 1e-9, "nothing was measured");
    }

    #[test]
    fn a_target_that_may_stand_has_no_course() {
        for speed_m_s in [0.0, 0.3] {
            let motion = moving(speed_m_s, 0.0, PlaneCovariance::isotropic(0.04));
            assert_eq!((motion.speed_interval_mps[0], motion.course), (0.0, None));
        }
        let standing = moving(0.0, 0.0, PlaneCovariance::isotropic(1.0));
        assert!((standing.speed_interval_mps[1] - 2.447_747).abs() < 1e-3, "{standing:?}");
    }
}
