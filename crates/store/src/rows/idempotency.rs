//! Rows of answers that are repeated.

use crate::domain::{Actor, Error, ErrorKind, IdempotencyKey, RequestDigest, Result};

/// A request that its client may repeat.
#[derive(Debug, Clone)]
pub struct IdempotencyRecord {
    /// The client's key.
    pub key: IdempotencyKey,
    /// The digest of the request.
    pub digest: RequestDigest,
}

/// An answer that was stored under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredAnswer {
    pub(crate) digest: Vec<u8>,
    pub(crate) answer: String,
}

impl StoredAnswer {
    /// The answer, if it was given to the same request.
    ///
    /// # Errors
    /// [`ErrorKind::IdempotencyKeyReused`].
    pub fn to_request(self, digest: &RequestDigest) -> Result<String> {
        if self.digest == digest {
            return Ok(self.answer);
        }
        Err(Error::field(
            ErrorKind::IdempotencyKeyReused,
            "idempotency-key",
            "was used for another request; send the same request again, or this one under a new key",
        ))
    }
}

/// Whose a key is: that of an API key, a certificate or a person who has signed in. Callers without any of them, while
/// no credential is needed, share their keys.
pub(crate) fn owner(actor: &Actor) -> String {
    let key = actor.key_id.map(|id| id.to_string());
    key.or_else(|| actor.identity.as_deref().map(str::to_owned)).unwrap_or_default()
}
