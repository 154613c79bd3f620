//! The decoder of the recipe `projective`: from a position to the box's features.
//!
//! With the position `(e, n)` in units about the centre, feature `i` is
//! `(d[i][0] + d[i][1] e + d[i][2] n) / (1 + g[0] e + g[1] n)`: the image of a point of the ground plane,
//! or of a point at constant height above it, under a projective camera.

use nalgebra::{DMatrix, DVector};

use super::features::FEATURE_COUNT;
use crate::artifact::tensors::Tensors;
use crate::domain::Result;

/// Three coefficients per feature and two of the common denominator.
pub(crate) const COEFFICIENTS: usize = 3 * FEATURE_COUNT + 2;
/// Lower bound of the denominator.
pub(crate) const LEAST_DENOMINATOR: f64 = 0.02;
/// Rounds of reweighting.
const ROUNDS: usize = 6;
/// Residual, in standard deviations of a feature, at which a box has half the weight (Cauchy weights).
const RESIDUAL_SCALE: f64 = 0.3;

/// Coefficients in the order `d`, `g`.
#[derive(Debug, Clone)]
pub(crate) struct InverseCamera(pub(crate) [f64; COEFFICIENTS]);

impl InverseCamera {
    /// Fits pairs of position (units) and standardised features by iteratively reweighted linear least
    /// squares.
    pub(crate) fn fit(pairs: &[([f64; 2], [f32; FEATURE_COUNT])]) -> Self {
        let mut camera = Self([0.0; COEFFICIENTS]);
        for round in 0..ROUNDS {
            let (normal, mut right) = camera.normal_equations(pairs, round > 0);
            let Some(factor) = normal.cholesky() else { break };
            factor.solve_mut(&mut right);
            camera.0.copy_from_slice(right.as_slice());
        }
        camera
    }

    /// Normal equations of the features multiplied by the denominator, with weights by the present
    /// coefficients.
    fn normal_equations(
        &self,
        pairs: &[([f64; 2], [f32; FEATURE_COUNT])],
        reweighted: bool,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let ridge = 1e-6 * pairs.len() as f64;
        let mut normal = DMatrix::<f64>::identity(COEFFICIENTS, COEFFICIENTS) * ridge;
        let mut right = DVector::<f64>::zeros(COEFFICIENTS);
        for ([east, north], features) in pairs {
            let denominator = self.denominator(*east, *north);
            let predicted = self.features_at([*east, *north]);
            for (feature, value) in features.iter().enumerate() {
                let value = f64::from(*value);
                let residual = if reweighted { (value - predicted[feature]) / RESIDUAL_SCALE } else { 0.0 };
                let weight = 1.0 / (denominator * denominator * (1.0 + residual * residual));
                let mut equation = [0.0; COEFFICIENTS];
                equation[3 * feature..3 * feature + 3].copy_from_slice(&[1.0, *east, *north]);
                equation[COEFFICIENTS - 2..].copy_from_slice(&[-value * east, -value * north]);
                for row in 0..COEFFICIENTS {
                    if equation[row] == 0.0 {
                        continue;
                    }
                    right[row] += weight * equation[row] * value;
                    for column in 0..COEFFICIENTS {
                        normal[(row, column)] += weight * equation[row] * equation[column];
                    }
                }
            }
        }
        (normal, right)
    }

    #[inline]
    fn denominator(&self, east: f64, north: f64) -> f64 {
        (1.0 + self.0[COEFFICIENTS - 2] * east + self.0[COEFFICIENTS - 1] * north).max(LEAST_DENOMINATOR)
    }

    /// The standardised features of the box at a position in units.
    #[inline]
    pub(crate) fn features_at(&self, [east, north]: [f64; 2]) -> [f64; FEATURE_COUNT] {
        let denominator = self.denominator(east, north);
        std::array::from_fn(|feature| {
            let [constant, of_east, of_north] =
                [self.0[3 * feature], self.0[3 * feature + 1], self.0[3 * feature + 2]];
            (constant + of_east * east + of_north * north) / denominator
        })
    }

    pub(crate) fn put(&self, tensors: &mut Tensors) {
        tensors.put_f64("reverse", &[COEFFICIENTS], self.0.to_vec());
    }

    /// # Errors
    /// Names the tensor if it is missing or has another shape.
    pub(crate) fn take(tensors: &mut Tensors) -> Result<Self> {
        let coefficients = tensors.take_f64("reverse", &[COEFFICIENTS])?;
        Ok(Self(std::array::from_fn(|at| coefficients[at])))
    }
}
