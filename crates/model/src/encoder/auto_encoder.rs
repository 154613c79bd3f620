//! The auto-encoder of the paper on standardised boxes, in metres: the fix is not among its inputs, so that a
//! label cannot predict itself. The two units of its bottleneck are the regressed position.

use std::sync::Arc;

use super::features::{Encoded, FEATURE_COUNT, features_of};
use crate::artifact::Scale;
use crate::domain::BoundingBox;
use crate::geo::EastNorth;
use crate::network::{Activation, LossWeights, Net, NetShape, Schedule, TrainingSet};
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;
use crate::statistics::std_dev;

/// wX and wZ of (1), on standardised inputs.
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.5, regression: 1.0 };

/// The standardisation of the labels: position = centre + unit * output.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OutputScale {
    pub(crate) centre: EastNorth,
    pub(crate) unit_m: f64,
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

/// `4 - hidden.. - 2 - hidden reversed.. - 4` with hyperbolic tangents.
pub(crate) fn shape(hidden: &[usize]) -> NetShape {
    NetShape::auto_encoder(FEATURE_COUNT, hidden, Activation::Tanh)
}

/// Samples per step: about 20 steps per epoch of a small set, larger batches for a large one.
pub(crate) fn batch_size(samples: usize) -> usize {
    (samples / 20).clamp(16, 512)
}

/// A trained auto-encoder with its scales.
#[derive(Debug, Clone)]
pub(crate) struct Trained {
    pub(crate) scales: [Scale; FEATURE_COUNT],
    pub(crate) output: OutputScale,
    pub(crate) shape: NetShape,
    pub(crate) parameters: Vec<f32>,
}

/// Trains an auto-encoder by the hybrid loss (1).
pub(crate) fn train(
    rows: &TrainingRows,
    hidden: &[usize],
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<Trained, FitError> {
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
    let shape = shape(hidden);
    let (parameters, _) = phase.train("", &shape, set, WEIGHTS, schedule)?;
    Ok(Trained { scales, output, shape, parameters })
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
pub(crate) struct AutoEncoder {
    pub(crate) net: Net,
    pub(crate) scales: [Scale; FEATURE_COUNT],
    pub(crate) output: OutputScale,
}

impl AutoEncoder {
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

impl From<Trained> for AutoEncoder {
    fn from(Trained { scales, output, shape, parameters }: Trained) -> Self {
        Self { net: Net::new(shape, &parameters), scales, output }
    }
}
