//! The error variance of one box: the nominal variance at its position in the image, and the excess of an atypical box.
//!
//! ```text
//! variance = nominal * border * (1 + e^2) + factor * min(excess, limit) + max(excess - limit, 0)
//! excess   = inconsistent + Es * (max(eX - eX_nominal, 0) + (e * radius_px / height_px)^2)
//! ```
//!
//! where `nominal` comes from the coverage, `border` is the factor of a box that touches the image's border,
//! `e` is the extrapolation ratio beyond 1.5 covering radii, `inconsistent` comes from the local box model,
//! `Es` is the variance per squared box height of displacement of the foot point, and `factor` and `limit`
//! are the calibration of the excess on the atypical boxes of the training.

use super::coverage::{Coverage, CoverageLookup, CoverageTable};
use super::local_boxes::LocalBoxModel;
use crate::artifact::ModelParts;
use crate::domain::{BoundingBox, ImageSize, Result};
use crate::encoder::features::{Encoded, reconstruction_error};
use crate::statistics::R95_PER_SIGMA;

/// Distance to the nearest centre, in covering radii, up to which the nominal error holds; a box beyond it
/// is outside of the training.
pub(crate) const NOMINAL_RATIO: f64 = 1.5;

/// A box in full view (0) or cut by the image's border (1): the excess variance of the two is calibrated
/// separately.
pub(crate) type TruncationClass = usize;

/// Names of the parameters that hold limit and factor of [`ExcessCalibration`], by truncation class.
pub(crate) const EXCESS_PARAMETERS: [[&str; 2]; 2] =
    [["extra_shown_m2", "extra_factor"], ["border_extra_shown_m2", "border_extra_factor"]];

/// The ratio of the actual to the computed excess variance of the atypical training boxes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExcessCalibration {
    /// The computed excess variance that 95 % of these boxes do not exceed, m2; beyond it the computed
    /// value counts in full.
    pub(crate) limit_m2: f64,
    pub(crate) factor: f64,
}

/// The error model of one recipe's encoder.
#[derive(Debug, Clone)]
pub(crate) struct ErrorModel {
    pub(crate) coverage: CoverageTable,
    pub(crate) local_boxes: LocalBoxModel,
    pub(crate) image_size: Option<ImageSize>,
    /// Es: m2 per axis per unit of reconstruction error.
    pub(crate) error_scale: f64,
    /// Reconstruction error up to which there is no excess.
    pub(crate) nominal_reconstruction_error: f64,
    /// Factor on the nominal variance of a box at the image's border.
    pub(crate) border_factor: f64,
    /// By truncation class.
    pub(crate) excess: [ExcessCalibration; 2],
}

/// The error of one box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BoxError {
    /// eX: see [`reconstruction_error`].
    pub(crate) reconstruction_error: f64,
    /// Error variance per axis, m2.
    pub(crate) variance_m2: f64,
}

impl ErrorModel {
    /// Takes the error model's tensors out of the parts of a model; `is_formula` is true if the recipe has a formula
    /// of its own for the error, and the parts no parameters of a calibration.
    ///
    /// # Errors
    /// Names the tensor or parameter that is missing or cannot be used.
    pub(crate) fn build(parts: &mut ModelParts, is_formula: bool) -> Result<Self> {
        let coverage = Coverage::take(&mut parts.tensors)?;
        let local_boxes = LocalBoxModel::take(&mut parts.tensors, &coverage)?;
        let (nominal_reconstruction_error, border_factor) = if is_formula {
            (0.0, 1.0)
        } else {
            (parts.positive_parameter("reconstruction_usual")?, parts.positive_parameter("border_factor")?)
        };
        let mut excess = [ExcessCalibration { limit_m2: 0.0, factor: 1.0 }; 2];
        for (excess, [limit, factor]) in excess.iter_mut().zip(EXCESS_PARAMETERS) {
            excess.limit_m2 = parts.parameter_or(limit, 0.0)?.max(0.0);
            excess.factor = parts.parameter_or(factor, 1.0)?.max(0.0);
        }
        Ok(Self {
            coverage: coverage.table(),
            local_boxes,
            image_size: image_size_of(parts)?,
            error_scale: parts.error_scale,
            nominal_reconstruction_error,
            border_factor,
            excess,
        })
    }

    /// Size of the image, if known.
    pub(crate) const fn image_size(&self) -> Option<ImageSize> {
        self.image_size
    }

    #[inline]
    pub(crate) fn look_up(&self, bounding_box: &BoundingBox) -> CoverageLookup {
        self.coverage.look_up(bounding_box)
    }

    /// Distance of a box from those of training: [`CoverageLookup::extrapolation_ratio`].
    #[inline]
    pub(crate) fn extrapolation_ratio(&self, bounding_box: &BoundingBox) -> f64 {
        self.coverage.extrapolation_ratio(bounding_box)
    }

    /// True if a box is unlike those of training: far from all of them, or with edges that the decoder does
    /// not reconstruct. For `paper` the first alone, as its error is Es eX at any eX.
    #[inline]
    pub(crate) fn is_outside_training(&self, extrapolation_ratio: f64, reconstruction_error: f64) -> bool {
        let limit = self.nominal_reconstruction_error;
        extrapolation_ratio > NOMINAL_RATIO || (limit > 0.0 && reconstruction_error > limit)
    }

    /// Reconstruction error and error variance of a box.
    #[inline]
    pub(crate) fn error_of(
        &self,
        bounding_box: &BoundingBox,
        lookup: &CoverageLookup,
        encoded: &Encoded,
    ) -> BoxError {
        let reconstruction_error = reconstruction_error(bounding_box, encoded);
        let extrapolation = (lookup.extrapolation_ratio - NOMINAL_RATIO).max(0.0);
        let class = self.truncation_class(bounding_box);
        let border = if class == 1 { self.border_factor } else { 1.0 };
        let excess_m2 = self.excess_m2(bounding_box, lookup, reconstruction_error);
        let calibration = self.excess[class];
        let calibrated_m2 = excess_m2.min(calibration.limit_m2);
        let variance_m2 = lookup.nominal_m2 * border * (1.0 + extrapolation * extrapolation)
            + calibration.factor * calibrated_m2
            + (excess_m2 - calibrated_m2);
        BoxError { reconstruction_error, variance_m2 }
    }

    #[inline]
    pub(crate) fn truncation_class(&self, bounding_box: &BoundingBox) -> TruncationClass {
        usize::from(bounding_box.touches_border(self.image_size))
    }

    /// The excess variance before its calibration, m2 per axis.
    #[inline]
    fn excess_m2(
        &self,
        bounding_box: &BoundingBox,
        lookup: &CoverageLookup,
        reconstruction_error: f64,
    ) -> f64 {
        let excess = (reconstruction_error - self.nominal_reconstruction_error).max(0.0);
        let extrapolation = (lookup.extrapolation_ratio - NOMINAL_RATIO).max(0.0);
        // A box far from those of the training may be a false detection; then its foot point is displaced
        // by as much.
        let displacement = extrapolation * self.coverage.radius_px() / bounding_box.height_px();
        self.local_boxes.inconsistent_variance_m2(lookup.nearest, bounding_box)
            + self.error_scale * (excess + displacement * displacement)
    }

    /// The same for an encoded box.
    pub(crate) fn excess_of(&self, bounding_box: &BoundingBox, encoded: &Encoded) -> f64 {
        let lookup = self.look_up(bounding_box);
        self.excess_m2(bounding_box, &lookup, reconstruction_error(bounding_box, encoded))
    }
}

/// Parameters with which an encoder can be used before its error is calibrated.
pub(crate) fn set_uncalibrated(parts: &mut ModelParts, coverage: &Coverage) {
    coverage.put(&mut parts.tensors);
    parts.set("border_factor", 1.0);
    parts.set("reconstruction_usual", 1.0);
    parts.set("r95_scale", R95_PER_SIGMA);
}

/// Stores the size of the image, if known.
pub(crate) fn set_image_size(parts: &mut ModelParts, image_size: Option<ImageSize>) {
    if let Some(size) = image_size {
        parts.set("image_width_px", f64::from(size.width_px()));
        parts.set("image_height_px", f64::from(size.height_px()));
    }
}

fn image_size_of(parts: &ModelParts) -> Result<Option<ImageSize>> {
    if !parts.parameters.contains_key("image_width_px") {
        return Ok(None);
    }
    let side = |name: &str| parts.positive_parameter(name).map(|side_px| side_px as u32);
    let size = ImageSize::new(side("image_width_px")?, side("image_height_px")?);
    size.map(Some).map_err(|error| error.under("metadata.parameters.image"))
}
