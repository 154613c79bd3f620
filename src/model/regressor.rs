//! A model that answers: one box in, one position with its error out, without allocation.
//!
//! What never happens here: candle, training, GNSS fusion (that is the floor above).

use super::artifact::Parts;
use super::coverage::Coverage;
use super::hybrid::HybridRegressor;
use super::paper::PaperRegressor;
use crate::domain::{BoundingBox, ImageSize, Recipe, Result};
use crate::geo::{EastNorth, LocalPlane};

/// Radius that holds 95 % of a circular normal distribution, in standard deviations per axis.
pub const R95_PER_SIGMA: f64 = 2.447_746_830_680_816;
/// Beyond this many radii of the training boxes a box is outside.
const OUTSIDE_RADII: f64 = 1.5;
/// Factor on the error variance of boxes that the image's border cuts where few were in training.
const BORDER_FACTOR: f64 = 4.0;

/// The one-step answer for one box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Regression {
    /// Position in the model's plane.
    pub regressed: EastNorth,
    /// eX of (2), in the recipe's units.
    pub reconstruction_error: f64,
    /// Error variance per axis, m2; above 0.
    pub e_regression_m2: f64,
    /// Whether the box is unlike those of the training samples.
    pub outside_training: bool,
    /// `r95_m = r95_scale * sqrt(e)` of the regressed and of the fused position.
    pub r95_scale: f64,
}

/// What a recipe alone says of a box.
#[derive(Debug, Clone, Copy)]
pub(super) struct Raw {
    pub(super) regressed: EastNorth,
    pub(super) reconstruction_error: f64,
    pub(super) e_m2: f64,
}

#[derive(Debug, Clone)]
enum Kind {
    Paper(PaperRegressor),
    Hybrid(HybridRegressor),
}

/// A loaded model: flat weights, shared freely between threads.
#[derive(Debug, Clone)]
pub struct Regressor {
    plane: LocalPlane,
    e_gnss_m2: f64,
    r95_scale: f64,
    image_size: Option<ImageSize>,
    coverage: Coverage,
    kind: Kind,
}

impl Regressor {
    pub(super) fn build(mut parts: Parts) -> Result<Self> {
        let coverage = parts.take_coverage()?;
        let kind = match parts.recipe {
            Recipe::Paper => Kind::Paper(PaperRegressor::build(&mut parts)?),
            Recipe::Hybrid | Recipe::Projective | Recipe::Auto => {
                Kind::Hybrid(HybridRegressor::build(&mut parts)?)
            }
        };
        let image_size = image_size_of(&parts)?;
        let r95_scale = parts.positive_parameter("r95_scale")?;
        let Parts { plane, e_gnss_m2, tensors, .. } = parts;
        tensors.finish()?;
        Ok(Self { plane, e_gnss_m2, r95_scale, image_size, coverage, kind })
    }

    /// The plane in which it answers.
    #[must_use]
    pub const fn plane(&self) -> &LocalPlane {
        &self.plane
    }

    /// The receiver's error variance per axis, m2.
    #[must_use]
    pub const fn e_gnss_m2(&self) -> f64 {
        self.e_gnss_m2
    }

    /// Where the target in a box stands, and how sure that is. The fix only matters to the network
    /// of the recipe `paper` that has it among its inputs.
    #[must_use]
    pub fn regress(&self, bounding_box: &BoundingBox, fix: Option<EastNorth>) -> Regression {
        let raw = match &self.kind {
            Kind::Paper(paper) => paper.regress(&self.plane, bounding_box, fix),
            Kind::Hybrid(hybrid) => hybrid.regress(bounding_box),
        };
        let radii = self.coverage.distance(bounding_box);
        let outside_training = radii > OUTSIDE_RADII;
        let widened = match &self.kind {
            // To the letter: the error is Es * eX and nothing else.
            Kind::Paper(_) => 1.0,
            Kind::Hybrid(_) => {
                let beyond = (radii - 1.0).max(0.0);
                let border = if bounding_box.touches_border(self.image_size) { BORDER_FACTOR } else { 1.0 };
                border * (1.0 + beyond * beyond)
            }
        };
        Regression {
            regressed: raw.regressed,
            reconstruction_error: raw.reconstruction_error,
            // The bounds keep every weight and radius finite whatever the net says.
            e_regression_m2: (raw.e_m2 * widened).clamp(1e-6, 1e12),
            outside_training,
            r95_scale: self.r95_scale,
        }
    }
}

fn image_size_of(parts: &Parts) -> Result<Option<ImageSize>> {
    if !parts.parameters.contains_key("image_width_px") {
        return Ok(None);
    }
    let side = |name: &str| parts.positive_parameter(name).map(|side_px| side_px as u32);
    let size = ImageSize::new(side("image_width_px")?, side("image_height_px")?);
    size.map(Some).map_err(|error| error.under("metadata.parameters.image"))
}
