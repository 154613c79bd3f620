//! The supervised baseline of Liang et al. 2022: a network of 5 layers, mean squared error, Adam at
//! 0.001, with the fix among its inputs (6D) or without (4D, GNSS denied).
//!
//! Inputs and outputs are standardised, which the paper does not specify, so that the baseline is as
//! strong as its kind allows. It has no decoder and states no error.

use std::ops::ControlFlow;
use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::domain::{BoundingBox, Sample};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::network::{Activation, LossWeights, Net, NetShape, Schedule, TrainingSet, train};
use crate::statistics::std_dev;

const HIDDEN: [usize; 3] = [32, 32, 32];
const EPOCHS: u32 = 150;

/// A fitted network.
#[derive(Debug, Clone)]
pub struct Dnn {
    net: Net,
    /// Offset and factor per input.
    scales: Vec<[f64; 2]>,
    /// Offset (m) and factor (1/m) per axis of the position.
    outputs: [[f64; 2]; 2],
}

fn inputs_of(bounding_box: &BoundingBox, fix: Option<EastNorth>) -> [f64; 6] {
    let [left, top, width, height] = bounding_box.sides_px();
    let fix = fix.unwrap_or_default();
    [left, top, width, height, fix.east_m, fix.north_m]
}

/// Fits on samples in a plane, with the fix among the inputs or without.
#[must_use]
pub fn fit(samples: &[Sample], plane: &LocalPlane, with_fix: bool, seed: u64) -> Dnn {
    let count = if with_fix { 6 } else { 4 };
    let fixes: Vec<EastNorth> = samples.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
    let raw: Vec<[f64; 6]> =
        samples.iter().zip(&fixes).map(|(sample, fix)| inputs_of(&sample.bounding_box, Some(*fix))).collect();
    let scale = |values: &mut dyn Iterator<Item = f64>| {
        let values: Vec<f64> = values.collect();
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        [mean, 1.0 / std_dev(values.iter().copied()).max(1e-3)]
    };
    let scales: Vec<[f64; 2]> =
        (0..count).map(|at| scale(&mut raw.iter().map(|inputs| inputs[at]))).collect();
    let east = scale(&mut fixes.iter().map(|fix| fix.east_m));
    let north = scale(&mut fixes.iter().map(|fix| fix.north_m));
    let column = |[offset, factor]: [f64; 2], values: &mut dyn Iterator<Item = f64>| -> Vec<f32> {
        values.map(|value| ((value - offset) * factor) as f32).collect()
    };
    let set = TrainingSet {
        inputs: (0..count).map(|at| column(scales[at], &mut raw.iter().map(|inputs| inputs[at]))).collect(),
        reconstruction_targets: Vec::new(),
        position_targets: [
            column(east, &mut fixes.iter().map(|fix| fix.east_m)),
            column(north, &mut fixes.iter().map(|fix| fix.north_m)),
        ],
        weights: vec![1.0; samples.len()],
    };
    let shape = NetShape::regression(count, &HIDDEN, Activation::Relu);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let initial = shape.initial_parameters(&mut rng);
    let schedule = Schedule { epochs: EPOCHS, batch: 64, learning_rate: 0.001, last_rate_share: 1.0 };
    let weights = LossWeights { reconstruction: 0.0, regression: 1.0 };
    let observer = &mut |_, _: &_| ControlFlow::Continue(());
    // The observer never breaks, so only candle itself can fail; then the initial parameters remain.
    let parameters = train(&shape, initial.clone(), Arc::new(set), weights, schedule, &mut rng, observer);
    Dnn { net: Net::new(shape, &parameters.unwrap_or(initial)), scales, outputs: [east, north] }
}

impl Dnn {
    /// Position of a box's target in the plane, m; a network with the fix among its inputs needs one.
    #[must_use]
    pub fn regress(&self, bounding_box: &BoundingBox, fix: Option<EastNorth>) -> EastNorth {
        let raw = inputs_of(bounding_box, fix);
        let mut inputs = [0.0f32; 6];
        for ((input, raw), [offset, factor]) in inputs.iter_mut().zip(raw).zip(&self.scales) {
            *input = ((raw - offset) * factor) as f32;
        }
        let position = self.net.encode(&inputs[..self.scales.len()]);
        let [east_m, north_m] = std::array::from_fn(|axis| {
            f64::from(position[axis]) / self.outputs[axis][1] + self.outputs[axis][0]
        });
        EastNorth { east_m, north_m }
    }
}
