//! The forward pass of a trained network: a plain loop without allocation, for inference.

use super::shape::{Activation, Layer, NetShape, WIDEST_LAYER};

/// Hyperbolic tangent within a few units in the last place, as a ratio of polynomials (Eigen's minimax
/// approximation): free of branches, so that the compiler vectorises loops over it.
#[inline(always)]
#[must_use]
pub(super) fn tanh(value: f32) -> f32 {
    let x = value.clamp(-TANH_BOUND, TANH_BOUND);
    let square = x * x;
    let mut top = TANH_NUMERATOR[0];
    for coefficient in &TANH_NUMERATOR[1..] {
        top = top * square + coefficient;
    }
    let mut bottom = TANH_DENOMINATOR[0];
    for coefficient in &TANH_DENOMINATOR[1..] {
        bottom = bottom * square + coefficient;
    }
    x * top / bottom
}

/// Arguments beyond this give 1 in f32.
pub(crate) const TANH_BOUND: f32 = 7.905_311;
/// Numerator of [`tanh`] in the square, highest power first.
pub(crate) const TANH_NUMERATOR: [f32; 7] = [
    -2.760_768_5e-16,
    2.000_188e-13,
    -8.604_672e-11,
    5.122_297e-8,
    1.485_722_4e-5,
    6.372_619e-4,
    4.893_524_6e-3,
];
/// Denominator of [`tanh`] in the square, highest power first.
pub(crate) const TANH_DENOMINATOR: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];

/// Outputs that are summed at once: two SSE registers.
const LANES: usize = 8;

/// A network for inference: the weights lie in the order in which they are read, [`LANES`] outputs at a time, so that
/// the sums stay in registers whatever the layer's width.
#[derive(Debug, Clone)]
pub struct Net {
    shape: NetShape,
    layers: Vec<Layer>,
    /// Per layer and block of outputs: their biases, then for each input their weights; 0 for missing outputs.
    blocks: Vec<[f32; LANES]>,
}

impl Net {
    /// # Panics
    /// If the length of the parameters is not [`NetShape::parameter_count`].
    #[must_use]
    pub fn new(shape: NetShape, parameters: &[f32]) -> Self {
        assert_eq!(parameters.len(), shape.parameter_count(), "the parameters must match the shape");
        let layers: Vec<Layer> = shape.layers().collect();
        let mut blocks = Vec::new();
        for layer in &layers {
            let biases = &parameters[layer.biases..layer.biases + layer.outputs];
            let rows = &parameters[layer.weights..layer.biases];
            for first in (0..layer.outputs).step_by(LANES) {
                let of_outputs = |value: &dyn Fn(usize) -> f32| {
                    std::array::from_fn(|lane| {
                        let output = first + lane;
                        if output < layer.outputs { value(output) } else { 0.0 }
                    })
                };
                blocks.push(of_outputs(&|output| biases[output]));
                blocks.extend(
                    (0..layer.inputs).map(|input| of_outputs(&|output| rows[output * layer.inputs + input])),
                );
            }
        }
        Self { shape, layers, blocks }
    }

    /// The network's shape.
    #[must_use]
    pub const fn shape(&self) -> &NetShape {
        &self.shape
    }

    /// Weights of a layer as rows of one input each, and its biases.
    #[must_use]
    pub(crate) fn matrix(&self, index: usize) -> (Vec<f32>, Vec<f32>) {
        let layer = &self.layers[index];
        let blocks = &self.blocks[self.first_block(index)..];
        // Row 0 holds the biases.
        let row = |row: usize| {
            let of_output =
                move |output: usize| blocks[(output / LANES) * (1 + layer.inputs) + row][output % LANES];
            (0..layer.outputs).map(of_output)
        };
        ((1..=layer.inputs).flat_map(row).collect(), row(0).collect())
    }

    fn first_block(&self, index: usize) -> usize {
        self.layers[..index].iter().map(|layer| layer.outputs.div_ceil(LANES) * (1 + layer.inputs)).sum()
    }

    /// The regressed position (the bottleneck) of one scaled input.
    #[inline]
    #[must_use]
    pub fn encode(&self, inputs: &[f32]) -> [f32; 2] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..inputs.len()].copy_from_slice(inputs);
        self.run(0..self.shape.bottleneck(), &mut units);
        [units[0], units[1]]
    }

    /// Outputs of the first hidden layer, which must have `UNITS` units.
    #[inline]
    #[must_use]
    pub fn first_hidden<const UNITS: usize>(&self, inputs: &[f32]) -> [f32; UNITS] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..inputs.len()].copy_from_slice(inputs);
        self.run(0..1, &mut units);
        std::array::from_fn(|unit| units[unit])
    }

    /// The reconstructed inputs of a regressed position; only the first `inputs` values are set.
    #[inline]
    #[must_use]
    pub fn decode(&self, bottleneck: [f32; 2]) -> [f32; WIDEST_LAYER] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..2].copy_from_slice(&bottleneck);
        self.run(self.shape.bottleneck()..self.layers.len(), &mut units);
        units
    }

    #[inline]
    fn run(&self, layers: std::ops::Range<usize>, units: &mut [f32; WIDEST_LAYER]) {
        let mut blocks = &self.blocks[self.first_block(layers.start)..];
        for layer in &self.layers[layers] {
            let mut outputs = [0.0; WIDEST_LAYER];
            for outputs in outputs.as_chunks_mut::<LANES>().0.iter_mut().take(layer.outputs.div_ceil(LANES)) {
                let (own, rest) = blocks.split_at(1 + layer.inputs);
                blocks = rest;
                let mut sums = own[0];
                for (weights, unit) in own[1..].iter().zip(units.iter()) {
                    for (sum, weight) in sums.iter_mut().zip(weights) {
                        *sum += weight * unit;
                    }
                }
                match (layer.linear, self.shape.activation()) {
                    (true, _) => {}
                    (false, Activation::Tanh) => sums.iter_mut().for_each(|sum| *sum = tanh(*sum)),
                    (false, Activation::Relu) => sums.iter_mut().for_each(|sum| *sum = sum.max(0.0)),
                }
                *outputs = sums;
            }
            *units = outputs;
        }
    }
}
