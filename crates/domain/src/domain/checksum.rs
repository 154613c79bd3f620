//! The checksum that goes with a model version, in its file and in the database.

use std::fmt::Write as _;

use sha2::{Digest, Sha256};

/// SHA-256 over a model's metadata document (UTF-8 JSON, byte for byte) and its weights (safetensors), in
/// hexadecimal. The length of the document comes first, so that no byte can change sides.
#[must_use]
pub fn model_sha256(document: &[u8], weights: &[u8]) -> String {
    let mut hash = Sha256::new();
    hash.update((document.len() as u64).to_le_bytes());
    hash.update(document);
    hash.update(weights);
    hash.finalize().iter().fold(String::with_capacity(64), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}
