//! The shape of a fully connected network and the layout of its flat parameters.
//!
//! The layout is the contract between the forward pass, the training kernel and the stored tensors:
//! layer by layer, the weights as rows of one output unit each, then the biases, which is the layout of
//! candle's `Linear`.

use rand::{Rng, RngExt};

/// Most units of a layer: the forward pass works in arrays of this length.
pub(super) const WIDEST_LAYER: usize = 64;

/// Activation function of the hidden units.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Hyperbolic tangent.
    Tanh,
    /// Rectifier: the positive part.
    Relu,
}

/// Widths of the layers of units and the index of the bottleneck, whose two units are the regressed
/// position.
///
/// The layers up to the bottleneck are the encoder, those after it the decoder. The bottleneck and the
/// last layer are linear; the activation applies to all others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetShape {
    widths: Vec<usize>,
    bottleneck: usize,
    activation: Activation,
}

impl NetShape {
    /// An auto-encoder `inputs - hidden.. - 2 - hidden reversed.. - inputs`.
    #[must_use]
    pub fn auto_encoder(inputs: usize, hidden: &[usize], activation: Activation) -> Self {
        let mut widths = vec![inputs];
        widths.extend_from_slice(hidden);
        let bottleneck = widths.len();
        widths.push(2);
        widths.extend(hidden.iter().rev());
        widths.push(inputs);
        Self::checked(widths, bottleneck, activation)
    }

    /// A regression network without a decoder: `inputs - hidden.. - 2`.
    #[must_use]
    pub fn regression(inputs: usize, hidden: &[usize], activation: Activation) -> Self {
        let mut widths = vec![inputs];
        widths.extend_from_slice(hidden);
        widths.push(2);
        let bottleneck = widths.len() - 1;
        Self::checked(widths, bottleneck, activation)
    }

    fn checked(widths: Vec<usize>, bottleneck: usize, activation: Activation) -> Self {
        assert!(widths.iter().all(|width| (1..=WIDEST_LAYER).contains(width)), "a layer is too wide");
        Self { widths, bottleneck, activation }
    }

    /// Units of each layer, the inputs first.
    #[must_use]
    pub fn widths(&self) -> &[usize] {
        &self.widths
    }

    /// Index in [`Self::widths`] of the bottleneck.
    #[must_use]
    pub const fn bottleneck(&self) -> usize {
        self.bottleneck
    }

    /// Activation of the hidden units.
    #[must_use]
    pub const fn activation(&self) -> Activation {
        self.activation
    }

    /// True if there are layers after the bottleneck.
    #[must_use]
    pub fn has_decoder(&self) -> bool {
        self.bottleneck + 1 < self.widths.len()
    }

    /// Weight matrices with their biases, from the inputs on.
    pub fn layers(&self) -> impl DoubleEndedIterator<Item = Layer> + ExactSizeIterator + '_ {
        (0..self.widths.len() - 1).map(|index| self.layer(index))
    }

    /// One of [`Self::layers`].
    #[must_use]
    pub fn layer(&self, index: usize) -> Layer {
        let offset = (0..index).map(|below| (self.widths[below] + 1) * self.widths[below + 1]).sum::<usize>();
        let (inputs, outputs) = (self.widths[index], self.widths[index + 1]);
        let linear = index + 1 == self.bottleneck || index + 2 == self.widths.len();
        Layer { weights: offset, biases: offset + inputs * outputs, inputs, outputs, linear }
    }

    /// Length of the flat parameters.
    #[must_use]
    pub fn parameter_count(&self) -> usize {
        self.widths.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
    }

    /// Initial parameters: weights and biases uniform within `1 / sqrt(inputs)` of 0.
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

/// Position of one weight matrix and its biases in the flat parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layer {
    /// Index of the first weight; row-major, one row of `inputs` weights per output.
    pub weights: usize,
    /// Index of the first bias.
    pub biases: usize,
    /// Columns of the matrix.
    pub inputs: usize,
    /// Rows of the matrix.
    pub outputs: usize,
    /// True if the outputs are linear, without activation.
    pub linear: bool,
}
