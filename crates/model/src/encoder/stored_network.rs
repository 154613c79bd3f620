//! Networks as named tensors: `{prefix}encoder.0.weight`, `{prefix}encoder.0.bias` and so on, each a layer
//! of candle's `Linear`.

use crate::artifact::tensors::Tensors;
use crate::domain::Result;
use crate::network::{Net, NetShape};

/// Adds the layers of a network to a model's tensors.
pub(crate) fn put_network(tensors: &mut Tensors, prefix: &str, shape: &NetShape, parameters: &[f32]) {
    for (index, layer) in shape.layers().enumerate() {
        let name = layer_name(prefix, shape, index);
        let weights = parameters[layer.weights..layer.biases].to_vec();
        let biases = parameters[layer.biases..layer.biases + layer.outputs].to_vec();
        tensors.put_f32(format!("{name}.weight"), &[layer.outputs, layer.inputs], weights);
        tensors.put_f32(format!("{name}.bias"), &[layer.outputs], biases);
    }
}

/// Takes the layers of a network out of a model's tensors.
///
/// # Errors
/// Names the tensor that is missing or has another shape.
pub(crate) fn take_network(tensors: &mut Tensors, prefix: &str, shape: NetShape) -> Result<Net> {
    let mut parameters = Vec::with_capacity(shape.parameter_count());
    for (index, layer) in shape.layers().enumerate() {
        let name = layer_name(prefix, &shape, index);
        parameters.extend(tensors.take_f32(&format!("{name}.weight"), &[layer.outputs, layer.inputs])?);
        parameters.extend(tensors.take_f32(&format!("{name}.bias"), &[layer.outputs])?);
    }
    Ok(Net::new(shape, &parameters))
}

fn layer_name(prefix: &str, shape: &NetShape, index: usize) -> String {
    match index.checked_sub(shape.bottleneck()) {
        None => format!("{prefix}encoder.{index}"),
        Some(index) => format!("{prefix}decoder.{index}"),
    }
}
