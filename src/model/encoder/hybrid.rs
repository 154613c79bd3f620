//! The recipe `hybrid`: the paper's auto-encoder and loss on standardised boxes, in metres, without the
//! fix among the inputs, so that a label cannot predict itself.

use std::sync::Arc;

use super::FittedEncoder;
use super::features::{Encoded, FEATURE_COUNT, FEATURES, features_of};
use super::stored_network::{put_network, take_network};
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::geo::EastNorth;
use crate::model::artifact::{ModelParts, Scale};
use crate::model::network::{Activation, LossWeights, Net, NetShape, Schedule, TrainingSet};
use crate::model::progress::{FitError, Phase};
use crate::model::samples::rows::TrainingRows;
use crate::statistics::std_dev;

const HIDDEN: [usize; 2] = [24, 24];
/// Default number of epochs.
pub(crate) const EPOCHS: u32 = 60;
/// wX and wZ of (1), on standardised inputs.
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.5, regression: 1.0 };

fn shape() -> NetShape {
    NetShape::auto_encoder(FEATURE_COUNT, &HIDDEN, Activation::Tanh)
}

/// Samples per step: about 20 steps per epoch of a small set, larger batches for a large one.
pub(super) fn batch_size(samples: usize) -> usize {
    (samples / 20).clamp(16, 512)
}

/// The standardisation of the labels: position = centre + unit * output.
#[derive(Debug, Clone, Copy)]
struct OutputScale {
    centre: EastNorth,
    unit_m: f64,
}

impl OutputScale {
    /// Mean of the labels, and the root mean square per axis of their distance from it.
    fn of_labels(rows: &TrainingRows) -> Self {
        let count = rows.rows.len() as f64;
        let centre = EastNorth {
            east_m: rows.rows.iter().map(|row| row.label.east_m).sum::<f64>() / count,
            north_m: rows.rows.iter().map(|row| row.label.north_m).sum::<f64>() / count,
        };
        let variance_m2 =
            rows.rows.iter().map(|row| row.label.error_per_axis_m2(centre)).sum::<f64>() / count;
        Self { centre, unit_m: variance_m2.sqrt().max(0.1) }
    }
}

/// Fits the network.
pub(crate) fn fit(
    rows: &TrainingRows,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<FittedEncoder, FitError> {
    let boxes: Vec<[f64; FEATURE_COUNT]> =
        rows.rows.iter().map(|row| features_of(&row.bounding_box)).collect();
    let scales: [Scale; FEATURE_COUNT] = std::array::from_fn(|at| {
        let values = boxes.iter().map(|features| features[at]);
        let offset = values.clone().sum::<f64>() / boxes.len() as f64;
        Scale { offset, factor: 1.0 / std_dev(values).max(1.0) }
    });
    let output = OutputScale::of_labels(rows);
    let set = Arc::new(training_set(rows, &boxes, &scales, output));
    let schedule =
        Schedule { epochs, batch: batch_size(rows.rows.len()), learning_rate: 0.01, last_rate_share: 0.01 };
    let (parameters, _) = phase.train("", &shape(), set, WEIGHTS, schedule)?;
    let features = FEATURES
        .iter()
        .zip(scales)
        .map(|(name, Scale { offset, factor })| FeatureScale { feature: (*name).to_owned(), offset, factor })
        .collect();
    let mut parts = ModelParts::new(Recipe::Hybrid, rows.plane, features, e_gnss_m2);
    parts.set_position_scale(output.centre, output.unit_m);
    put_network(&mut parts.tensors, "", &shape(), &parameters);
    Ok(FittedEncoder { parts, covariance: None })
}

fn training_set(
    rows: &TrainingRows,
    boxes: &[[f64; FEATURE_COUNT]],
    scales: &[Scale; FEATURE_COUNT],
    OutputScale { centre, unit_m }: OutputScale,
) -> TrainingSet {
    let columns: Vec<Vec<f32>> = (0..FEATURE_COUNT)
        .map(|at| boxes.iter().map(|features| scales[at].apply(features[at])).collect())
        .collect();
    let target = |value: &dyn Fn(EastNorth) -> f64| {
        rows.rows.iter().map(|row| (value(row.label) / unit_m) as f32).collect()
    };
    TrainingSet {
        reconstruction_targets: columns.clone(),
        inputs: columns,
        position_targets: [
            target(&|label| label.east_m - centre.east_m),
            target(&|label| label.north_m - centre.north_m),
        ],
        weights: vec![1.0; rows.rows.len()],
    }
}

/// The network for inference.
#[derive(Debug, Clone)]
pub(crate) struct HybridEncoder {
    net: Net,
    scales: [Scale; FEATURE_COUNT],
    output: OutputScale,
}

impl HybridEncoder {
    pub(super) fn build(parts: &mut ModelParts) -> Result<Self> {
        let (centre, unit_m) = parts.position_scale()?;
        Ok(Self {
            scales: parts.scales(FEATURES)?,
            output: OutputScale { centre, unit_m },
            net: take_network(&mut parts.tensors, "", shape())?,
        })
    }

    /// Position and reconstruction of a box.
    #[inline]
    pub(crate) fn encode(&self, bounding_box: &BoundingBox) -> Encoded {
        let features = features_of(bounding_box);
        let inputs: [f32; FEATURE_COUNT] = std::array::from_fn(|at| self.scales[at].apply(features[at]));
        let bottleneck = self.net.encode(&inputs);
        let outputs = self.net.decode(bottleneck);
        let OutputScale { centre, unit_m } = self.output;
        Encoded {
            position: EastNorth {
                east_m: centre.east_m + f64::from(bottleneck[0]) * unit_m,
                north_m: centre.north_m + f64::from(bottleneck[1]) * unit_m,
            },
            reconstruction_px: std::array::from_fn(|at| {
                f64::from(outputs[at]) / self.scales[at].factor + self.scales[at].offset
            }),
        }
    }
}
