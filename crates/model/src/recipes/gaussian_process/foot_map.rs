//! A homography of the foot point that was fitted elsewhere as a model of this recipe: a mean without a residual.

use nalgebra::SMatrix;

use super::box_plausibility::BoxPlausibility;
use super::companion;
use super::kernel::InputScales;
use super::map_rows::MapRows;
use super::predictor::{PositionMap, Predictor, Stated};
use super::projective_mean::{COEFFICIENTS, FOOT_COEFFICIENTS, ProjectiveMean};
use super::recipe::{map_rows, white_share};
use crate::artifact::ModelParts;
use crate::domain::{Error, Recipe};
use crate::geo::{EastNorth, LocalPlane};
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;

/// Step at which a plane's axes are compared with those of another, m.
const AXIS_STEP_M: f64 = 100.0;

/// Covariance of the foot's coefficients.
pub(crate) type FootCovariance = SMatrix<f64, FOOT_COEFFICIENTS, FOOT_COEFFICIENTS>;

/// A fitted homography of the foot point with its error.
#[derive(Debug, Clone)]
pub(crate) struct FittedFootMap {
    pub(crate) mean: ProjectiveMean,
    pub(crate) covariance: FootCovariance,
    /// Standard deviation of a foot per axis, px.
    pub(crate) foot_sigma_px: f64,
    /// Variance per axis of the bias that all receivers have in common, m2.
    pub(crate) shared_bias_m2: f64,
    /// Degrees of freedom of the covariance.
    pub(crate) freedom: f64,
}

impl FittedFootMap {
    /// The same map with its positions in another plane. Between planes that are some kilometres apart the positions
    /// are shifted and, by the convergence of the meridians, turned.
    pub(crate) fn in_plane(mut self, from: &LocalPlane, to: &LocalPlane) -> Self {
        let [east_m, north_m] = self.mean.centre_m;
        let moved = |east_m, north_m| {
            let EastNorth { east_m, north_m } = to.to_plane(from.to_position(EastNorth { east_m, north_m }));
            [east_m, north_m]
        };
        let centre_m = moved(east_m, north_m);
        let axes = [moved(east_m + AXIS_STEP_M, north_m), moved(east_m, north_m + AXIS_STEP_M)]
            .map(|end_m| [0, 1].map(|axis| (end_m[axis] - centre_m[axis]) / AXIS_STEP_M));
        let mut turn = FootCovariance::identity();
        for term in 0..3 {
            for axis in 0..2 {
                for source in 0..2 {
                    turn[(3 * axis + term, 3 * source + term)] = axes[source][axis];
                }
            }
        }
        let foot = SMatrix::<f64, FOOT_COEFFICIENTS, 1>::from_column_slice(
            &self.mean.coefficients[..FOOT_COEFFICIENTS],
        );
        self.mean.centre_m = centre_m;
        self.mean.coefficients[..FOOT_COEFFICIENTS].copy_from_slice((turn * foot).as_slice());
        self.covariance = turn * self.covariance * turn.transpose();
        self
    }

    fn predictor(&self, rows: &MapRows) -> Option<Predictor> {
        let factor = self.covariance.cholesky()?.l();
        let mut tangent_factor = vec![0.0; COEFFICIENTS * COEFFICIENTS];
        for row in 0..FOOT_COEFFICIENTS {
            for column in 0..=row {
                tangent_factor[row * COEFFICIENTS + column] = factor[(row, column)];
            }
        }
        let foot_px2 = self.foot_sigma_px * self.foot_sigma_px;
        let stated = Stated {
            // The foot is in the middle of the lower edge: the mean of left and right.
            edge_px2: std::array::from_fn(|at| match at {
                0 | 10 => 2.0 * foot_px2,
                5 | 15 => foot_px2,
                _ => 0.0,
            }),
            shared_bias_m2: self.shared_bias_m2,
            freedom: self.freedom,
            plausibility: BoxPlausibility::fit(&rows.epochs, &rows.boxes),
        };
        let map = PositionMap::without_kernel(1.0, self.mean.clone(), tangent_factor);
        Some(Predictor::new(vec![map], InputScales::of_rows(&rows.boxes), stated))
    }

    /// The parts of a model in the plane of its training rows, with an auto-encoder of `epochs` epochs.
    ///
    /// # Errors
    /// [`FitError::Unusable`] if the covariance is none; [`FitError::Cancelled`].
    pub(crate) fn into_parts(
        self,
        rows: &TrainingRows,
        e_gnss_m2: f64,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<ModelParts, FitError> {
        let map_rows = map_rows(rows);
        let predictor = self.predictor(&map_rows).ok_or_else(|| {
            FitError::Unusable(Error::invalid("samples", "determine no map from boxes to positions"))
        })?;
        let mut parts = ModelParts::new(Recipe::GaussianProcess, rows.plane, predictor.features(), e_gnss_m2);
        predictor.put(&mut parts);
        parts.set("radius_degrees_of_freedom", self.freedom);
        parts.set("unrest_share", white_share(&predictor, &map_rows));
        companion::fit(rows, epochs, &mut parts, phase)?;
        Ok(parts)
    }
}

/// Multiplies the variance of the map that a model of this recipe states.
///
/// # Errors
/// Names the scalar that is missing.
pub(crate) fn widen_map(parts: &mut ModelParts, factor: f64) -> crate::domain::Result<()> {
    let widening = parts.positive_parameter(super::stored::WIDENING)?;
    parts.set(super::stored::WIDENING, factor * widening);
    Ok(())
}
