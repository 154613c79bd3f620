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

/// A network for inference: the weight matrices are transposed, so that the inner loop runs over outputs.
#[derive(Debug, Clone)]
pub struct Net {
    shape: NetShape,
    layers: Vec<Layer>,
    /// Per layer: one row of `outputs` weights per input, then the biases.
    transposed: Vec<f32>,
}

impl Net {
    /// # Panics
    /// If the length of the parameters is not [`NetShape::parameter_count`].
    #[must_use]
    pub fn new(shape: NetShape, parameters: &[f32]) -> Self {
        assert_eq!(parameters.len(), shape.parameter_count(), "the parameters must match the shape");
        let layers: Vec<Layer> = shape.layers().collect();
        let mut transposed = parameters.to_vec();
        for layer in &layers {
            for output in 0..layer.outputs {
                for input in 0..layer.inputs {
                    transposed[layer.weights + input * layer.outputs + output] =
                        parameters[layer.weights + output * layer.inputs + input];
                }
            }
        }
        Self { shape, layers, transposed }
    }

    /// The network's shape.
    #[must_use]
    pub const fn shape(&self) -> &NetShape {
        &self.shape
    }

    /// Weights of a layer as rows of one input each, and its biases.
    #[must_use]
    pub(crate) fn matrix(&self, layer: &Layer) -> (&[f32], &[f32]) {
        let biases = &self.transposed[layer.biases..layer.biases + layer.outputs];
        (&self.transposed[layer.weights..layer.biases], biases)
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
        for layer in &self.layers[layers] {
            let mut sums = [0.0; WIDEST_LAYER];
            let sums = &mut sums[..layer.outputs];
            sums.copy_from_slice(&self.transposed[layer.biases..layer.biases + layer.outputs]);
            let rows = self.transposed[layer.weights..layer.biases].chunks_exact(layer.outputs);
            for (row, unit) in rows.zip(units.iter()) {
                for (sum, weight) in sums.iter_mut().zip(row) {
                    *sum += weight * unit;
                }
            }
            match (layer.linear, self.shape.activation()) {
                (true, _) => {}
                (false, Activation::Tanh) => sums.iter_mut().for_each(|sum| *sum = tanh(*sum)),
                (false, Activation::Relu) => sums.iter_mut().for_each(|sum| *sum = sum.max(0.0)),
            }
            units[..layer.outputs].copy_from_slice(sums);
        }
    }
}
