//! One file for one model version: safetensors, with the metadata document and a checksum in the header.
//!
//! A file that one server gives can be imported by another, and read by `sightfix fuse --model`.

use std::collections::HashMap;

use bytes::Bytes;
use safetensors::{SafeTensorError, SafeTensors};

use super::Artifact;
use crate::domain::{Error, Result, model_sha256};

/// Key of the metadata document in the header.
const DOCUMENT_KEY: &str = "sightfix";
/// Key of the checksum in the header, see [`model_sha256`].
const CHECKSUM_KEY: &str = "sightfix.sha256";
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
        let checksum = model_sha256(document.as_bytes(), &self.weights);
        let header = HashMap::from([(DOCUMENT_KEY.to_owned(), document)]);
        let file = safetensors::serialize(tensors.tensors(), Some(header))?;
        with_checksum(&file, &checksum).map(Bytes::from).ok_or(SafeTensorError::HeaderTooSmall)
    }

    /// The artifact of a file by [`Artifact::to_file`].
    ///
    /// The checksum is taken over the canonical form of the tensors, so that it covers their names, types
    /// and shapes as well. Entries of the header that are not known are refused: one of them may be the
    /// checksum under a damaged name.
    ///
    /// # Errors
    /// Names `file`, or the field of its `metadata`.
    pub fn from_file(file: &[u8]) -> Result<Self> {
        if file.len() > LARGEST_FILE_BYTES {
            return Err(Error::invalid("file", format!("must be at most {LARGEST_FILE_BYTES} bytes")));
        }
        let not_safetensors = |error| Error::invalid("file", format!("is not safetensors: {error}"));
        let (_, header) = SafeTensors::read_metadata(file).map_err(not_safetensors)?;
        let entries = header.metadata().clone().unwrap_or_default();
        let document = entries.get(DOCUMENT_KEY).ok_or_else(|| {
            Error::invalid(
                "file",
                format!("has no metadata under `{DOCUMENT_KEY}`; download it from a sightfix server"),
            )
        })?;
        if let Some(unknown) =
            entries.keys().find(|key| ![DOCUMENT_KEY, CHECKSUM_KEY].contains(&key.as_str()))
        {
            return Err(Error::invalid("file", format!("has an unknown entry {unknown:?} in its header")));
        }
        let tensors = SafeTensors::deserialize(file).map_err(not_safetensors)?;
        let weights = safetensors::serialize(tensors.tensors(), None).map_err(not_safetensors)?;
        if entries.get(CHECKSUM_KEY) != Some(&model_sha256(document.as_bytes(), &weights)) {
            let message = "has no checksum or another one than it states, so it was damaged on its way; download it again";
            return Err(Error::invalid("file", message));
        }
        let metadata = serde_json::from_str(document)
            .map_err(|error| Error::invalid("metadata", format!("cannot be read: {error}")))?;
        Ok(Self { metadata, weights: weights.into() })
    }
}

/// The file with the checksum as the first entry of its header. The library writes entries in the random
/// order of a hash map, which would give one model version different bytes with every download.
fn with_checksum(file: &[u8], checksum: &str) -> Option<Vec<u8>> {
    const LENGTH_BYTES: usize = 8;
    let (length, rest) = file.split_first_chunk::<LENGTH_BYTES>()?;
    let (header, weights) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
    let entries = header.trim_ascii_end().strip_prefix(br#"{"__metadata__":{"#)?;
    let mut written = format!(r#"{{"__metadata__":{{"{CHECKSUM_KEY}":"{checksum}","#).into_bytes();
    written.extend_from_slice(entries);
    // Weights begin at a multiple of eight bytes.
    written.resize(written.len().next_multiple_of(LENGTH_BYTES), b' ');
    let length = u64::try_from(written.len()).ok()?.to_le_bytes();
    Some([&length[..], &written, weights].concat())
}
