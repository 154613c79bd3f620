//! The recipe `hybrid`: the paper's auto-encoder and loss on scaled boxes, in metres, without the
//! fix among the inputs, so that a label can never predict itself.
//!
//! What never happens here: raw pixels, degrees, Es with a tail.

use std::sync::Arc;

use super::FitError;
use super::artifact::{Parts, Scale};
use super::coverage::Coverage;
use super::fit::Phase;
use super::net::{Activation, Net, NetShape};
use super::regressor::{R95_PER_SIGMA, Raw};
use super::rows::{Rows, spread};
use super::tensors::Tensors;
use super::train::{LossWeights, Schedule, TrainingSet};
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::geo::EastNorth;

const HIDDEN: [usize; 2] = [24, 24];
/// Passes over the samples unless the run says otherwise.
pub(super) const EPOCHS: u32 = 120;
/// wX : wZ on scaled inputs.
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.5, regression: 1.0 };
const FEATURES: [&str; 4] = ["foot_x_px", "foot_y_px", "width_px", "height_px"];

fn shape() -> NetShape {
    NetShape::auto_encoder(FEATURES.len(), &HIDDEN, Activation::Tanh)
}

#[inline]
fn features(bounding_box: &BoundingBox) -> [f64; 4] {
    let [foot_x, foot_y] = bounding_box.foot_px();
    [foot_x, foot_y, bounding_box.width_px(), bounding_box.height_px()]
}

/// Samples per step: small sets need small steps to make enough of them.
pub(super) fn batch_of(samples: usize) -> usize {
    (samples / 20).clamp(16, 512)
}

/// Fits the network.
pub(super) fn fit(
    rows: &Rows,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<Parts, FitError> {
    let boxes: Vec<[f64; 4]> = rows.rows.iter().map(|row| features(&row.bounding_box)).collect();
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
    let (parameters, sums) = phase.train("", &shape(), Arc::new(set), WEIGHTS, schedule)?;
    let reconstruction = (sums.reconstruction / sums.samples).max(1e-9);
    let scatter_m2 = sums.regression / sums.samples * position_scale_m * position_scale_m;
    let e_regression_m2 = (scatter_m2 - e_gnss_m2).max(0.05 * e_gnss_m2.min(scatter_m2)).max(1e-4);
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
        // Half of the error goes with the reconstruction error, half stands.
        error_scale: 0.5 * e_regression_m2 / reconstruction,
        e_gnss_m2,
        parameters: [
            ("r95_scale", R95_PER_SIGMA),
            ("east_offset_m", centre.east_m),
            ("north_offset_m", centre.north_m),
            ("position_scale_m", position_scale_m),
            ("error_floor_m2", 0.5 * e_regression_m2),
        ]
        .map(|(name, value)| (name.to_owned(), value))
        .into(),
        tensors: Tensors::default(),
    };
    parts.put_net("", &shape(), &parameters);
    parts.put_coverage(&Coverage::new(rows.rows.iter().map(|row| row.bounding_box)));
    Ok(parts)
}

/// The network, ready to answer.
#[derive(Debug, Clone)]
pub(super) struct HybridRegressor {
    net: Net,
    scales: [Scale; 4],
    centre: EastNorth,
    position_scale_m: f64,
    error_scale_m2: f64,
    error_floor_m2: f64,
}

impl HybridRegressor {
    pub(super) fn build(parts: &mut Parts) -> Result<Self> {
        Ok(Self {
            scales: parts.scales(FEATURES)?,
            centre: EastNorth {
                east_m: parts.parameter("east_offset_m")?,
                north_m: parts.parameter("north_offset_m")?,
            },
            position_scale_m: parts.positive_parameter("position_scale_m")?,
            error_scale_m2: parts.error_scale,
            error_floor_m2: parts.positive_parameter("error_floor_m2")?,
            net: parts.take_net("", shape())?,
        })
    }

    pub(super) fn regress(&self, bounding_box: &BoundingBox) -> Raw {
        let raw = features(bounding_box);
        let inputs: [f32; 4] = std::array::from_fn(|at| self.scales[at].apply(raw[at]));
        let middle = self.net.encode(&inputs);
        let rebuilt = self.net.decode(middle);
        let squares = inputs.iter().zip(&rebuilt).map(|(one, other)| f64::from(one - other).powi(2));
        let reconstruction_error = squares.sum::<f64>() / 4.0;
        Raw {
            regressed: EastNorth {
                east_m: self.centre.east_m + f64::from(middle[0]) * self.position_scale_m,
                north_m: self.centre.north_m + f64::from(middle[1]) * self.position_scale_m,
            },
            reconstruction_error,
            e_m2: self.error_floor_m2 + self.error_scale_m2 * reconstruction_error,
        }
    }
}
