//! A model as it is stored and exchanged: a metadata document and a safetensors file of weights.
//!
//! An artifact may come from another server or from a damaged disk, so every name, shape and number is
//! checked when it is taken apart, before anything is computed from it.

mod file;
pub(crate) mod tensors;
mod track_noise;

use std::collections::BTreeMap;

use bytes::Bytes;

use self::tensors::{LARGEST_MAGNITUDE, Tensors, is_usable};
use crate::domain::{Error, FeatureScale, JointTraining, ModelMetadata, Recipe, Result};
use crate::geo::{EastNorth, LocalPlane, Position};

pub use self::tensors::LARGEST_WEIGHTS_BYTES;
pub(crate) use self::track_noise::LEAST_GNSS_WHITE_SHARE;
pub use self::track_noise::TrackNoiseModel;

/// Version of the metadata document.
pub const FORMAT: u32 = 1;

/// A fitted model, ready to be stored or sent.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// The metadata document.
    pub metadata: ModelMetadata,
    /// The weights as safetensors, at most [`LARGEST_WEIGHTS_BYTES`].
    pub weights: Bytes,
}

impl Artifact {
    /// Metadata and weights taken apart and checked.
    ///
    /// # Errors
    /// Names `metadata.x` or `weights` where something is unknown, missing, not finite, or too large.
    pub(crate) fn parts(&self) -> Result<ModelParts> {
        let metadata = &self.metadata;
        if metadata.format != FORMAT {
            return Err(Error::invalid("metadata.format", format!("must be {FORMAT}")));
        }
        let recipe: Recipe = metadata.recipe.parse().map_err(|error: Error| error.under("metadata"))?;
        let origin = Position::new(metadata.origin.longitude_deg, metadata.origin.latitude_deg)
            .map_err(|error| Error::invalid("metadata.origin", error.to_string()))?;
        Ok(ModelParts {
            recipe,
            plane: LocalPlane::new(origin),
            features: metadata.features.clone(),
            error_scale: positive("error_scale", metadata.error_scale)?,
            e_gnss_m2: positive("e_gnss_m2", metadata.e_gnss_m2)?,
            parameters: metadata.parameters.clone(),
            joint_training: metadata.joint_training.clone(),
            tensors: Tensors::from_bytes(&self.weights)?,
        })
    }
}

/// A number by which others are divided or multiplied.
fn positive(field: &str, value: f64) -> Result<f64> {
    if value >= LARGEST_MAGNITUDE.recip() && is_usable(value) {
        Ok(value)
    } else {
        let least = LARGEST_MAGNITUDE.recip();
        let message = format!("must be a finite number from {least:e} to {LARGEST_MAGNITUDE:e}");
        Err(Error::invalid(format!("metadata.{field}"), message))
    }
}

/// A model taken apart: the output of a recipe's fit, and the input of a regressor.
#[derive(Debug, Clone)]
pub(crate) struct ModelParts {
    pub(crate) recipe: Recipe,
    /// The plane of the positions.
    pub(crate) plane: LocalPlane,
    /// Names and scaling of the encoder's inputs.
    pub(crate) features: Vec<FeatureScale>,
    /// Es: error variance (m2, or units2 in the recipe `paper`) per unit of reconstruction error.
    pub(crate) error_scale: f64,
    /// Error variance per axis of the receiver, m2.
    pub(crate) e_gnss_m2: f64,
    /// The recipe's scalars by name.
    pub(crate) parameters: BTreeMap<String, f64>,
    /// The run that trained it together with other cameras, if one did.
    pub(crate) joint_training: Option<JointTraining>,
    pub(crate) tensors: Tensors,
}

impl ModelParts {
    /// The parts of a model without parameters and tensors, whose error scale is 1.
    pub(crate) fn new(
        recipe: Recipe,
        plane: LocalPlane,
        features: Vec<FeatureScale>,
        e_gnss_m2: f64,
    ) -> Self {
        Self {
            recipe,
            plane,
            features,
            error_scale: 1.0,
            e_gnss_m2,
            parameters: BTreeMap::new(),
            joint_training: None,
            tensors: Tensors::default(),
        }
    }

    /// Sets a scalar of the recipe.
    pub(crate) fn set(&mut self, name: &str, value: f64) {
        self.parameters.insert(name.to_owned(), value);
    }

    /// A scalar of the recipe.
    ///
    /// # Errors
    /// Names the parameter that is missing, not finite or too large.
    pub(crate) fn parameter(&self, name: &str) -> Result<f64> {
        match self.parameters.get(name) {
            Some(value) if is_usable(*value) => Ok(*value),
            _ => {
                let message = format!("must be there, finite and within {LARGEST_MAGNITUDE:e}");
                Err(Error::invalid(format!("metadata.parameters.{name}"), message))
            }
        }
    }

    /// A scalar that not all models of the recipe have.
    ///
    /// # Errors
    /// Names the parameter if it is present and not finite.
    pub(crate) fn parameter_or(&self, name: &str, default: f64) -> Result<f64> {
        if self.parameters.contains_key(name) { self.parameter(name) } else { Ok(default) }
    }

    /// A scalar of the recipe that must be above 0.
    ///
    /// # Errors
    /// Names the parameter.
    pub(crate) fn positive_parameter(&self, name: &str) -> Result<f64> {
        self.parameter(name).and_then(|value| positive(&format!("parameters.{name}"), value))
    }

    /// Stores the scaling of the encoder's output: position = centre + unit * output.
    pub(crate) fn set_position_scale(&mut self, centre: EastNorth, unit_m: f64) {
        self.set("east_offset_m", centre.east_m);
        self.set("north_offset_m", centre.north_m);
        self.set("position_scale_m", unit_m);
    }

    /// Centre and unit (m) of [`Self::set_position_scale`].
    ///
    /// # Errors
    /// Names the parameter that is missing or cannot be used.
    pub(crate) fn position_scale(&self) -> Result<(EastNorth, f64)> {
        let centre = EastNorth {
            east_m: self.parameter("east_offset_m")?,
            north_m: self.parameter("north_offset_m")?,
        };
        Ok((centre, self.positive_parameter("position_scale_m")?))
    }

    /// The scaling of exactly these features.
    ///
    /// # Errors
    /// Names `metadata.features` if the features differ, or a scale is not finite, 0 or too large.
    pub(crate) fn scales<const N: usize>(&self, names: [&str; N]) -> Result<[Scale; N]> {
        let same = self.features.iter().map(|feature| feature.feature.as_str()).eq(names);
        let usable = |feature: &FeatureScale| {
            let size = feature.factor.abs();
            is_usable(feature.offset) && is_usable(size) && size >= LARGEST_MAGNITUDE.recip()
        };
        if !same || !self.features.iter().all(usable) {
            let message = format!(
                "must be {} in that order, with finite scales within {LARGEST_MAGNITUDE:e}",
                names.join(", ")
            );
            return Err(Error::invalid("metadata.features", message));
        }
        Ok(std::array::from_fn(|at| Scale {
            offset: self.features[at].offset,
            factor: self.features[at].factor,
        }))
    }
}

/// The scaling of one input: `(value - offset) * factor`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Scale {
    pub(crate) offset: f64,
    pub(crate) factor: f64,
}

impl Scale {
    #[inline]
    pub(crate) fn apply(self, value: f64) -> f32 {
        ((value - self.offset) * self.factor) as f32
    }
}
