//! The exchange format of a model version: one safetensors file with the metadata document in its header,
//! for downloads, uploads and `sightfix fuse --model`.

use std::collections::HashMap;

use bytes::Bytes;
use safetensors::{SafeTensorError, SafeTensors};

use super::Artifact;
use crate::domain::{Error, Result};

/// Key of the metadata document in the safetensors header.
const KEY: &str = "sightfix";
/// Largest file that is read: the header adds some kB to the 64 KiB of weights.
const LARGEST_FILE_BYTES: usize = 1 << 20;

impl Artifact {
    /// The artifact as one file.
    ///
    /// # Errors
    /// If the weights are not safetensors.
    pub fn to_file(&self) -> std::result::Result<Bytes, SafeTensorError> {
        let tensors = SafeTensors::deserialize(&self.weights)?;
        let document =
            serde_json::to_string(&self.metadata).map_err(SafeTensorError::InvalidHeaderDeserialization)?;
        let header = HashMap::from([(KEY.to_owned(), document)]);
        safetensors::serialize(tensors.tensors(), Some(header)).map(Bytes::from)
    }

    /// The artifact of a file by [`Artifact::to_file`].
    ///
    /// # Errors
    /// Names `file`, or the field of its `metadata`.
    pub fn from_file(file: &[u8]) -> Result<Self> {
        if file.len() > LARGEST_FILE_BYTES {
            return Err(Error::invalid("file", format!("must be at most {LARGEST_FILE_BYTES} bytes")));
        }
        let not_safetensors = |error| Error::invalid("file", format!("is not safetensors: {error}"));
        let (_, header) = SafeTensors::read_metadata(file).map_err(not_safetensors)?;
        let document = header.metadata().as_ref().and_then(|entries| entries.get(KEY)).ok_or_else(|| {
            Error::invalid(
                "file",
                format!("has no metadata under `{KEY}`; download it from a sightfix server"),
            )
        })?;
        let metadata = serde_json::from_str(document)
            .map_err(|error| Error::invalid("metadata", format!("cannot be read: {error}")))?;
        let tensors = SafeTensors::deserialize(file).map_err(not_safetensors)?;
        let weights = safetensors::serialize(tensors.tensors(), None).map_err(not_safetensors)?.into();
        Ok(Self { metadata, weights })
    }
}
