//! Loss and gradient of a minibatch in explicit vector code.
//!
//! Units are rows and samples are lanes, so that every inner loop runs over whole vectors; a tile of
//! [`LANES`] samples remains in the first-level cache through all layers. Nothing is allocated per batch.
//! Vector operations are not wrapped in closures: a closure is compiled for the baseline instruction set
//! and called once per operation.

use pulp::{Simd, WithSimd};

use super::forward::{TANH_BOUND, TANH_DENOMINATOR, TANH_NUMERATOR};
use super::shape::{Activation, Layer, NetShape};

/// Samples of one tile.
const LANES: usize = 64;
/// Vectors that are accumulated in parallel, to hide the latency of the multiplier.
const WIDE: usize = 4;

/// Scaled training samples, in columns.
#[derive(Debug, Clone, Default)]
pub struct TrainingSet {
    /// One column of all samples per input.
    pub inputs: Vec<Vec<f32>>,
    /// Targets of the last layer, one column per unit; empty without a decoder.
    pub reconstruction_targets: Vec<Vec<f32>>,
    /// Targets of the bottleneck (east, north), scaled.
    pub position_targets: [Vec<f32>; 2],
    /// Weight of each sample's regression error; their mean should be 1.
    pub weights: Vec<f32>,
}

impl TrainingSet {
    /// Number of samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.position_targets[0].len()
    }

    /// True if there are no samples.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.position_targets[0].is_empty()
    }
}

/// wX and wZ of (1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossWeights {
    /// Weight of the reconstruction error.
    pub reconstruction: f32,
    /// Weight of the regression error.
    pub regression: f32,
}

/// Sums over the samples of a batch or an epoch.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LossSums {
    /// Number of samples.
    pub samples: f64,
    /// L of (1).
    pub loss: f64,
    /// eX of (2).
    pub reconstruction: f64,
    /// eZ of (3), unweighted.
    pub regression: f64,
    /// eZ / eX, the terms of (4).
    pub ratio: f64,
}

impl LossSums {
    /// Adds another batch.
    pub fn add(&mut self, other: &Self) {
        self.samples += other.samples;
        self.loss += other.loss;
        self.reconstruction += other.reconstruction;
        self.regression += other.regression;
        self.ratio += other.ratio;
    }
}

/// Buffers of one training run, reused by every batch.
#[derive(Debug)]
pub(crate) struct Scratch {
    /// Outputs of every layer of units, `width * LANES` each.
    units: Vec<Vec<f32>>,
    /// Gradient of the loss with respect to the weighted sums of every layer of units.
    deltas: Vec<Vec<f32>>,
}

impl Scratch {
    /// Buffers for one tile of samples.
    #[must_use]
    pub(crate) fn new(shape: &NetShape) -> Self {
        let buffers: Vec<Vec<f32>> = shape.widths().iter().map(|width| vec![0.0; width * LANES]).collect();
        Self { deltas: buffers.clone(), units: buffers }
    }
}

/// The mean loss of one batch, to be differentiated.
pub(crate) struct BatchLoss<'a> {
    /// Shape of the network.
    pub shape: &'a NetShape,
    /// The parameters, flat.
    pub parameters: &'a [f32],
    /// All samples.
    pub set: &'a TrainingSet,
    /// Rows of the batch.
    pub rows: &'a [u32],
    /// Weights of the two errors.
    pub weights: LossWeights,
    /// Memory for intermediate values.
    pub scratch: &'a mut Scratch,
    /// Receives the gradient of the batch's mean loss.
    pub gradient: &'a mut [f32],
}

impl WithSimd for BatchLoss<'_> {
    type Output = LossSums;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) -> LossSums {
        self.gradient.fill(0.0);
        let mut sums = LossSums::default();
        let rows = self.rows;
        for tile in rows.chunks(LANES) {
            self.gather(tile);
            for index in 0..self.shape.widths().len() - 1 {
                self.forward(simd, index);
            }
            sums.add(&self.errors(tile, 1.0 / rows.len() as f32));
            for index in (0..self.shape.widths().len() - 1).rev() {
                self.backward(simd, index);
            }
        }
        sums
    }
}

impl BatchLoss<'_> {
    #[inline(always)]
    fn gather(&mut self, tile: &[u32]) {
        for (column, unit) in self.set.inputs.iter().zip(self.scratch.units[0].chunks_exact_mut(LANES)) {
            unit[tile.len()..].fill(0.0);
            for (lane, row) in unit.iter_mut().zip(tile) {
                *lane = column[*row as usize];
            }
        }
    }

    #[inline(always)]
    fn forward<S: Simd>(&mut self, simd: S, index: usize) {
        let layer = self.shape.layer(index);
        let (before, after) = self.scratch.units.split_at_mut(index + 1);
        let (input, output) = (S::as_simd_f32s(&before[index]).0, S::as_mut_simd_f32s(&mut after[0]).0);
        let weights = &self.parameters[layer.weights..layer.biases];
        let biases = &self.parameters[layer.biases..layer.biases + layer.outputs];
        let mut first = 0;
        while first + 2 <= layer.outputs {
            sums_of_rows::<S, 2>(simd, weights, (layer.inputs, 1), Some(biases), input, output, first);
            first += 2;
        }
        if first < layer.outputs {
            sums_of_rows::<S, 1>(simd, weights, (layer.inputs, 1), Some(biases), input, output, first);
        }
        if layer.linear {
            return;
        }
        match self.shape.activation() {
            Activation::Tanh => {
                for unit in output {
                    *unit = tanh_of(simd, *unit);
                }
            }
            Activation::Relu => {
                let zero = simd.splat_f32s(0.0);
                for unit in output {
                    *unit = simd.max_f32s(*unit, zero);
                }
            }
        }
    }

    /// Errors of a tile. Stores the gradient with respect to the bottleneck and to the last layer in
    /// their deltas.
    #[inline(always)]
    fn errors(&mut self, tile: &[u32], share: f32) -> LossSums {
        let (bottleneck, last) = (self.shape.bottleneck(), self.shape.widths().len() - 1);
        let mut regression = [0.0f32; LANES];
        let mut reconstruction = [0.0f32; LANES];
        let factor = self.weights.regression * share;
        let units = self.scratch.units[bottleneck].chunks_exact(LANES);
        let deltas = self.scratch.deltas[bottleneck].chunks_exact_mut(LANES);
        for ((unit, delta), target) in units.zip(deltas).zip(&self.set.position_targets) {
            delta.fill(0.0);
            for (lane, row) in tile.iter().enumerate() {
                let error = unit[lane] - target[*row as usize];
                regression[lane] += 0.5 * error * error;
                delta[lane] = factor * self.set.weights[*row as usize] * error;
            }
        }
        if last > bottleneck {
            let mean = 1.0 / self.shape.widths()[last] as f32;
            let factor = self.weights.reconstruction * share * 2.0 * mean;
            let units = self.scratch.units[last].chunks_exact(LANES);
            let deltas = self.scratch.deltas[last].chunks_exact_mut(LANES);
            for ((unit, delta), target) in units.zip(deltas).zip(&self.set.reconstruction_targets) {
                delta.fill(0.0);
                for (lane, row) in tile.iter().enumerate() {
                    let error = unit[lane] - target[*row as usize];
                    reconstruction[lane] += mean * error * error;
                    delta[lane] = factor * error;
                }
            }
        }
        let mut sums = LossSums { samples: tile.len() as f64, ..LossSums::default() };
        for (lane, row) in tile.iter().enumerate() {
            let (ex, ez) = (f64::from(reconstruction[lane]), f64::from(regression[lane]));
            let weight = f64::from(self.set.weights[*row as usize]);
            sums.reconstruction += ex;
            sums.regression += ez;
            // A perfect reconstruction must not make (4) infinite.
            sums.ratio += ez / ex.max(f64::from(f32::MIN_POSITIVE));
            sums.loss += f64::from(self.weights.reconstruction) * ex
                + f64::from(self.weights.regression) * weight * ez;
        }
        sums
    }

    #[inline(always)]
    fn backward<S: Simd>(&mut self, simd: S, index: usize) {
        let layer = self.shape.layer(index);
        let (before, after) = self.scratch.deltas.split_at_mut(index + 1);
        let delta = S::as_simd_f32s(&after[0]).0;
        let input = S::as_simd_f32s(&self.scratch.units[index]).0;
        gradient_of_layer(simd, &layer, delta, input, self.gradient);
        if index == 0 {
            return;
        }
        let weights = &self.parameters[layer.weights..layer.biases];
        let below = S::as_mut_simd_f32s(&mut before[index]).0;
        // The gradient of the bottleneck is that of the regression error plus that of the decoder.
        let regression = if index == self.shape.bottleneck() { Some(below.to_vec()) } else { None };
        let mut first = 0;
        while first + 2 <= layer.inputs {
            sums_of_rows::<S, 2>(simd, weights, (1, layer.inputs), None, delta, below, first);
            first += 2;
        }
        if first < layer.inputs {
            sums_of_rows::<S, 1>(simd, weights, (1, layer.inputs), None, delta, below, first);
        }
        if let Some(regression) = regression {
            for (sum, own) in below.iter_mut().zip(regression) {
                *sum = simd.add_f32s(*sum, own);
            }
            return;
        }
        let one = simd.splat_f32s(1.0);
        match self.shape.activation() {
            Activation::Tanh => {
                for (delta, unit) in below.iter_mut().zip(input) {
                    *delta = simd.mul_f32s(*delta, simd.sub_f32s(one, simd.mul_f32s(*unit, *unit)));
                }
            }
            Activation::Relu => {
                let zero = simd.splat_f32s(0.0);
                for (delta, unit) in below.iter_mut().zip(input) {
                    let on = simd.greater_than_f32s(*unit, zero);
                    *delta = simd.select_f32s(on, *delta, zero);
                }
            }
        }
    }
}

/// `output[row] = bias[row] + sum over columns of weights[row, column] * input[column]` for `ROWS`
/// rows from `first` on; `strides` are the steps from row to row and from column to column.
#[inline(always)]
fn sums_of_rows<S: Simd, const ROWS: usize>(
    simd: S,
    weights: &[f32],
    strides: (usize, usize),
    biases: Option<&[f32]>,
    input: &[S::f32s],
    output: &mut [S::f32s],
    first: usize,
) {
    let vectors = LANES / S::F32_LANES;
    let mut start = [simd.splat_f32s(0.0); ROWS];
    if let Some(biases) = biases {
        for (value, bias) in start.iter_mut().zip(&biases[first..first + ROWS]) {
            *value = simd.splat_f32s(*bias);
        }
    }
    for from in (0..vectors).step_by(WIDE) {
        let mut sums = [[simd.splat_f32s(0.0); WIDE]; ROWS];
        for (row, value) in sums.iter_mut().zip(start) {
            *row = [value; WIDE];
        }
        for (column, unit) in input.chunks_exact(vectors).enumerate() {
            let unit = &unit[from..from + WIDE];
            for (row, sums) in sums.iter_mut().enumerate() {
                let weight = simd.splat_f32s(weights[(first + row) * strides.0 + column * strides.1]);
                for (sum, lane) in sums.iter_mut().zip(unit) {
                    *sum = simd.mul_add_e_f32s(weight, *lane, *sum);
                }
            }
        }
        for (row, sums) in sums.iter().enumerate() {
            let at = (first + row) * vectors + from;
            output[at..at + WIDE].copy_from_slice(sums);
        }
    }
}

#[inline(always)]
fn gradient_of_layer<S: Simd>(
    simd: S,
    layer: &Layer,
    delta: &[S::f32s],
    input: &[S::f32s],
    gradient: &mut [f32],
) {
    let mut first = 0;
    while first + 2 <= layer.outputs {
        gradient_of_rows::<S, 2>(simd, layer, delta, input, gradient, first);
        first += 2;
    }
    if first < layer.outputs {
        gradient_of_rows::<S, 1>(simd, layer, delta, input, gradient, first);
    }
}

#[inline(always)]
fn gradient_of_rows<S: Simd, const ROWS: usize>(
    simd: S,
    layer: &Layer,
    delta: &[S::f32s],
    input: &[S::f32s],
    gradient: &mut [f32],
    first: usize,
) {
    let vectors = LANES / S::F32_LANES;
    let zero = simd.splat_f32s(0.0);
    let rows: [&[S::f32s]; ROWS] =
        std::array::from_fn(|row| &delta[(first + row) * vectors..(first + row + 1) * vectors]);
    for (row, lanes) in rows.iter().enumerate() {
        let mut sum = zero;
        for lane in *lanes {
            sum = simd.add_f32s(sum, *lane);
        }
        gradient[layer.biases + first + row] += simd.reduce_sum_f32s(sum);
    }
    let mut column = 0;
    while column < layer.inputs {
        let wide = WIDE.min(layer.inputs - column);
        // A short last group repeats its last column; the surplus sums are discarded.
        let columns: [&[S::f32s]; WIDE] = std::array::from_fn(|at| {
            let at = column + at.min(wide - 1);
            &input[at * vectors..(at + 1) * vectors]
        });
        let mut sums = [[zero; WIDE]; ROWS];
        for vector in 0..vectors {
            for (sums, row) in sums.iter_mut().zip(&rows) {
                for (sum, unit) in sums.iter_mut().zip(&columns) {
                    *sum = simd.mul_add_e_f32s(row[vector], unit[vector], *sum);
                }
            }
        }
        for (row, sums) in sums.iter().enumerate() {
            let at = layer.weights + (first + row) * layer.inputs + column;
            for (sum, total) in sums.iter().zip(&mut gradient[at..at + wide]) {
                *total += simd.reduce_sum_f32s(*sum);
            }
        }
        column += wide;
    }
}

/// [`super::forward::tanh`] on a vector.
#[inline(always)]
fn tanh_of<S: Simd>(simd: S, value: S::f32s) -> S::f32s {
    let bound = simd.splat_f32s(TANH_BOUND);
    let x = simd.max_f32s(simd.min_f32s(value, bound), simd.splat_f32s(-TANH_BOUND));
    let square = simd.mul_f32s(x, x);
    let mut top = simd.splat_f32s(TANH_NUMERATOR[0]);
    for coefficient in &TANH_NUMERATOR[1..] {
        top = simd.mul_add_e_f32s(top, square, simd.splat_f32s(*coefficient));
    }
    let mut bottom = simd.splat_f32s(TANH_DENOMINATOR[0]);
    for coefficient in &TANH_DENOMINATOR[1..] {
        bottom = simd.mul_add_e_f32s(bottom, square, simd.splat_f32s(*coefficient));
    }
    simd.div_f32s(simd.mul_f32s(x, top), bottom)
}
