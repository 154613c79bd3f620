//! The normal distribution in one and two dimensions.

use std::f64::consts::{FRAC_1_SQRT_2, TAU};

use crate::geo::{EastNorth, PlaneCovariance};

/// Positive nodes and weights of the Gauss-Legendre rule of 10 points on -1..1.
const GAUSS_LEGENDRE: [(f64, f64); 5] = [
    (0.148_874_338_981_631_2, 0.295_524_224_714_752_87),
    (0.433_395_394_129_247_2, 0.269_266_719_309_996_35),
    (0.679_409_568_299_024_4, 0.219_086_362_515_982_04),
    (0.865_063_366_688_984_5, 0.149_451_349_150_580_6),
    (0.973_906_528_517_171_7, 0.066_671_344_308_688_14),
];

/// Probability that a standard normal variable is below a value.
pub(crate) fn cumulative(value: f64) -> f64 {
    0.5 * libm::erfc(-value * FRAC_1_SQRT_2)
}

/// Owen's T function, `1/(2 pi) * integral of exp(-h^2 (1 + x^2) / 2) / (1 + x^2)` over x from 0 to a, for
/// `0 <= a <= 1` (Owen 1956).
fn owen_t(h: f64, a: f64) -> f64 {
    let half = 0.5 * a;
    let density = |x: f64| (-0.5 * h * h * (1.0 + x * x)).exp() / (1.0 + x * x);
    let sum = GAUSS_LEGENDRE
        .iter()
        .map(|(node, weight)| weight * (density(half * (1.0 + node)) + density(half * (1.0 - node))))
        .sum::<f64>();
    half * sum / TAU
}

/// Probability content of the right-angled triangle between the mean of a standard normal distribution in the plane, the
/// foot of a line at distance `height > 0`, and the point of the line at `along` from the foot; negative for `along < 0`.
fn triangle(height: f64, along: f64) -> f64 {
    let reach = along.abs();
    let t = if reach <= height {
        owen_t(height, reach / height)
    } else {
        let (below_height, below_reach) = (cumulative(height), cumulative(reach));
        0.5 * (below_height + below_reach) - below_height * below_reach - owen_t(reach, height / reach)
    };
    (reach.atan2(height) / TAU - t).copysign(along)
}

/// A transformation after which a normal distribution in the plane has its mean at 0 and the identity as covariance.
pub(crate) struct Whitening {
    mean: EastNorth,
    east: f64,
    slope: f64,
    north: f64,
}

impl Whitening {
    /// Of a mean, m, and a covariance, m2; `None` if that is not positive definite.
    pub(crate) fn of(mean: EastNorth, covariance: PlaneCovariance) -> Option<Self> {
        if !covariance.is_positive() {
            return None;
        }
        let PlaneCovariance { east_m2, north_m2, east_north_m2 } = covariance;
        let slope = east_north_m2 / east_m2;
        let rest_m2 = north_m2 - slope * east_north_m2;
        (rest_m2 > 0.0).then(|| Self {
            mean,
            east: east_m2.sqrt().recip(),
            slope,
            north: rest_m2.sqrt().recip(),
        })
    }

    fn apply(&self, point: EastNorth) -> [f64; 2] {
        let EastNorth { east_m, north_m } = point.minus(self.mean);
        [east_m * self.east, (north_m - self.slope * east_m) * self.north]
    }

    /// Probability content of the polygon with these corners, m; negative if they go clockwise. The first corner follows
    /// the last one.
    pub(crate) fn signed_probability(&self, ring: &[EastNorth]) -> f64 {
        let Some(last) = ring.last() else { return 0.0 };
        let mut from = self.apply(*last);
        ring.iter()
            .map(|corner| {
                let to = self.apply(*corner);
                signed_triangle(std::mem::replace(&mut from, to), to)
            })
            .sum()
    }
}

/// Probability content of the triangle between the mean of a standard normal distribution and an edge; negative if the
/// mean is on the right of the edge.
fn signed_triangle(from: [f64; 2], to: [f64; 2]) -> f64 {
    let edge = [to[0] - from[0], to[1] - from[1]];
    let length = edge[0].hypot(edge[1]);
    if length <= 0.0 {
        return 0.0;
    }
    let height = (from[0] * to[1] - from[1] * to[0]) / length;
    if height.abs() < 1e-12 {
        return 0.0;
    }
    let along = |point: [f64; 2]| (point[0] * edge[0] + point[1] * edge[1]) / length;
    (triangle(height.abs(), along(to)) - triangle(height.abs(), along(from))) * height.signum()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    fn at(east_m: f64, north_m: f64) -> EastNorth {
        EastNorth { east_m, north_m }
    }

    #[test]
    fn a_half_plane_has_the_probability_of_one_dimension() {
        for distance_m in [-3.0, -0.4, 0.0, 0.7, 2.5] {
            let covariance = PlaneCovariance { east_m2: 4.0, north_m2: 9.0, east_north_m2: 2.0 };
            let whitening = Whitening::of(at(distance_m, 0.0), covariance).expect("positive");
            let ring = [at(0.0, -1e4), at(1e4, -1e4), at(1e4, 1e4), at(0.0, 1e4)];
            let difference = whitening.signed_probability(&ring) - cumulative(distance_m / 2.0);
            assert!(difference.abs() < 1e-9, "{distance_m}: {difference}");
        }
    }

    #[test]
    fn a_polygon_holds_the_share_of_draws_within() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let ring = [at(-1.0, -0.5), at(2.0, -1.0), at(0.2, 0.1), at(1.5, 2.0), at(-0.7, 1.0)];
        let covariance = PlaneCovariance { east_m2: 1.0, north_m2: 0.49, east_north_m2: 0.3 };
        let mean = at(0.3, 0.2);
        let draws = 200_000;
        let rings = [ring.to_vec()];
        let inside = (0..draws).filter(|_| {
            let (first, second): (f64, f64) = (random.sample(StandardNormal), random.sample(StandardNormal));
            let point = at(first, 0.3 * first + (0.49f64 - 0.09).sqrt() * second).plus(mean);
            crate::geo::is_inside(&rings, point)
        });
        let share = inside.count() as f64 / f64::from(draws);
        let probability = Whitening::of(mean, covariance).expect("positive").signed_probability(&ring);
        // Four standard deviations of a binomial share.
        assert!((share - probability).abs() < 0.0045, "{share} {probability}");
    }
}
