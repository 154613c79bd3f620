//! Keys by which a client repeats a change without making it twice (`Idempotency-Key`, IETF
//! draft-ietf-httpapi-idempotency-key-header).

use std::sync::{Arc, Mutex, PoisonError};

use sha2::{Digest, Sha256};

use super::error::{Error, Result};

/// Longest key, in bytes.
const LONGEST_KEY: usize = 255;

/// A key that a client chose for one change: 1 to 255 visible ASCII characters. Keys of different callers
/// are different keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyKey(Box<str>);

impl IdempotencyKey {
    /// # Errors
    /// `InvalidArgument` naming `idempotency-key`.
    pub fn new(text: &str) -> Result<Self> {
        if (1..=LONGEST_KEY).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Ok(Self(text.into()));
        }
        let message = format!("must be 1 to {LONGEST_KEY} visible ASCII characters, such as a UUID");
        Err(Error::invalid("idempotency-key", message))
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// SHA-256 of what a request asks for.
pub type RequestDigest = [u8; 32];

/// Gathers what a request asks for while it is read: operation, parameters and body. Clones gather into the
/// same digest.
#[derive(Debug, Clone, Default)]
pub struct RequestHasher(Arc<Mutex<Sha256>>);

impl RequestHasher {
    /// Adds a part. Its length goes in first, so that no byte can move between parts.
    pub fn update(&self, part: &[u8]) {
        let mut hash = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }

    /// The digest of all parts so far.
    #[must_use]
    pub fn digest(&self) -> RequestDigest {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone().finalize().into()
    }
}

/// A request that its client may repeat.
#[derive(Debug, Clone)]
pub struct IdempotentRequest {
    /// The client's key.
    pub key: IdempotencyKey,
    /// The hash of the request's content; complete once the body has been read.
    pub hasher: RequestHasher,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_visible_ascii() {
        for key in ["a", "8e03978e-40d5-43dd-bc93-6894a57f9324", &"x".repeat(LONGEST_KEY)] {
            assert_eq!(IdempotencyKey::new(key).expect("valid").as_str(), key);
        }
        for key in ["", "a b", "é", "a\n", &"x".repeat(LONGEST_KEY + 1)] {
            assert!(IdempotencyKey::new(key).is_err(), "{key:?}");
        }
    }

    #[test]
    fn no_byte_moves_between_the_parts_of_a_digest() {
        let digest = |parts: &[&str]| {
            let hasher = RequestHasher::default();
            parts.iter().for_each(|part| hasher.update(part.as_bytes()));
            hasher.digest()
        };
        assert_eq!(digest(&["ab", "c"]), digest(&["ab", "c"]));
        assert_ne!(digest(&["ab", "c"]), digest(&["a", "bc"]));
        assert_ne!(digest(&["ab", ""]), digest(&["ab"]));
    }
}
