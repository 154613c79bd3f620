//! One camera's map of the ground: the homography of the foot point, its inverse and its derivatives.

use nalgebra::{Matrix2, Vector2};

use crate::geo::EastNorth;
use crate::recipes::gaussian_process::projective_mean::{Box4, FOOT_COEFFICIENTS, ProjectiveMean};

/// Parameters of one map.
pub(super) const PARAMETERS: usize = FOOT_COEFFICIENTS;
/// Denominators below this are beyond the horizon.
const LEAST_DENOMINATOR: f64 = 0.02;

/// Derivatives of a position at a foot point.
pub(super) struct GroundTangent {
    pub(super) position: Vector2<f64>,
    /// By the parameters, m, a row per axis.
    pub(super) by_parameters: [[f64; PARAMETERS]; 2],
    /// By foot u and v, m/px.
    pub(super) by_foot: Matrix2<f64>,
}

/// The homography of the foot point.
#[derive(Debug, Clone)]
pub(super) struct GroundMap(pub(super) ProjectiveMean);

impl GroundMap {
    /// A robust fit to positions with independent errors, m.
    pub(super) fn start(boxes: &[Box4], positions: &[[f64; 2]]) -> Self {
        let mut mean = ProjectiveMean::of_rows(boxes, positions);
        mean.fit_foot(boxes, positions);
        Self(mean)
    }

    pub(super) fn position(&self, foot: &Box4) -> EastNorth {
        let [east_m, north_m] = self.0.project(foot);
        EastNorth { east_m, north_m }
    }

    pub(super) fn tangent(&self, foot: &Box4) -> GroundTangent {
        let evaluation = self.0.evaluate(foot);
        let tangent = evaluation.tangent();
        let [east, north] = self.0.jacobian(&evaluation);
        let [east_m, north_m] = evaluation.offset_m;
        GroundTangent {
            position: Vector2::new(self.0.centre_m[0] + east_m, self.0.centre_m[1] + north_m),
            by_parameters: [0, 1].map(|axis| std::array::from_fn(|at| tangent[axis][at])),
            by_foot: Matrix2::new(east[0], east[1], north[0], north[1]),
        }
    }

    /// The foot point (u, v) of a target at a position, px; `None` beyond the horizon.
    pub(super) fn foot_at(&self, position: Vector2<f64>) -> Option<[f64; 2]> {
        let c = &self.0.coefficients;
        let [e, n] = [position[0] - self.0.centre_m[0], position[1] - self.0.centre_m[1]];
        let slopes = Matrix2::new(c[1] - e * c[6], c[2] - e * c[7], c[4] - n * c[6], c[5] - n * c[7]);
        let scaled = slopes.try_inverse()? * Vector2::new(e - c[0], n - c[3]);
        let denominator = 1.0 + c[6] * scaled[0] + c[7] * scaled[1];
        (denominator > LEAST_DENOMINATOR)
            .then(|| [0, 1].map(|side| self.0.scales_px[side][0] + self.0.scales_px[side][1] * scaled[side]))
    }

    pub(super) fn moved_by(&self, step: &[f64]) -> Self {
        let mut moved = self.clone();
        for (coefficient, step) in moved.0.coefficients.iter_mut().zip(step) {
            *coefficient += step;
        }
        moved
    }

    pub(super) fn parameters(&self) -> &[f64] {
        &self.0.coefficients[..PARAMETERS]
    }

    /// Variances of the prior of the parameters, about 0.
    pub(super) fn prior_variances(&self) -> [f64; PARAMETERS] {
        let all = self.0.prior_variances(1.0);
        std::array::from_fn(|at| all[at])
    }
}
