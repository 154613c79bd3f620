//! Covariances in the local east-north plane, and the 95 % radius of a normal distribution.

use nalgebra::Matrix2;

use super::EastNorth;

/// 95 % radius of a bivariate normal distribution divided by its larger principal standard deviation,
/// tabulated by the ratio of the smaller to the larger in steps of 0.1. Solved numerically from the
/// integral over the disc. The function is convex, so linear interpolation never underestimates it.
pub const R95_BY_RATIO: [f64; 11] = [
    1.959_964, 1.962_530, 1.970_409, 1.984_197, 2.005_138, 2.035_859, 2.081_305, 2.145_982, 2.230_288,
    2.331_799, 2.447_747,
];

/// A symmetric 2 x 2 covariance matrix in m2, axes east and north.
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
    /// `variance_m2 * I`.
    #[must_use]
    pub const fn isotropic(variance_m2: f64) -> Self {
        Self { east_m2: variance_m2, north_m2: variance_m2, east_north_m2: 0.0 }
    }

    /// The outer product `d d'` of a vector (east, north) in m: the spread of one mixture component
    /// about the mean of the mixture.
    #[must_use]
    pub const fn outer(east_m: f64, north_m: f64) -> Self {
        Self { east_m2: east_m * east_m, north_m2: north_m * north_m, east_north_m2: east_m * north_m }
    }

    /// True if it is finite and positive definite.
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

    /// Eigenvalues, m2: the variances along the major and the minor axis of the error ellipse.
    #[must_use]
    pub fn principal_m2(self) -> [f64; 2] {
        let mean = self.per_axis_m2();
        // Not `hypot`, which guards against overflow that cannot matter here and takes three times as long.
        let half = 0.5 * (self.east_m2 - self.north_m2);
        let half_difference = (half * half + self.east_north_m2 * self.east_north_m2).sqrt();
        [mean + half_difference, (mean - half_difference).max(0.0)]
    }

    /// Radius in m about the mean that contains 95 % of a normal distribution of this covariance;
    /// never too small, and too large by less than 0.1 %.
    #[must_use]
    pub fn r95_m(self) -> f64 {
        let [major_m2, minor_m2] = self.principal_m2();
        if major_m2 <= 0.0 {
            return 0.0;
        }
        let at = (minor_m2 / major_m2).sqrt() * 10.0;
        let knot = (at as usize).min(9);
        let share = at - knot as f64;
        let factor = R95_BY_RATIO[knot] * (1.0 - share) + R95_BY_RATIO[knot + 1] * share;
        factor * major_m2.sqrt()
    }

    /// True if all elements are finite.
    #[must_use]
    pub fn is_finite(self) -> bool {
        [self.east_m2, self.north_m2, self.east_north_m2].into_iter().all(f64::is_finite)
    }

    /// The covariance of the same shape whose 95 % radius is this one, m.
    #[must_use]
    pub fn with_r95_m(self, r95_m: f64) -> Self {
        self.scaled((r95_m / self.r95_m()).powi(2))
    }

    /// Every element multiplied by a factor.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            east_m2: self.east_m2 * factor,
            north_m2: self.north_m2 * factor,
            east_north_m2: self.east_north_m2 * factor,
        }
    }

    /// The sum: the covariance of the sum of two independent errors.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            east_m2: self.east_m2 + other.east_m2,
            north_m2: self.north_m2 + other.north_m2,
            east_north_m2: self.east_north_m2 + other.east_north_m2,
        }
    }

    /// The difference, for a part of this covariance.
    #[must_use]
    pub fn minus(self, part: Self) -> Self {
        self.plus(part.scaled(-1.0))
    }

    /// The symmetric positive square root in m, elements (east, north, east-north), by
    /// `(P + sqrt(det P) I) / sqrt(tr P + 2 sqrt(det P))`.
    #[must_use]
    pub fn square_root_m(self) -> [f64; 3] {
        let root_determinant = self.determinant().max(0.0).sqrt();
        let squared_scale = self.east_m2 + self.north_m2 + 2.0 * root_determinant;
        if squared_scale <= 0.0 {
            return [0.0; 3];
        }
        let scale = squared_scale.sqrt().recip();
        [
            (self.east_m2 + root_determinant) * scale,
            (self.north_m2 + root_determinant) * scale,
            self.east_north_m2 * scale,
        ]
    }

    /// Squared Mahalanobis distance `d' P^-1 d` of a difference d in m; chi-square with 2 degrees of
    /// freedom if d has this covariance. Infinite if the determinant is not positive.
    #[must_use]
    pub fn mahalanobis_squared(self, difference: EastNorth) -> f64 {
        let EastNorth { east_m, north_m } = difference;
        let determinant = self.determinant();
        if determinant <= 0.0 {
            return f64::INFINITY;
        }
        (self.north_m2 * east_m * east_m - 2.0 * self.east_north_m2 * east_m * north_m
            + self.east_m2 * north_m * north_m)
            / determinant
    }

    /// As a matrix, m2, axes east and north.
    #[must_use]
    pub const fn matrix_m2(self) -> Matrix2<f64> {
        Matrix2::new(self.east_m2, self.east_north_m2, self.east_north_m2, self.north_m2)
    }

    /// Rows of the matrix, m2.
    #[must_use]
    pub const fn rows_m2(self) -> [[f64; 2]; 2] {
        [[self.east_m2, self.east_north_m2], [self.east_north_m2, self.north_m2]]
    }
}

impl From<Matrix2<f64>> for PlaneCovariance {
    /// The symmetric part of a matrix, m2, axes east and north.
    fn from(matrix: Matrix2<f64>) -> Self {
        Self {
            east_m2: matrix[(0, 0)],
            north_m2: matrix[(1, 1)],
            east_north_m2: 0.5 * (matrix[(0, 1)] + matrix[(1, 0)]),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    proptest! {
        #[test]
        fn the_square_root_squared_is_the_matrix(
            east in 0.01..100.0f64, north in 0.01..100.0f64, correlation in -0.99..0.99f64,
        ) {
            let covariance = PlaneCovariance { east_m2: east, north_m2: north,
                east_north_m2: correlation * (east * north).sqrt() };
            let [a, d, b] = covariance.square_root_m();
            prop_assert!((a * a + b * b - east).abs() < 1e-9 * (east + north));
            prop_assert!((d * d + b * b - north).abs() < 1e-9 * (east + north));
            prop_assert!((b * (a + d) - covariance.east_north_m2).abs() < 1e-9 * (east + north));
        }
    }

    #[test]
    fn the_radius_contains_95_percent() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut normal = || random.sample::<f64, _>(StandardNormal);
        for ratio in [0.05, 0.37, 0.73, 1.0] {
            let covariance =
                PlaneCovariance { east_m2: 4.0, north_m2: 4.0 * ratio * ratio, east_north_m2: 0.0 };
            let radius_m = covariance.r95_m();
            let draws = 200_000;
            let inside = (0..draws)
                .filter(|_| {
                    let (east, north) = (normal(), normal());
                    (2.0 * east).hypot(2.0 * ratio * north) <= radius_m
                })
                .count();
            // Four standard deviations of a binomial share.
            let share = inside as f64 / f64::from(draws);
            assert!((share - 0.95).abs() < 0.002, "{ratio}: {share}");
        }
    }

    #[test]
    fn the_radius_is_invariant_under_rotation() {
        let along = PlaneCovariance { east_m2: 9.0, north_m2: 1.0, east_north_m2: 0.0 };
        let across = PlaneCovariance { east_m2: 5.0, north_m2: 5.0, east_north_m2: 4.0 };
        assert!((along.r95_m() - across.r95_m()).abs() < 1e-12);
    }
}
