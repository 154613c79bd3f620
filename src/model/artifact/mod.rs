//! What a fit yields and a server stores: metadata beside a safetensors file.
//!
//! What never happens here: trust. An artifact may come from another server, so [`Artifact::load`]
//! checks every name, shape and number before anything is computed from them.

mod file;
pub(crate) mod tensors;
mod track_noise;

use std::collections::BTreeMap;

use bytes::Bytes;

use self::tensors::Tensors;
use crate::domain::{Error, FeatureScale, ModelMetadata, Recipe, Result};
use crate::geo::{LocalPlane, Position};
use crate::model::encoder::projective::Doubt;
use crate::model::network::forward::{Net, NetShape};
use crate::model::regressor::Regressor;
use crate::model::uncertainty::coverage::{Coverage, DIMENSIONS, MOST_CENTRES};
use crate::model::uncertainty::local_boxes::{Cells, NUMBERS};

pub use self::tensors::LARGEST_WEIGHTS_BYTES;
pub use self::track_noise::TrackBeliefs;

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
    /// finite, or too large.
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
        Regressor::build(parts)
    }
}

fn positive(field: &str, value: f64) -> Result<f64> {
    if value.is_finite() && value > 0.0 {
        Ok(value)
    } else {
        Err(Error::invalid(format!("metadata.{field}"), "must be a finite number above 0"))
    }
}

/// A model taken apart: what a recipe's fit gives, and what a [`Regressor`] is built from.
#[derive(Debug, Clone)]
pub(crate) struct Parts {
    pub(crate) recipe: Recipe,
    pub(crate) plane: LocalPlane,
    pub(crate) features: Vec<FeatureScale>,
    pub(crate) error_scale: f64,
    pub(crate) e_gnss_m2: f64,
    pub(crate) parameters: BTreeMap<String, f64>,
    pub(crate) tensors: Tensors,
    /// What the fixes leave open in a geometric map; only beside a fit, never stored.
    pub(crate) doubt: Option<Doubt>,
}

impl Parts {
    /// A scalar of the recipe.
    ///
    /// # Errors
    /// Names the parameter that is missing or not finite.
    pub(crate) fn parameter(&self, name: &str) -> Result<f64> {
        match self.parameters.get(name) {
            Some(value) if value.is_finite() => Ok(*value),
            _ => Err(Error::invalid(format!("metadata.parameters.{name}"), "must be there and finite")),
        }
    }

    /// A scalar of the recipe that must be above 0.
    ///
    /// # Errors
    /// Names the parameter.
    pub(crate) fn positive_parameter(&self, name: &str) -> Result<f64> {
        self.parameter(name).and_then(|value| positive(&format!("parameters.{name}"), value))
    }

    /// The scalings of exactly these features.
    ///
    /// # Errors
    /// Names `metadata.features` where they are others, or a scale is not finite or 0.
    pub(crate) fn scales<const N: usize>(&self, names: [&str; N]) -> Result<[Scale; N]> {
        let same = self.features.iter().map(|feature| feature.feature.as_str()).eq(names);
        let finite = |feature: &FeatureScale| {
            feature.offset.is_finite() && feature.factor.is_finite() && feature.factor != 0.0
        };
        if !same || !self.features.iter().all(finite) {
            let message = format!("must be {} in that order, with finite scales", names.join(", "));
            return Err(Error::invalid("metadata.features", message));
        }
        Ok(std::array::from_fn(|at| Scale {
            offset: self.features[at].offset,
            factor: self.features[at].factor,
        }))
    }

    pub(crate) fn put_coverage(&mut self, coverage: &Coverage) {
        let centres = coverage.centres.iter().flatten().copied().collect();
        self.tensors.put_f32("coverage.centres", &[coverage.centres.len(), DIMENSIONS], centres);
        self.tensors.put_f32("coverage.errors_m2", &[coverage.centres.len()], coverage.errors_m2.clone());
        self.tensors.put_f32("coverage.units", &[DIMENSIONS], coverage.units.to_vec());
        self.tensors.put_f32("coverage.radius", &[1], vec![coverage.radius]);
    }

    pub(crate) fn put_cells(&mut self, cells: &Cells) {
        let numbers = cells.numbers();
        self.tensors.put_f32("cells", &[numbers.len() / NUMBERS, NUMBERS], numbers);
    }

    /// Cells; none in models of before there were any.
    pub(crate) fn take_cells(&mut self, coverage: &Coverage) -> Result<Cells> {
        match self.tensors.rows("cells") {
            None => Ok(Cells::default()),
            Some(count) => Cells::from_numbers(coverage, &self.tensors.take_f32("cells", &[count, NUMBERS])?),
        }
    }

    pub(crate) fn take_coverage(&mut self) -> Result<Coverage> {
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
    pub(crate) fn put_net(&mut self, prefix: &str, shape: &NetShape, parameters: &[f32]) {
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
    pub(crate) fn take_net(&mut self, prefix: &str, shape: NetShape) -> Result<Net> {
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
