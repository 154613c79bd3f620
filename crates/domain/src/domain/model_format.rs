//! The files that a model version is given as.

use strum::{Display, EnumString, IntoStaticStr};

use super::error::Error;

/// The format of a model version's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Display, EnumString, IntoStaticStr)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_format)]
pub enum ModelFormat {
    /// Weights and metadata, for import on another server.
    #[default]
    Safetensors,
    /// A graph from boxes to positions, for other runtimes; it cannot be imported.
    Onnx,
}

fn unknown_format(_: &str) -> Error {
    Error::invalid("format", "must be safetensors or onnx")
}
