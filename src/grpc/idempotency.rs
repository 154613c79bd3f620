//! The metadata `idempotency-key`.

use tonic::Request;

use crate::domain::{Error, IdempotencyKey, IdempotentRequest, RequestHasher, Result};

const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The request to a method as one that its client may repeat, if it has a key; its messages are still to be
/// hashed.
///
/// # Errors
/// `InvalidArgument` naming the metadata.
pub(super) fn idempotent<M>(request: &Request<M>, method: &str) -> Result<Option<IdempotentRequest>> {
    let mut values = request.metadata().get_all(IDEMPOTENCY_KEY).iter();
    let Some(value) = values.next() else { return Ok(None) };
    let text = value.to_str().ok().filter(|_| values.next().is_none());
    let text = text.ok_or_else(|| {
        Error::invalid(IDEMPOTENCY_KEY, "the metadata must have one value of visible ASCII characters")
    })?;
    let hasher = RequestHasher::default();
    hasher.update(method.as_bytes());
    Ok(Some(IdempotentRequest { key: IdempotencyKey::new(text)?, hasher }))
}
