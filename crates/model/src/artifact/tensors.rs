//! Named tensors of a model and their safetensors form.
//!
//! The recipe decides which tensors there are and of which shape; a file with any other tensor is refused.

use std::collections::BTreeMap;

use bytes::Bytes;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::domain::{Error, Result};

/// Largest weight file, in bytes.
pub const LARGEST_WEIGHTS_BYTES: usize = 64 * 1024;

/// Bound of the absolute value of every number of a model, and inverse bound of every divisor: numbers beyond
/// it come from a damaged or forged file and would overflow before they give a position.
pub(crate) const LARGEST_MAGNITUDE: f64 = 1e12;

/// True if a number is finite and within [`LARGEST_MAGNITUDE`].
pub(crate) fn is_usable(value: f64) -> bool {
    value.abs() <= LARGEST_MAGNITUDE
}

#[derive(Debug, Clone, PartialEq)]
enum Values {
    F32(Vec<f32>),
    F64(Vec<f64>),
}

#[derive(Debug, Clone, PartialEq)]
struct Tensor {
    shape: Vec<usize>,
    values: Values,
}

/// Tensors by name; a tensor that is taken is removed.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Tensors(BTreeMap<String, Tensor>);

impl Tensors {
    pub(crate) fn put_f32(&mut self, name: impl Into<String>, shape: &[usize], values: Vec<f32>) {
        self.0.insert(name.into(), Tensor { shape: shape.to_vec(), values: Values::F32(values) });
    }

    pub(crate) fn put_f64(&mut self, name: impl Into<String>, shape: &[usize], values: Vec<f64>) {
        self.0.insert(name.into(), Tensor { shape: shape.to_vec(), values: Values::F64(values) });
    }

    /// True if there is a tensor of that name.
    pub(crate) fn holds(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

    /// Rows of a matrix, if there is one of that name.
    pub(crate) fn rows(&self, name: &str) -> Option<usize> {
        self.0.get(name).and_then(|tensor| tensor.shape.first().copied())
    }

    /// # Errors
    /// Names the tensor that is missing or has another shape or type.
    pub(crate) fn take_f32(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        match self.take(name, shape)? {
            Values::F32(values) => Ok(values),
            Values::F64(_) => Err(invalid(format!("tensor {name} must be of f32"))),
        }
    }

    /// # Errors
    /// Names the tensor that is missing or has another shape or type.
    pub(crate) fn take_f64(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        match self.take(name, shape)? {
            Values::F64(values) => Ok(values),
            Values::F32(_) => Err(invalid(format!("tensor {name} must be of f64"))),
        }
    }

    fn take(&mut self, name: &str, shape: &[usize]) -> Result<Values> {
        let tensor = self.0.remove(name).ok_or_else(|| invalid(format!("tensor {name} is missing")))?;
        if tensor.shape != shape {
            let found = tensor.shape;
            return Err(invalid(format!("tensor {name} must be of shape {shape:?}, not {found:?}")));
        }
        Ok(tensor.values)
    }

    /// # Errors
    /// Names a tensor that has not been taken.
    pub(crate) fn finish(self) -> Result<()> {
        match self.0.keys().next() {
            Some(name) => Err(invalid(format!("tensor {name} is not one of this recipe's"))),
            None => Ok(()),
        }
    }

    /// The tensors as safetensors; the same tensors give the same bytes.
    pub(crate) fn to_bytes(&self) -> Result<Bytes, safetensors::SafeTensorError> {
        let raw: Vec<(&String, Dtype, &[usize], Vec<u8>)> = self
            .0
            .iter()
            .map(|(name, tensor)| {
                let (dtype, bytes) = match &tensor.values {
                    Values::F32(values) => {
                        (Dtype::F32, values.iter().flat_map(|value| value.to_le_bytes()).collect())
                    }
                    Values::F64(values) => {
                        (Dtype::F64, values.iter().flat_map(|value| value.to_le_bytes()).collect())
                    }
                };
                (name, dtype, tensor.shape.as_slice(), bytes)
            })
            .collect();
        let views = raw
            .iter()
            .map(|(name, dtype, shape, bytes)| {
                Ok((name.as_str(), TensorView::new(*dtype, shape.to_vec(), bytes)?))
            })
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
        Ok(Bytes::from(safetensors::serialize(views, None)?))
    }

    /// # Errors
    /// Refuses files that are too large, not safetensors, of other types than f32 and f64, or hold
    /// numbers that are not finite or beyond [`LARGEST_MAGNITUDE`]; the field is named `weights`.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Result<Self> {
        if bytes.len() > LARGEST_WEIGHTS_BYTES {
            return Err(invalid(format!(
                "must be at most {LARGEST_WEIGHTS_BYTES} bytes, not {}",
                bytes.len()
            )));
        }
        let file = SafeTensors::deserialize(bytes)
            .map_err(|cause| invalid(format!("must be a safetensors file: {cause}")))?;
        let mut tensors = Self::default();
        for (name, view) in file.tensors() {
            let values = match view.dtype() {
                Dtype::F32 => Values::F32(
                    view.data().as_chunks().0.iter().map(|chunk| f32::from_le_bytes(*chunk)).collect(),
                ),
                Dtype::F64 => Values::F64(
                    view.data().as_chunks().0.iter().map(|chunk| f64::from_le_bytes(*chunk)).collect(),
                ),
                other => return Err(invalid(format!("tensor {name} must be of f32 or f64, not {other:?}"))),
            };
            let usable = match &values {
                Values::F32(values) => values.iter().all(|value| is_usable(f64::from(*value))),
                Values::F64(values) => values.iter().all(|value| is_usable(*value)),
            };
            if !usable {
                return Err(invalid(format!(
                    "tensor {name} holds numbers that are not finite or beyond {LARGEST_MAGNITUDE:e}"
                )));
            }
            tensors.0.insert(name, Tensor { shape: view.shape().to_vec(), values });
        }
        Ok(tensors)
    }
}

fn invalid(message: String) -> Error {
    Error::invalid("weights", message)
}
