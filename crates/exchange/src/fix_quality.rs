//! The quality of a fix as receivers state it, as its standard deviation per axis. One mapping for files and messages.
//!
//! The most direct statement wins: standard deviations (GST), then estimated errors in metres (gpsd, Traccar, AIS), then
//! the kind of solution with its dilution of precision (GGA, GPX). A fix without any of them has no standard deviation
//! of its own; then that of its receiver or of its camera counts.

use crate::domain::SigmaM;

/// Standard deviations in the radius that contains 95 % of a circular normal error: sqrt(-2 ln 0.05).
const RADIUS_95: f64 = 2.447_7;
/// The same for 68 %: sqrt(-2 ln 0.32).
const RADIUS_68: f64 = 1.509_6;
/// Standard deviations in half of the interval that contains 95 % of a normal error.
const INTERVAL_95: f64 = 1.960_0;
/// Dilution of precision where a receiver states none: a view of the sky with obstacles.
const UNSTATED_HDOP: f64 = 1.5;
/// How old standard deviations may be that are used for a fix, s.
const LONGEST_AGE_S: f64 = 5.0;
const DAY_S: f64 = 86_400.0;

/// How a receiver found its position: the quality indicator of GGA.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Solution {
    /// Code measurements alone (quality 1).
    Autonomous,
    /// With corrections of a reference station or of satellites (quality 2).
    Differential,
    /// With the precise code (quality 3).
    Precise,
    /// Carrier phases with fixed ambiguities (quality 4).
    RtkFixed,
    /// Carrier phases with real-valued ambiguities (quality 5).
    RtkFloat,
}

impl Solution {
    /// Standard deviation of a measured range (user equivalent range error), m, in the open.
    const fn range_sigma_m(self) -> f64 {
        match self {
            Self::Autonomous => 5.0,
            Self::Differential => 2.0,
            Self::Precise => 3.0,
            Self::RtkFixed => 0.03,
            Self::RtkFloat => 0.5,
        }
    }

    /// Per axis, HDOP times the error of a range over sqrt(2): HDOP is that of both axes together.
    pub(super) fn sigma(self, hdop: Option<f64>) -> Option<SigmaM> {
        let hdop = hdop.filter(|hdop| hdop.is_finite() && *hdop > 0.0).unwrap_or(UNSTATED_HDOP);
        stated(self.range_sigma_m() * hdop / std::f64::consts::SQRT_2)
    }
}

/// The sigma of standard deviations per axis, m.
pub(super) fn sigma_of_deviations(east_m: f64, north_m: f64) -> Option<SigmaM> {
    stated((east_m * east_m + north_m * north_m).sqrt() / std::f64::consts::SQRT_2)
}

/// The sigma of errors per axis that are exceeded in 5 of 100 cases, m.
pub(super) fn sigma_of_intervals_95(east_m: f64, north_m: f64) -> Option<SigmaM> {
    sigma_of_deviations(east_m / INTERVAL_95, north_m / INTERVAL_95)
}

/// The sigma of a radius that contains the target in 95 of 100 cases, m.
pub(super) fn sigma_of_radius_95(radius_m: f64) -> Option<SigmaM> {
    stated(radius_m / RADIUS_95)
}

/// The sigma of a radius that contains the target in 68 of 100 cases, m.
pub(super) fn sigma_of_radius_68(radius_m: f64) -> Option<SigmaM> {
    stated(radius_m / RADIUS_68)
}

/// Radius that contains a circular normal error of this variance per axis, m2, in 68 of 100 cases, m.
pub(super) fn radius_68_m(variance_m2: f64) -> f64 {
    RADIUS_68 * variance_m2.sqrt()
}

/// 0 and what is not a number mean that nothing is known. What no receiver can know is the nearest that is possible.
fn stated(sigma_m: f64) -> Option<SigmaM> {
    let is_known = sigma_m.is_finite() && sigma_m > 0.0;
    is_known.then(|| SigmaM::new(sigma_m.clamp(SigmaM::LEAST_M, SigmaM::LARGEST_M)).ok()).flatten()
}

/// Standard deviations that a receiver states apart from its fixes, commonly after the fix that they belong to. They
/// hold for a fix of the same instant, and for later ones while the kind of solution `K` stays as it was.
#[derive(Debug, Clone)]
pub(super) struct StatedDeviations<K> {
    /// Time of day and kind of the latest fix.
    last_fix: Option<(f64, K)>,
    /// Time of day, kind and value of the latest standard deviations.
    deviations: Option<(f64, Option<K>, SigmaM)>,
}

impl<K> Default for StatedDeviations<K> {
    fn default() -> Self {
        Self { last_fix: None, deviations: None }
    }
}

impl<K: PartialEq + Clone> StatedDeviations<K> {
    /// Takes standard deviations of an instant, by the time of day.
    pub(super) fn state(&mut self, time_of_day_s: f64, sigma: Option<SigmaM>) {
        let fix = self.last_fix.as_ref().filter(|(at_s, _)| *at_s == time_of_day_s);
        let kind = fix.map(|(_, kind)| kind.clone());
        self.deviations = sigma.map(|sigma| (time_of_day_s, kind, sigma));
    }

    /// The standard deviation of a fix of this kind, if one was stated.
    pub(super) fn of_fix(&mut self, time_of_day_s: f64, kind: K) -> Option<SigmaM> {
        let known = self.deviations.as_mut().filter(|(at_s, of_kind, _)| {
            let age_s = (time_of_day_s - at_s).rem_euclid(DAY_S);
            age_s == 0.0 || (age_s <= LONGEST_AGE_S && of_kind.as_ref() == Some(&kind))
        });
        let sigma = known.map(|(at_s, of_kind, sigma)| {
            if *at_s == time_of_day_s {
                *of_kind = Some(kind.clone());
            }
            *sigma
        });
        self.last_fix = Some((time_of_day_s, kind));
        sigma
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metres(sigma: Option<SigmaM>) -> f64 {
        sigma.map_or(f64::NAN, |sigma| (sigma.metres() * 1e3).round() / 1e3)
    }

    #[test]
    fn errors_in_metres_become_standard_deviations_per_axis() {
        assert_eq!(metres(sigma_of_deviations(0.3, 0.4)), 0.354);
        assert_eq!(metres(sigma_of_intervals_95(1.96, 1.96)), 1.0);
        assert_eq!(metres(sigma_of_radius_95(10.0)), 4.085);
        assert_eq!(metres(sigma_of_radius_68(4.0)), 2.65);
        assert_eq!(metres(Solution::Autonomous.sigma(Some(0.9))), 3.182);
        assert_eq!(metres(Solution::RtkFixed.sigma(None)), 0.032);
        for unknown in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(sigma_of_radius_68(unknown), None, "{unknown}");
            assert_eq!(metres(Solution::Autonomous.sigma(Some(unknown))), 5.303, "{unknown}");
        }
        assert_eq!(metres(sigma_of_radius_68(1e-9)), 0.001, "the least that is possible");
        assert_eq!(metres(sigma_of_radius_68(1e300)), 10_000.0, "the largest that is possible");
    }

    #[test]
    fn stated_deviations_hold_while_the_kind_of_solution_does() {
        let sigma = sigma_of_deviations(0.02, 0.02);
        let mut stated = StatedDeviations::default();
        assert_eq!(stated.of_fix(10.0, 4), None, "nothing was stated");
        stated.state(10.0, sigma);
        assert_eq!(stated.of_fix(11.0, 4), sigma, "the fix before was of the same kind");
        assert_eq!(stated.of_fix(12.0, 1), None, "the ambiguities are lost");
        assert_eq!(stated.of_fix(13.0, 4), sigma);
        assert_eq!(stated.of_fix(16.0, 4), None, "too old");
        stated.state(86_399.0, sigma);
        assert_eq!(stated.of_fix(86_399.0, 5), sigma, "of the same instant, whatever came first");
        assert_eq!(stated.of_fix(0.0, 5), sigma, "across midnight");
        assert_eq!(stated.of_fix(86_398.0, 5), None, "before they were stated");
        stated.state(86_399.0, None);
        assert_eq!(stated.of_fix(86_399.0, 5), None, "the receiver knows them no longer");
    }
}
