//! What a fit yields and a server stores: metadata beside a safetensors file.
//!
//! An artifact may come from another server or from a damaged disk, so [`Artifact::load`] checks every
//! name, shape and number before anything is computed from them, then runs the model on boxes of its whole
//! domain ([`super::probe`]).

use std::collections::BTreeMap;

use bytes::Bytes;

use super::cells::{Cells, NUMBERS};
use super::coverage::{Coverage, DIMENSIONS, MOST_CENTRES};
use super::net::{Net, NetShape};
use super::probe;
use super::projective::Doubt;
use super::regressor::Regressor;
use super::tensors::{LARGEST_MAGNITUDE, Tensors, is_usable};
use crate::domain::{BoundingBox, Error, FeatureScale, ModelMetadata, Recipe, Result};
use crate::geo::{LocalPlane, Position};

/// Version of the metadata document.
pub const FORMAT: u32 = 1;

/// A fitted model, ready to be stored or sent.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// What it says of itself.
    pub metadata: ModelMetadata,
    /// Safetensors, at most 64 KiB.
    pub weights: Bytes,
}

impl Artifact {
    /// The model, ready to answer.
    ///
    /// # Errors
    /// Names `metadata.x` or `weights` where something is unknown, missing, of another shape, not
    /// finite, or too large, and the check that the model's answers do not pass.
    pub fn load(&self) -> Result<Regressor> {
        let metadata = &self.metadata;
        if metadata.format != FORMAT {
            return Err(Error::invalid("metadata.format", format!("must be {FORMAT}")));
        }
        let recipe: Recipe = metadata.recipe.parse().map_err(|error: Error| error.under("metadata"))?;
        let origin = Position::new(metadata.origin.longitude_deg, metadata.origin.latitude_deg)
            .map_err(|error| Error::invalid("metadata.origin", error.to_string()))?;
        let parts = Parts {
            recipe,
            plane: LocalPlane::new(origin),
            features: metadata.features.clone(),
            error_scale: positive("error_scale", metadata.error_scale)?,
            e_gnss_m2: positive("e_gnss_m2", metadata.e_gnss_m2)?,
            parameters: metadata.parameters.clone(),
            tensors: Tensors::from_bytes(&self.weights)?,
            doubt: None,
        };
        let training_boxes: Vec<BoundingBox> = parts.clone().take_coverage()?.boxes().flatten().collect();
        let regressor = Regressor::build(parts)?;
        probe::check(&regressor, &training_boxes)?;
        Ok(regressor)
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

/// A model taken apart: what a recipe's fit gives, and what a [`Regressor`] is built from.
#[derive(Debug, Clone)]
pub(super) struct Parts {
    pub(super) recipe: Recipe,
    pub(super) plane: LocalPlane,
    pub(super) features: Vec<FeatureScale>,
    pub(super) error_scale: f64,
    pub(super) e_gnss_m2: f64,
    pub(super) parameters: BTreeMap<String, f64>,
    pub(super) tensors: Tensors,
    /// What the fixes leave open in a geometric map; only beside a fit, never stored.
    pub(super) doubt: Option<Doubt>,
}

impl Parts {
    /// A scalar of the recipe.
    ///
    /// # Errors
    /// Names the parameter that is missing, not finite or too large.
    pub(super) fn parameter(&self, name: &str) -> Result<f64> {
        match self.parameters.get(name) {
            Some(value) if is_usable(*value) => Ok(*value),
            _ => {
                let message = format!("must be there, finite and within {LARGEST_MAGNITUDE:e}");
                Err(Error::invalid(format!("metadata.parameters.{name}"), message))
            }
        }
    }

    /// A scalar of the recipe that must be above 0.
    ///
    /// # Errors
    /// Names the parameter.
    pub(super) fn positive_parameter(&self, name: &str) -> Result<f64> {
        self.parameter(name).and_then(|value| positive(&format!("parameters.{name}"), value))
    }

    /// The scalings of exactly these features.
    ///
    /// # Errors
    /// Names `metadata.features` where they are others, or a scale is not finite, 0 or too large.
    pub(super) fn scales<const N: usize>(&self, names: [&str; N]) -> Result<[Scale; N]> {
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

    pub(super) fn put_coverage(&mut self, coverage: &Coverage) {
        let centres = coverage.centres.iter().flatten().copied().collect();
        self.tensors.put_f32("coverage.centres", &[coverage.centres.len(), DIMENSIONS], centres);
        self.tensors.put_f32("coverage.errors_m2", &[coverage.centres.len()], coverage.errors_m2.clone());
        self.tensors.put_f32("coverage.units", &[DIMENSIONS], coverage.units.to_vec());
        self.tensors.put_f32("coverage.radius", &[1], vec![coverage.radius]);
    }

    pub(super) fn put_cells(&mut self, cells: &Cells) {
        let numbers = cells.numbers();
        self.tensors.put_f32("cells", &[numbers.len() / NUMBERS, NUMBERS], numbers);
    }

    /// Cells; none in models of before there were any.
    pub(super) fn take_cells(&mut self, coverage: &Coverage) -> Result<Cells> {
        match self.tensors.rows("cells") {
            None => Ok(Cells::default()),
            Some(count) => Cells::from_numbers(coverage, &self.tensors.take_f32("cells", &[count, NUMBERS])?),
        }
    }

    pub(super) fn take_coverage(&mut self) -> Result<Coverage> {
        let count = self.tensors.rows("coverage.centres").unwrap_or(1);
        if count == 0 || count > MOST_CENTRES {
            return Err(Error::invalid("weights", format!("must have 1 to {MOST_CENTRES} coverage.centres")));
        }
        let centres = self.tensors.take_f32("coverage.centres", &[count, DIMENSIONS])?;
        let units = self.tensors.take_f32("coverage.units", &[DIMENSIONS])?;
        let radius = self.tensors.take_f32("coverage.radius", &[1])?[0];
        let errors_m2 = self.tensors.take_f32("coverage.errors_m2", &[count])?;
        if errors_m2.iter().any(|error_m2| *error_m2 <= 0.0) {
            return Err(Error::invalid("weights", "coverage.errors_m2 must be above 0"));
        }
        if radius <= 0.0 || units.iter().any(|unit| *unit <= 0.0) {
            return Err(Error::invalid("weights", "coverage.radius and coverage.units must be above 0"));
        }
        let units = std::array::from_fn(|axis| units[axis]);
        Ok(Coverage { units, centres: centres.as_chunks().0.to_vec(), radius, errors_m2 })
    }

    /// Stores a network as candle's `Linear` layers: `{prefix}encoder.0.weight` and so on.
    pub(super) fn put_net(&mut self, prefix: &str, shape: &NetShape, parameters: &[f32]) {
        for (index, layer) in shape.layers().enumerate() {
            let name = layer_name(prefix, shape, index);
            let weights = parameters[layer.weights..layer.biases].to_vec();
            let biases = parameters[layer.biases..layer.biases + layer.outputs].to_vec();
            self.tensors.put_f32(format!("{name}.weight"), &[layer.outputs, layer.inputs], weights);
            self.tensors.put_f32(format!("{name}.bias"), &[layer.outputs], biases);
        }
    }

    /// The reverse of [`Self::put_net`].
    ///
    /// # Errors
    /// Names the tensor that is missing or of another shape.
    pub(super) fn take_net(&mut self, prefix: &str, shape: NetShape) -> Result<Net> {
        let mut parameters = Vec::with_capacity(shape.parameter_count());
        for (index, layer) in shape.layers().enumerate() {
            let name = layer_name(prefix, &shape, index);
            parameters
                .extend(self.tensors.take_f32(&format!("{name}.weight"), &[layer.outputs, layer.inputs])?);
            parameters.extend(self.tensors.take_f32(&format!("{name}.bias"), &[layer.outputs])?);
        }
        Ok(Net::new(shape, &parameters))
    }
}

fn layer_name(prefix: &str, shape: &NetShape, index: usize) -> String {
    match index.checked_sub(shape.middle()) {
        None => format!("{prefix}encoder.{index}"),
        Some(index) => format!("{prefix}decoder.{index}"),
    }
}

/// One scaled input: `(value - offset) * factor`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    pub(super) offset: f64,
    pub(super) factor: f64,
}

impl Scale {
    #[inline]
    pub(super) fn apply(self, value: f64) -> f32 {
        ((value - self.offset) * self.factor) as f32
    }
}
