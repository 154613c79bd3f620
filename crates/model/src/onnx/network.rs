//! Fully connected networks and the auto-encoder on standardised boxes.

use std::ops::Range;

use super::boxes::{Boxes, scaled};
use super::expression::Expr;
use crate::encoder::auto_encoder::AutoEncoder;
use crate::network::{Activation, Net};

/// The bottleneck's two units.
pub(crate) fn encode<'g>(net: &Net, inputs: Expr<'g>) -> Expr<'g> {
    run(net, 0..net.shape().bottleneck(), inputs)
}

/// The reconstructed inputs of the bottleneck's units.
pub(crate) fn decode<'g>(net: &Net, bottleneck: Expr<'g>) -> Expr<'g> {
    run(net, net.shape().bottleneck()..net.shape().layers().len(), bottleneck)
}

/// The units of the first hidden layer.
pub(crate) fn first_hidden<'g>(net: &Net, inputs: Expr<'g>) -> Expr<'g> {
    run(net, 0..1, inputs)
}

fn run<'g>(net: &Net, layers: Range<usize>, inputs: Expr<'g>) -> Expr<'g> {
    layers.fold(inputs, |units, index| {
        let layer = net.shape().layer(index);
        let (weights, biases) = net.matrix(index);
        let sums = units.matrix_product(layer.inputs, layer.outputs, &f64s(&weights))
            + units.graph().row(&f64s(&biases));
        match (layer.linear, net.shape().activation()) {
            (true, _) => sums,
            (false, Activation::Tanh) => sums.tanh(),
            (false, Activation::Relu) => sums.positive(),
        }
    })
}

fn f64s(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().map(|number| f64::from(*number)).collect()
}

/// Position (east and north, m) and reconstructed features (px) of an auto-encoder.
pub(crate) fn auto_encoder<'g>(encoder: &AutoEncoder, boxes: Boxes<'g>) -> (Expr<'g>, Expr<'g>) {
    let graph = boxes.sides.graph();
    let bottleneck = encode(&encoder.net, scaled(boxes.features(), &encoder.scales));
    let outputs = decode(&encoder.net, bottleneck);
    let centre = encoder.output.centre;
    let position_m = bottleneck * encoder.output.unit_m + graph.row(&[centre.east_m, centre.north_m]);
    let reconstruction_px = outputs / graph.row(&encoder.scales.map(|scale| scale.factor))
        + graph.row(&encoder.scales.map(|scale| scale.offset));
    (position_m, reconstruction_px)
}
