//! The recipe `hybrid`: the paper's auto-encoder and loss on scaled boxes, in metres, without the
//! fix among the inputs, so that a label can never predict itself.
//!
//! What never happens here: raw pixels, degrees, Es with a tail.

use std::sync::Arc;

use super::projection::sides_of;
use super::projective::FEATURES;
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::geo::EastNorth;
use crate::model::artifact::tensors::Tensors;
use crate::model::artifact::{Parts, Scale};
use crate::model::network::forward::{Activation, Net, NetShape};
use crate::model::network::training::{LossWeights, Schedule, TrainingSet};
use crate::model::progress::FitError;
use crate::model::progress::Phase;
use crate::model::samples::rows::{Rows, spread};

const HIDDEN: [usize; 2] = [24, 24];
/// Passes over the samples unless the run says otherwise.
pub(crate) const EPOCHS: u32 = 60;
/// wX : wZ on scaled inputs.
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.5, regression: 1.0 };

fn shape() -> NetShape {
    NetShape::auto_encoder(FEATURES.len(), &HIDDEN, Activation::Tanh)
}

/// Samples per step: small sets need small steps to make enough of them.
pub(crate) fn batch_of(samples: usize) -> usize {
    (samples / 20).clamp(16, 512)
}

/// Fits the network.
pub(crate) fn fit(
    rows: &Rows,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<Parts, FitError> {
    let boxes: Vec<[f64; 4]> = rows.rows.iter().map(|row| sides_of(&row.bounding_box)).collect();
    let scales: [Scale; 4] = std::array::from_fn(|at| {
        let values = boxes.iter().map(|features| features[at]);
        let offset = values.clone().sum::<f64>() / boxes.len() as f64;
        Scale { offset, factor: 1.0 / spread(values).max(1.0) }
    });
    let count = rows.rows.len() as f64;
    let centre = EastNorth {
        east_m: rows.rows.iter().map(|row| row.label.east_m).sum::<f64>() / count,
        north_m: rows.rows.iter().map(|row| row.label.north_m).sum::<f64>() / count,
    };
    let position_scale_m =
        rows.rows.iter().map(|row| row.label.error_per_axis_m2(centre)).sum::<f64>() / count;
    let position_scale_m = position_scale_m.sqrt().max(0.1);
    let columns: Vec<Vec<f32>> =
        (0..4).map(|at| boxes.iter().map(|features| scales[at].apply(features[at])).collect()).collect();
    let target = |value: &dyn Fn(EastNorth) -> f64| {
        rows.rows.iter().map(|row| (value(row.label) / position_scale_m) as f32).collect()
    };
    let set = TrainingSet {
        rebuilt: columns.clone(),
        inputs: columns,
        targets: [
            target(&|label| label.east_m - centre.east_m),
            target(&|label| label.north_m - centre.north_m),
        ],
        weights: vec![1.0; rows.rows.len()],
    };
    let schedule =
        Schedule { epochs, batch: batch_of(rows.rows.len()), learning_rate: 0.01, last_rate_share: 0.01 };
    let (parameters, _) = phase.train("", &shape(), Arc::new(set), WEIGHTS, schedule)?;
    let mut parts = Parts {
        recipe: Recipe::Hybrid,
        plane: rows.plane,
        features: FEATURES
            .iter()
            .zip(scales)
            .map(|(name, scale)| FeatureScale {
                feature: (*name).to_owned(),
                offset: scale.offset,
                factor: scale.factor,
            })
            .collect(),
        error_scale: 1.0,
        e_gnss_m2,
        parameters: [
            ("east_offset_m", centre.east_m),
            ("north_offset_m", centre.north_m),
            ("position_scale_m", position_scale_m),
        ]
        .map(|(name, value)| (name.to_owned(), value))
        .into(),
        tensors: Tensors::default(),
        doubt: None,
    };
    parts.put_net("", &shape(), &parameters);
    Ok(parts)
}

/// The network, ready to answer.
#[derive(Debug, Clone)]
pub(crate) struct HybridRegressor {
    net: Net,
    scales: [Scale; 4],
    centre: EastNorth,
    position_scale_m: f64,
}

impl HybridRegressor {
    pub(crate) fn build(parts: &mut Parts) -> Result<Self> {
        Ok(Self {
            scales: parts.scales(FEATURES)?,
            centre: EastNorth {
                east_m: parts.parameter("east_offset_m")?,
                north_m: parts.parameter("north_offset_m")?,
            },
            position_scale_m: parts.positive_parameter("position_scale_m")?,
            net: parts.take_net("", shape())?,
        })
    }

    /// Position, and the sides (foot x, foot y, width, height, px) that belong to it.
    #[inline]
    pub(crate) fn regress(&self, bounding_box: &BoundingBox) -> (EastNorth, [f64; 4]) {
        let raw = sides_of(bounding_box);
        let inputs: [f32; 4] = std::array::from_fn(|at| self.scales[at].apply(raw[at]));
        let middle = self.net.encode(&inputs);
        let rebuilt = self.net.decode(middle);
        let sides = std::array::from_fn(|at| {
            f64::from(rebuilt[at]) / self.scales[at].factor + self.scales[at].offset
        });
        let regressed = EastNorth {
            east_m: self.centre.east_m + f64::from(middle[0]) * self.position_scale_m,
            north_m: self.centre.north_m + f64::from(middle[1]) * self.position_scale_m,
        };
        (regressed, sides)
    }
}
