//! The recipes, each in a folder of its own: how it is fitted, and what it makes of a box.

pub(crate) mod gaussian_process;
pub(crate) mod hybrid;
pub(crate) mod paper;
pub(crate) mod projective;

use self::gaussian_process::GaussianProcessEncoder;
use self::hybrid::HybridEncoder;
use self::paper::PaperEncoder;
use self::projective::ProjectiveEncoder;
use crate::artifact::ModelParts;
use crate::domain::{BoundingBox, Error, Recipe, Result};
use crate::encoder::features::{Encoded, features_of};
use crate::geo::{LocalPlane, PlaneCovariance};

/// The encoder of a loaded model, by recipe.
#[derive(Debug, Clone)]
pub(crate) enum Encoder {
    Paper(Box<PaperEncoder>),
    Hybrid(Box<HybridEncoder>),
    Projective(Box<ProjectiveEncoder>),
    GaussianProcess(Box<GaussianProcessEncoder>),
}

impl Encoder {
    /// Takes the encoder's tensors out of the parts of a model.
    ///
    /// # Errors
    /// Names the tensor or metadata field that is missing or cannot be used.
    pub(crate) fn build(parts: &mut ModelParts) -> Result<Self> {
        Ok(match parts.recipe {
            Recipe::Paper => Self::Paper(Box::new(PaperEncoder::build(parts)?)),
            Recipe::Hybrid => Self::Hybrid(Box::new(HybridEncoder::build(parts)?)),
            Recipe::Projective => Self::Projective(Box::new(ProjectiveEncoder::build(parts)?)),
            Recipe::GaussianProcess => Self::GaussianProcess(Box::new(GaussianProcessEncoder::build(parts)?)),
            Recipe::Auto => {
                let message =
                    "must be the recipe that auto has chosen: paper, hybrid, projective or gaussian_process";
                return Err(Error::invalid("metadata.recipe", message));
            }
        })
    }

    /// The error that a map and others have in common (m2), as this encoder states it: widened as the map's own, and
    /// with the bias that all receivers have in common.
    pub(crate) fn widened(&self, common_m2: PlaneCovariance) -> PlaneCovariance {
        match self {
            Self::GaussianProcess(map) => {
                let bias = PlaneCovariance::isotropic(map.predictor.shared_bias_m2);
                common_m2.scaled(map.predictor.widening).plus(bias)
            }
            Self::Paper(_) | Self::Hybrid(_) | Self::Projective(_) => common_m2,
        }
    }

    /// Position and reconstruction of a box alone.
    pub(crate) fn encode(&self, plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded {
        match self {
            Self::Paper(paper) => Encoded {
                position: paper.estimate(plane, bounding_box, None).position,
                reconstruction_px: features_of(bounding_box),
            },
            Self::Hybrid(hybrid) => hybrid.encode(bounding_box),
            Self::Projective(projective) => projective.encode(bounding_box),
            Self::GaussianProcess(map) => map.estimate(bounding_box, None).encoded,
        }
    }
}
