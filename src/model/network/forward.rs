//! The shape of an auto-encoder, its flat parameters, and the plain forward loop.
//!
//! What never happens here: training, scaling, candle. The layout of the parameters is the one
//! contract between this loop, the training kernel and the stored tensors: layer by layer, the
//! weights as rows of one output unit each, then the biases, exactly candle's `Linear`.

use rand::{Rng, RngExt};

/// Widest layer that the plain loop has room for.
pub const WIDEST_LAYER: usize = 64;

/// What a hidden unit does with its sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Hyperbolic tangent.
    Tanh,
    /// The positive part.
    Relu,
}

/// Widths of the node layers and where the regressed position stands among them.
///
/// The layers before and at `middle` are the encoder, those after it the decoder. The middle and
/// the last layer are linear, all others go through the activation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetShape {
    widths: Vec<usize>,
    middle: usize,
    activation: Activation,
}

impl NetShape {
    /// An auto-encoder `inputs - hidden.. - 2 - hidden reversed.. - inputs`.
    #[must_use]
    pub fn auto_encoder(inputs: usize, hidden: &[usize], activation: Activation) -> Self {
        let mut widths = vec![inputs];
        widths.extend_from_slice(hidden);
        let middle = widths.len();
        widths.push(2);
        widths.extend(hidden.iter().rev());
        widths.push(inputs);
        Self::checked(widths, middle, activation)
    }

    /// A plain regression network without decoder: `inputs - hidden.. - 2`.
    #[must_use]
    pub fn regression(inputs: usize, hidden: &[usize], activation: Activation) -> Self {
        let mut widths = vec![inputs];
        widths.extend_from_slice(hidden);
        widths.push(2);
        let middle = widths.len() - 1;
        Self::checked(widths, middle, activation)
    }

    fn checked(widths: Vec<usize>, middle: usize, activation: Activation) -> Self {
        assert!(widths.iter().all(|width| (1..=WIDEST_LAYER).contains(width)), "a layer is too wide");
        Self { widths, middle, activation }
    }

    /// Units of each node layer, inputs first.
    #[must_use]
    pub fn widths(&self) -> &[usize] {
        &self.widths
    }

    /// Index in [`Self::widths`] of the regressed position.
    #[must_use]
    pub const fn middle(&self) -> usize {
        self.middle
    }

    /// What hidden units do.
    #[must_use]
    pub const fn activation(&self) -> Activation {
        self.activation
    }

    /// Whether layers follow the middle.
    #[must_use]
    pub fn has_decoder(&self) -> bool {
        self.middle + 1 < self.widths.len()
    }

    /// Weight matrices from the inputs on: (offset of the weights, inputs, outputs). The biases
    /// follow the weights.
    pub fn layers(&self) -> impl DoubleEndedIterator<Item = Layer> + ExactSizeIterator + '_ {
        (0..self.widths.len() - 1).map(|index| self.layer(index))
    }

    /// One of [`Self::layers`].
    #[must_use]
    pub fn layer(&self, index: usize) -> Layer {
        let offset =
            (0..index).map(|before| (self.widths[before] + 1) * self.widths[before + 1]).sum::<usize>();
        let (inputs, outputs) = (self.widths[index], self.widths[index + 1]);
        let linear = index + 1 == self.middle || index + 2 == self.widths.len();
        Layer { weights: offset, biases: offset + inputs * outputs, inputs, outputs, linear }
    }

    /// Length of the flat parameters.
    #[must_use]
    pub fn parameter_count(&self) -> usize {
        self.widths.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
    }

    /// Uniform within one over the root of the inputs, weights and biases alike.
    pub fn initial_parameters(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut parameters = Vec::with_capacity(self.parameter_count());
        for layer in self.layers() {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            for _ in 0..(layer.inputs + 1) * layer.outputs {
                parameters.push(rng.random_range(-bound..bound));
            }
        }
        parameters
    }
}

/// Where one weight matrix and its biases lie in the flat parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layer {
    /// First weight; row-major, one row of `inputs` per output.
    pub weights: usize,
    /// First bias.
    pub biases: usize,
    /// Columns.
    pub inputs: usize,
    /// Rows.
    pub outputs: usize,
    /// Whether no activation follows.
    pub linear: bool,
}

/// Hyperbolic tangent to a few units in the last place, as a ratio of polynomials (the classic
/// minimax form of Eigen): no branch, so that loops over it turn into vector code.
#[inline(always)]
#[must_use]
pub fn tanh(value: f32) -> f32 {
    let x = value.clamp(-TANH_BOUND, TANH_BOUND);
    let square = x * x;
    let mut top = TANH_TOP[0];
    for coefficient in &TANH_TOP[1..] {
        top = top * square + coefficient;
    }
    let mut bottom = TANH_BOTTOM[0];
    for coefficient in &TANH_BOTTOM[1..] {
        bottom = bottom * square + coefficient;
    }
    x * top / bottom
}

/// Beyond it f32's tangent is 1.
pub(crate) const TANH_BOUND: f32 = 7.905_311;
/// Numerator of [`tanh`] in the square, highest power first.
pub(crate) const TANH_TOP: [f32; 7] = [
    -2.760_768_5e-16,
    2.000_188e-13,
    -8.604_672e-11,
    5.122_297e-8,
    1.485_722_4e-5,
    6.372_619e-4,
    4.893_524_6e-3,
];
/// Denominator of [`tanh`] in the square, highest power first.
pub(crate) const TANH_BOTTOM: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];

/// A network ready to answer: the weights turned so that the inner loop runs over outputs.
#[derive(Debug, Clone)]
pub struct Net {
    shape: NetShape,
    layers: Vec<Layer>,
    /// Per layer: one row of `outputs` per input, then the biases.
    turned: Vec<f32>,
}

impl Net {
    /// # Panics
    /// Where the parameters are not [`NetShape::parameter_count`] long.
    #[must_use]
    pub fn new(shape: NetShape, parameters: &[f32]) -> Self {
        assert_eq!(parameters.len(), shape.parameter_count(), "parameters of another shape");
        let layers: Vec<Layer> = shape.layers().collect();
        let mut turned = parameters.to_vec();
        for layer in &layers {
            for output in 0..layer.outputs {
                for input in 0..layer.inputs {
                    turned[layer.weights + input * layer.outputs + output] =
                        parameters[layer.weights + output * layer.inputs + input];
                }
            }
        }
        Self { shape, layers, turned }
    }

    /// Its shape.
    #[must_use]
    pub const fn shape(&self) -> &NetShape {
        &self.shape
    }

    /// The regressed position (the middle layer) of one scaled input.
    #[inline]
    #[must_use]
    pub fn encode(&self, inputs: &[f32]) -> [f32; 2] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..inputs.len()].copy_from_slice(inputs);
        self.run(0..self.shape.middle, &mut units);
        [units[0], units[1]]
    }

    /// Outputs of the first layer, which must have `UNITS`.
    #[inline]
    #[must_use]
    pub fn first_hidden<const UNITS: usize>(&self, inputs: &[f32]) -> [f32; UNITS] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..inputs.len()].copy_from_slice(inputs);
        self.run(0..1, &mut units);
        std::array::from_fn(|unit| units[unit])
    }

    /// The rebuilt inputs of a regressed position; only the first `inputs` of them are set.
    #[inline]
    #[must_use]
    pub fn decode(&self, middle: [f32; 2]) -> [f32; WIDEST_LAYER] {
        let mut units = [0.0; WIDEST_LAYER];
        units[..2].copy_from_slice(&middle);
        self.run(self.shape.middle..self.layers.len(), &mut units);
        units
    }

    #[inline]
    fn run(&self, layers: std::ops::Range<usize>, units: &mut [f32; WIDEST_LAYER]) {
        for layer in &self.layers[layers] {
            let mut sums = [0.0; WIDEST_LAYER];
            let sums = &mut sums[..layer.outputs];
            sums.copy_from_slice(&self.turned[layer.biases..layer.biases + layer.outputs]);
            let rows = self.turned[layer.weights..layer.biases].chunks_exact(layer.outputs);
            for (row, unit) in rows.zip(units.iter()) {
                for (sum, weight) in sums.iter_mut().zip(row) {
                    *sum += weight * unit;
                }
            }
            match (layer.linear, self.shape.activation) {
                (true, _) => {}
                (false, Activation::Tanh) => sums.iter_mut().for_each(|sum| *sum = tanh(*sum)),
                (false, Activation::Relu) => sums.iter_mut().for_each(|sum| *sum = sum.max(0.0)),
            }
            units[..layer.outputs].copy_from_slice(sums);
        }
    }
}
