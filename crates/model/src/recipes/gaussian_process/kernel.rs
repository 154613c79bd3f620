//! The residual's kernel and its inducing points.
//!
//! Matern 5/2 (Rasmussen and Williams 2006, equation 4.17) on standardised foot u, foot v, log width and
//! log height, with one length scale for place and one for size. The residual is represented by inducing
//! points (Titsias 2009; deterministic training conditional): phi(x) = L^-1 k(x) with K_zz = L L^T, so
//! that the prior of the weights on phi is standard normal.

use nalgebra::DMatrix;

use super::projective_mean::{Box4, moments};

/// A kernel's jitter, as a share of its variance.
const JITTER: f64 = 1e-6;
const LLOYD_ROUNDS: usize = 12;
pub(crate) const SQRT_5: f64 = 2.236_067_977_499_79;

/// Standardisation of (foot u, foot v, log width, log height).
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct InputScales(pub(crate) [[f64; 2]; 4]);

impl InputScales {
    pub(crate) fn of_rows(boxes: &[Box4]) -> Self {
        Self(std::array::from_fn(|side| {
            let (mean, sigma) = moments(boxes.iter().map(|sides| raw_input(sides)[side]));
            // A side that hardly varies must not turn noise into distance.
            [mean, sigma.max(if side < 2 { 5.0 } else { 0.05 })]
        }))
    }

    #[inline]
    pub(crate) fn input(&self, sides: &Box4) -> [f64; 4] {
        let raw = raw_input(sides);
        std::array::from_fn(|side| (raw[side] - self.0[side][0]) / self.0[side][1])
    }

    /// Derivative of each input by its own pixel.
    #[inline]
    pub(crate) fn slopes(&self, sides: &Box4) -> [f64; 4] {
        [
            1.0 / self.0[0][1],
            1.0 / self.0[1][1],
            1.0 / (self.0[2][1] * sides[2].max(1.0)),
            1.0 / (self.0[3][1] * sides[3].max(1.0)),
        ]
    }
}

#[inline]
fn raw_input(sides: &Box4) -> [f64; 4] {
    [sides[0], sides[1], sides[2].max(1.0).ln(), sides[3].max(1.0).ln()]
}

/// Length scales, in standardised units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LengthScales {
    pub(crate) place: f64,
    pub(crate) size: f64,
}

impl LengthScales {
    #[inline]
    fn distance(&self, one: &[f64; 4], other: &[f64; 4]) -> f64 {
        let place = (one[0] - other[0]).powi(2) + (one[1] - other[1]).powi(2);
        let size = (one[2] - other[2]).powi(2) + (one[3] - other[3]).powi(2);
        (place / (self.place * self.place) + size / (self.size * self.size)).sqrt()
    }

    /// Correlation, and its derivative by half the squared scaled distance.
    #[inline]
    pub(crate) fn matern(&self, one: &[f64; 4], other: &[f64; 4]) -> (f64, f64) {
        let s = SQRT_5 * self.distance(one, other);
        let decay = (-s).exp();
        ((1.0 + s + s * s / 3.0) * decay, -(5.0 / 3.0) * (1.0 + s) * decay)
    }

    /// K_xz of unit variance.
    pub(crate) fn cross(&self, inputs: &[[f64; 4]], inducing: &[[f64; 4]]) -> DMatrix<f64> {
        DMatrix::from_fn(inputs.len(), inducing.len(), |row, column| {
            self.matern(&inputs[row], &inducing[column]).0
        })
    }

    /// L^-1 of unit variance; `None` only for numbers that are not finite.
    pub(crate) fn inverse_factor(&self, inducing: &[[f64; 4]]) -> Option<DMatrix<f64>> {
        let mut prior = self.cross(inducing, inducing);
        for at in 0..inducing.len() {
            prior[(at, at)] += JITTER;
        }
        let factor = prior.cholesky()?.unpack();
        let mut inverse = DMatrix::identity(inducing.len(), inducing.len());
        factor.solve_lower_triangular_mut(&mut inverse).then_some(inverse)
    }
}

/// Centres of the inputs by Lloyd's algorithm from evenly spaced rows: the same for the same rows.
pub(crate) fn inducing_points(inputs: &[[f64; 4]], count: usize) -> Vec<[f64; 4]> {
    let count = count.clamp(1, inputs.len());
    let mut centres: Vec<[f64; 4]> = (0..count).map(|at| inputs[at * inputs.len() / count]).collect();
    for _ in 0..LLOYD_ROUNDS {
        let mut sums = vec![([0.0; 4], 0.0); count];
        for input in inputs {
            let (sum, members) = &mut sums[nearest(&centres, input)];
            *members += 1.0;
            for (sum, value) in sum.iter_mut().zip(input) {
                *sum += value;
            }
        }
        for (centre, (sum, members)) in centres.iter_mut().zip(&sums) {
            if *members > 0.0 {
                *centre = sum.map(|sum| sum / members);
            }
        }
    }
    centres
}

/// Index of the centre nearest to an input.
pub(crate) fn nearest<const N: usize>(centres: &[[f64; N]], input: &[f64; N]) -> usize {
    let square =
        |centre: &[f64; N]| centre.iter().zip(input).map(|(one, other)| (one - other).powi(2)).sum::<f64>();
    let mut best = (f64::INFINITY, 0);
    for (at, centre) in centres.iter().enumerate() {
        let square = square(centre);
        if square < best.0 {
            best = (square, at);
        }
    }
    best.1
}
