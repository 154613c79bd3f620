//! The calibration of a fitted encoder's error: the nominal variance at every centre of the coverage and
//! the parameters of the excess variance of atypical boxes, from held-out and own residuals.

use super::centre_statistics::CentreStatistics;
use super::coverage::Coverage;
use super::excess_calibration::calibrate_excess;
use super::local_boxes::LocalBoxModel;
use super::variance_components::{
    between_block_m2, between_session_m2, between_traverse_m2, robust_variance_m2,
};
use crate::artifact::ModelParts;
use crate::domain::{BoundingBox, GaussMarkovNoise, ImageSize};
use crate::encoder::FittedEncoder;
use crate::encoder::features::{Encoded, reconstruction_error};
use crate::encoder::geometry::GeometricCovariance;
use crate::geo::EastNorth;
use crate::progress::FitError;
use crate::recipes;
use crate::samples::rows::{HELD_OUT_BLOCKS, TrainingRow};
use crate::samples::second_differences::{MEAN_SQUARE_PER_VARIANCE, second_differences, trimmed_mean};
use crate::samples::whitening::effective_sample_size;
use crate::statistics::R95_PER_SIGMA;

/// Largest ratio of the receiver's stated variance to that of the residuals that is taken into account.
const LARGEST_UNDERESTIMATION: f64 = 1.5;
/// Edge noise where it cannot be estimated, px2.
const DEFAULT_EDGE_NOISE_PX2: f64 = 1.0;
/// Least nominal variance, m2.
const LEAST_VARIANCE_M2: f64 = 1e-4;
/// Factor on the 95 % radius of a normal distribution: the variance differs over the image, so the errors of
/// all boxes have heavier tails.
const TAIL_FACTOR: f64 = 1.1;
/// Factor on the nominal variance of boxes at the image's border, if the training has less than this share
/// of them; otherwise their error is contained in the nominal variance.
const RARE_BORDER_FACTOR: f64 = 4.0;
const RARE_BORDER_SHARE: f64 = 0.03;
/// The nominal limit of the reconstruction error is this quantile of the training boxes' times the factor.
const RECONSTRUCTION_QUANTILE: f64 = 0.995;
const RECONSTRUCTION_FACTOR: f64 = 2.0;
const LEAST_RECONSTRUCTION: f64 = 1e-4;

/// Variances per axis that a calibration has determined, m2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Calibration {
    /// Error of the regression, mean over the training boxes.
    pub(crate) error_m2: f64,
    /// Error of the receiver about the map, including errors that are constant within a block of time.
    pub(crate) receiver_m2: f64,
}

/// Rows with the residuals (regressed position less fix; east, north; m) of encoders that were not fitted to
/// them, and the noise of the fixes.
pub(crate) struct HeldOut<'a> {
    pub(crate) rows: &'a [TrainingRow],
    pub(crate) residuals: &'a [[f64; 2]],
    pub(crate) noise: &'a GaussMarkovNoise,
}

/// Adds the calibrated error to a fitted encoder. `geometry` is used for an encoder without a covariance of
/// its own: its parameters are determined at most as well as those of a geometric map.
///
/// # Errors
/// [`FitError::Fault`] if the fitted encoder cannot be used.
pub(crate) fn calibrate(
    fitted: &mut FittedEncoder,
    geometry: GeometricCovariance,
    held_out: &HeldOut<'_>,
    image_size: Option<ImageSize>,
) -> Result<Calibration, FitError> {
    let HeldOut { rows, residuals, noise } = *held_out;
    let FittedEncoder { parts, covariance } = fitted;
    let covariance = covariance.get_or_insert(geometry);
    let encoder = recipes::load(&mut parts.clone()).map_err(FitError::fault)?;
    let plane = parts.plane;
    let encode = |bounding_box: &BoundingBox| encoder.encode(&plane, bounding_box);
    let coverage = Coverage::new(rows.iter().map(|row| row.bounding_box));
    let centres = CentreStatistics::new(&coverage, rows, covariance, &encode);
    let encoded: Vec<Encoded> = rows.iter().map(|row| encode(&row.bounding_box)).collect();
    let own: Vec<[f64; 2]> = rows.iter().zip(&encoded).map(own_residual).collect();
    let local_boxes = LocalBoxModel::new(&coverage, rows, &encode);

    let components = Components::estimate(held_out, &own, &coverage, &centres, parts.e_gnss_m2)
        .with_edge_noise(edge_noise_px2(rows, &encoded, &centres, &local_boxes));
    let coverage = coverage.with_errors(components.nominal_errors_m2(&centres));
    let error_m2 = centres.mean(coverage.errors_m2());
    let effective_size = effective_sample_size(rows, &noise.correlation);
    components.set(parts, &centres, error_m2);
    parts.error_scale = centres.mean(centres.height_m2.iter().copied()).clamp(1e-9, 1e9);
    parts.set("reconstruction_usual", nominal_reconstruction_error(rows, &encoded));
    parts.set("r95_scale", TAIL_FACTOR * R95_PER_SIGMA);
    parts.set("border_factor", border_factor(rows, image_size));
    parts.set("independent_fixes", effective_size);
    coverage.put(&mut parts.tensors);
    local_boxes.put(&mut parts.tensors);
    calibrate_excess(parts, rows, residuals, effective_size, &encode).map_err(FitError::fault)?;
    let receiver_m2 = robust_variance_m2(&own) + components.between_block_m2;
    Ok(Calibration { error_m2, receiver_m2 })
}

/// The components of the nominal variance, per axis.
struct Components {
    /// Variance due to the covariance of the parameters, mean over the training boxes, m2.
    parameter_m2: f64,
    /// Factor by which the fit underestimates the noise of the fixes, and with it that variance.
    underestimation: f64,
    /// Variance of the map's error that its form cannot represent, m2.
    misfit_m2: f64,
    between_block_m2: f64,
    between_session_m2: f64,
    /// Variance of the detector's noise in each edge, px2.
    edge_noise_px2: f64,
}

impl Components {
    fn estimate(
        HeldOut { rows, residuals, noise }: &HeldOut<'_>,
        own: &[[f64; 2]],
        coverage: &Coverage,
        centres: &CentreStatistics,
        e_gnss_m2: f64,
    ) -> Self {
        let parameter_m2 = centres.mean(centres.parameter_m2.iter().copied());
        // The map follows the noise by as much as its parameters are undetermined; the receiver's stated
        // variance may exceed the residuals' further.
        let underestimation = (1.0 + parameter_m2 / noise.variance_m2)
            .max((e_gnss_m2 / noise.variance_m2).min(LARGEST_UNDERESTIMATION));
        let traverse_m2 = between_traverse_m2(rows, coverage, residuals).unwrap_or(0.0);
        Self {
            parameter_m2,
            underestimation,
            misfit_m2: (traverse_m2 - parameter_m2).max(0.0),
            between_block_m2: between_block_m2(residuals, own, parameter_m2),
            between_session_m2: between_session_m2(rows, own, noise),
            edge_noise_px2: DEFAULT_EDGE_NOISE_PX2,
        }
    }

    fn with_edge_noise(self, edge_noise_px2: f64) -> Self {
        Self { edge_noise_px2, ..self }
    }

    /// Nominal error variance per axis at each centre, m2.
    fn nominal_errors_m2(&self, centres: &CentreStatistics) -> Vec<f32> {
        // Both are estimates of errors that are common to a longer time than a traverse; the larger counts.
        let long_term_m2 = self.between_session_m2.max(self.between_block_m2 / f64::from(HELD_OUT_BLOCKS));
        let everywhere_m2 = self.misfit_m2 + long_term_m2;
        let at_centre = |(parameter_m2, edge_m2): (&f64, &f64)| {
            let variance_m2 =
                self.underestimation * parameter_m2 + everywhere_m2 + self.edge_noise_px2 * edge_m2;
            variance_m2.max(LEAST_VARIANCE_M2) as f32
        };
        centres.parameter_m2.iter().zip(&centres.edge_m2).map(at_centre).collect()
    }

    /// Stores the components under the names that the metadata document has for them.
    fn set(&self, parts: &mut ModelParts, centres: &CentreStatistics, error_m2: f64) {
        let jitter_m2 = self.edge_noise_px2 * centres.mean(centres.edge_m2.iter().copied());
        parts.set("unrest_share", (jitter_m2 / error_m2).clamp(0.0, 1.0));
        parts.set("error_doubt_m2", self.underestimation * self.parameter_m2);
        parts.set("error_misfit_m2", self.misfit_m2);
        parts.set("error_lasting_m2", self.between_block_m2);
        parts.set("error_session_m2", self.between_session_m2);
        parts.set("edge_noise_px2", self.edge_noise_px2);
    }
}

/// Regressed position less label, m.
fn own_residual((row, encoded): (&TrainingRow, &Encoded)) -> [f64; 2] {
    let EastNorth { east_m, north_m } = encoded.position;
    [east_m - row.label.east_m, north_m - row.label.north_m]
}

fn border_factor(rows: &[TrainingRow], image_size: Option<ImageSize>) -> f64 {
    let at_border = rows.iter().filter(|row| row.bounding_box.touches_border(image_size)).count();
    let is_rare = (at_border as f64) < RARE_BORDER_SHARE * rows.len() as f64;
    if is_rare { RARE_BORDER_FACTOR } else { 1.0 }
}

/// Stores the reconstruction error above which a box is unlike those of training, for a recipe whose error
/// variance is calibrated by itself.
///
/// # Errors
/// [`FitError::Fault`] if the fitted encoder cannot be used.
pub(crate) fn calibrate_reconstruction(parts: &mut ModelParts, rows: &[TrainingRow]) -> Result<(), FitError> {
    let encoder = recipes::load(&mut parts.clone()).map_err(FitError::fault)?;
    let encoded: Vec<Encoded> =
        rows.iter().map(|row| encoder.encode(&parts.plane, &row.bounding_box)).collect();
    parts.set("reconstruction_usual", nominal_reconstruction_error(rows, &encoded));
    Ok(())
}

/// Reconstruction error up to which a box is as consistent as those of the training.
fn nominal_reconstruction_error(rows: &[TrainingRow], encoded: &[Encoded]) -> f64 {
    let mut errors: Vec<f64> = rows
        .iter()
        .zip(encoded)
        .map(|(row, encoded)| reconstruction_error(&row.bounding_box, encoded))
        .collect();
    errors.sort_by(f64::total_cmp);
    let rank = ((errors.len() - 1) as f64 * RECONSTRUCTION_QUANTILE) as usize;
    errors[rank].max(LEAST_RECONSTRUCTION) * RECONSTRUCTION_FACTOR
}

/// Variance of the detector's noise in one edge, px2: the white variance of the regressed positions by
/// their second differences, divided by the variance per px2 of edge noise at their centre. Boxes that the
/// local model finds inconsistent are excluded; their error is modelled separately.
fn edge_noise_px2(
    rows: &[TrainingRow],
    encoded: &[Encoded],
    centres: &CentreStatistics,
    local_boxes: &LocalBoxModel,
) -> f64 {
    let nominal: Vec<bool> = rows
        .iter()
        .zip(&centres.of_row)
        .map(|(row, at)| local_boxes.inconsistent_variance_m2(*at, &row.bounding_box) <= 0.0)
        .collect();
    let positions: Vec<EastNorth> = encoded.iter().map(|encoded| encoded.position).collect();
    let variances = second_differences(rows, &positions).filter_map(|(at, square_m2)| {
        let edge_m2 = centres.edge_m2[centres.of_row[at]];
        let usable = edge_m2 > 0.0 && nominal[at - 1..=at + 1].iter().all(|nominal| *nominal);
        usable.then(|| square_m2 / (MEAN_SQUARE_PER_VARIANCE * edge_m2))
    });
    trimmed_mean(variances.collect()).unwrap_or(DEFAULT_EDGE_NOISE_PX2)
}
