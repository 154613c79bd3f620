//! Second moments in the east-north plane, and the radius they promise.
//!
//! What never happens here: degrees, time, anything beyond two axes.

use crate::geo::EastNorth;

/// 95 % radius of a normal distribution over its larger standard deviation, by the ratio of the
/// smaller to the larger in steps of a tenth. Solved numerically from the integral over the disc;
/// the function is convex, so straight lines between the knots lie above it and never below.
const R95_BY_RATIO: [f64; 11] = [
    1.959_964, 1.962_530, 1.970_409, 1.984_197, 2.005_138, 2.035_859, 2.081_305, 2.145_982, 2.230_288,
    2.331_799, 2.447_747,
];

/// A symmetric matrix of second moments in m2, axes east and north.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlaneCovariance {
    /// Variance along east, m2.
    pub east_m2: f64,
    /// Variance along north, m2.
    pub north_m2: f64,
    /// Covariance of east and north, m2.
    pub east_north_m2: f64,
}

impl PlaneCovariance {
    /// The same variance along every direction.
    #[must_use]
    pub const fn isotropic(variance_m2: f64) -> Self {
        Self { east_m2: variance_m2, north_m2: variance_m2, east_north_m2: 0.0 }
    }

    /// Whether it is finite and positive in every direction.
    #[must_use]
    pub fn is_positive(self) -> bool {
        let determinant = self.determinant();
        self.east_m2 > 0.0 && self.north_m2 > 0.0 && determinant > 0.0 && determinant.is_finite()
    }

    /// Determinant in m4.
    #[must_use]
    pub fn determinant(self) -> f64 {
        self.east_m2 * self.north_m2 - self.east_north_m2 * self.east_north_m2
    }

    /// Mean variance over the two axes, m2.
    #[must_use]
    pub fn per_axis_m2(self) -> f64 {
        0.5 * (self.east_m2 + self.north_m2)
    }

    /// Variances along the longest and the shortest axis of the ellipse, m2.
    #[must_use]
    pub fn principal_m2(self) -> [f64; 2] {
        let middle = self.per_axis_m2();
        let half_span = (0.5 * (self.east_m2 - self.north_m2)).hypot(self.east_north_m2);
        [middle + half_span, (middle - half_span).max(0.0)]
    }

    /// Radius in m that holds 95 % of a normal distribution of these moments about its mean;
    /// never too small, too large by less than 0.1 %.
    #[must_use]
    pub fn r95_m(self) -> f64 {
        let [longest_m2, shortest_m2] = self.principal_m2();
        if longest_m2 <= 0.0 {
            return 0.0;
        }
        let at = (shortest_m2 / longest_m2).sqrt() * 10.0;
        let knot = (at as usize).min(9);
        let share = at - knot as f64;
        let factor = R95_BY_RATIO[knot] * (1.0 - share) + R95_BY_RATIO[knot + 1] * share;
        factor * longest_m2.sqrt()
    }

    /// Every moment times a factor.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            east_m2: self.east_m2 * factor,
            north_m2: self.north_m2 * factor,
            east_north_m2: self.east_north_m2 * factor,
        }
    }

    /// The moments of the sum of two independent errors.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            east_m2: self.east_m2 + other.east_m2,
            north_m2: self.north_m2 + other.north_m2,
            east_north_m2: self.east_north_m2 + other.east_north_m2,
        }
    }

    /// The symmetric root: a matrix in m whose square this is, as (east, north, east-north).
    #[must_use]
    pub fn root_m(self) -> [f64; 3] {
        let side = self.determinant().max(0.0).sqrt();
        let trace = self.east_m2 + self.north_m2 + 2.0 * side;
        if trace <= 0.0 {
            return [0.0; 3];
        }
        let scale = trace.sqrt().recip();
        [(self.east_m2 + side) * scale, (self.north_m2 + side) * scale, self.east_north_m2 * scale]
    }

    /// Squared Mahalanobis length of a difference; chi-square of 2 degrees when the difference is
    /// drawn from these moments. Infinite for moments that are not positive.
    #[must_use]
    pub fn squared_length(self, difference: EastNorth) -> f64 {
        let EastNorth { east_m, north_m } = difference;
        let determinant = self.determinant();
        if determinant <= 0.0 {
            return f64::INFINITY;
        }
        (self.north_m2 * east_m * east_m - 2.0 * self.east_north_m2 * east_m * north_m
            + self.east_m2 * north_m * north_m)
            / determinant
    }

    /// Rows of the matrix, m2.
    #[must_use]
    pub const fn rows_m2(self) -> [[f64; 2]; 2] {
        [[self.east_m2, self.east_north_m2], [self.east_north_m2, self.north_m2]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    proptest! {
        #[test]
        fn the_root_squared_is_the_matrix(east in 0.01..100.0f64, north in 0.01..100.0f64, turn in -0.99..0.99f64) {
            let moments = PlaneCovariance { east_m2: east, north_m2: north,
                east_north_m2: turn * (east * north).sqrt() };
            let [a, d, b] = moments.root_m();
            prop_assert!((a * a + b * b - east).abs() < 1e-9 * (east + north));
            prop_assert!((d * d + b * b - north).abs() < 1e-9 * (east + north));
            prop_assert!((b * (a + d) - moments.east_north_m2).abs() < 1e-9 * (east + north));
        }
    }

    #[test]
    fn the_radius_holds_95_percent() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for ratio in [0.05, 0.37, 0.73, 1.0] {
            let moments = PlaneCovariance { east_m2: 4.0, north_m2: 4.0 * ratio * ratio, east_north_m2: 0.0 };
            let radius_m = moments.r95_m();
            let draws = 200_000;
            let inside = (0..draws)
                .filter(|_| {
                    let (east, north) = normal_pair(random.random(), random.random());
                    (2.0 * east).hypot(2.0 * ratio * north) <= radius_m
                })
                .count();
            // Four standard deviations of a binomial share.
            let share = inside as f64 / f64::from(draws);
            assert!((share - 0.95).abs() < 0.002, "{ratio}: {share}");
        }
    }

    #[test]
    fn the_radius_does_not_turn_with_the_axes() {
        let along = PlaneCovariance { east_m2: 9.0, north_m2: 1.0, east_north_m2: 0.0 };
        let across = PlaneCovariance { east_m2: 5.0, north_m2: 5.0, east_north_m2: 4.0 };
        assert!((along.r95_m() - across.r95_m()).abs() < 1e-12);
    }

    fn normal_pair(first: f64, second: f64) -> (f64, f64) {
        let length = (-2.0 * (1.0 - first).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * second).sin_cos();
        (length * cos, length * sin)
    }
}
